"""Algorithms: arrays in, arrays out; they know no world."""
