"""Palette, glyphs, plots and the window: the building blocks of every picture."""
