"""Trackers of one colored object as agents: names, films to run them over, scores kept, values tuned."""
