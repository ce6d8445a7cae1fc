"""One budget for all: classical and learned methods in one cell, with equal environment steps, search included."""
