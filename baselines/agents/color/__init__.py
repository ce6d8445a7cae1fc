"""Trackers of one colored object as agents."""
