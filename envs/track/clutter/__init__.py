"""Multi-target tracking of points in clutter: `ClutterTracking-v0`."""
