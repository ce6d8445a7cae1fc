"""Multi-person tracking in recorded sequences: `VideoTracking-v0`."""
