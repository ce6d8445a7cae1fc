"""Observers of points in clutter: random-finite-set filters behind `predict`."""
