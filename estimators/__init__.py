"""Estimators: pure functions from arrays to arrays, independent of Gymnasium and of the environments."""
