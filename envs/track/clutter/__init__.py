"""Points in clutter: `ClutterTracking-v0`."""
