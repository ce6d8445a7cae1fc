"""Zhang and Li (2008): Monte-Carlo color tracking, its scenarios repeated with all trackers."""
