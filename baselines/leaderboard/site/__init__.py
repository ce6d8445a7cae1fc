"""The board as a static site: tables, figures, vector replays and a race, in plain JavaScript."""
