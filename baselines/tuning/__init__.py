"""Hyper-parameter searches on tune seeds."""
