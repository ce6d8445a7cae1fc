"""Single-object tracking by color: `ColorTracking-v0`."""
