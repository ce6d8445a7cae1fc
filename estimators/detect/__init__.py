"""Detectors of moving people and of a colored marker in images."""

from servotrack.estimators.detect.appearance import box_appearance, box_histograms, color_bins
from servotrack.estimators.detect.background import BackgroundState, MaskedBackground
from servotrack.estimators.detect.blobs import BlobFinder
from servotrack.estimators.detect.detections import Detections, Detector, detections_from_boxes
from servotrack.estimators.detect.marker import MarkerDetector
from servotrack.estimators.detect.picture_motion import PictureMotion, PictureMotionState
from servotrack.estimators.detect.subtractors import KNNBackground, MOG2Background

__all__ = [
    "BackgroundState",
    "BlobFinder",
    "Detections",
    "Detector",
    "KNNBackground",
    "MOG2Background",
    "MarkerDetector",
    "MaskedBackground",
    "PictureMotion",
    "PictureMotionState",
    "box_appearance",
    "box_histograms",
    "color_bins",
    "detections_from_boxes",
]
