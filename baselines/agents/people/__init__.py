"""Observers of people on video: detectors and box trackers behind `predict`."""
