"""Reproductions of the papers' experiments, one folder per paper, and the claims audit."""
