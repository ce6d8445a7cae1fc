"""Building blocks of all pictures: palette, glyphs, plots and window."""
