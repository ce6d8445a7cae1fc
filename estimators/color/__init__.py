"""Trackers of one colored object: a frame in, its box out."""
