"""The color world of paper 001: a head in a room full of colors like its own, and everything that hides it."""
