"""Jiang and Zhou (2016): targets in bearing-time records, tracked by hidden Markov models."""
