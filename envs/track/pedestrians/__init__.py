"""Multi-person tracking in rendered video: `PedestrianTracking-v0`."""
