"""Detectors: images in, what was found in them out."""

from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.detect.marker import MarkerDetector

__all__ = ["Detections", "MarkerDetector", "detections_from_boxes"]
