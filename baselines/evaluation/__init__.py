"""Evaluation: episodes, seeds, results on disk, statistics, and the suite runner."""
