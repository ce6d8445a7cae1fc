"""Paper 001 (Zhang and Li 2008): Monte-Carlo color tracking, its scenarios run again with all trackers."""
