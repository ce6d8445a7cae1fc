"""Reproduction of paper 003: targets in bearing-time records, tracked by hidden Markov models."""
