"""Reproductions of published experiments, one folder per paper, and the audit of the papers' claims."""
