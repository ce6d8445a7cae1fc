"""Tracking of recorded points, such as radar measurements or messages of ships: `RecordedPoints-v0`."""
