"""Hyper-parameter searches on tune seeds, and their record."""
