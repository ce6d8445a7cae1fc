"""Recorded sequences as an environment: `VideoTracking-v0`."""
