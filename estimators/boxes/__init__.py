"""Trackers of boxes in images: detections in, boxes with identities out; and detectors and trackers in one."""
