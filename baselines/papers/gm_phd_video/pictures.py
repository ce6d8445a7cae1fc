"""The pictures of paper 000's figure 2: detections and tracks at four frames of its sequence."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from servotrack.baselines.agents.people.catalog import create_detector, create_tracker
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.gm_phd_video.experiment import Method
from servotrack.envs.track.people.box_paint import BoxTrail, annotate
from servotrack.estimators.types import Image

SHOWN = {330: "a new person", 450: "two merge", 468: "two part", 528: "one has left"}
"""Frames of figure 2."""
_DETECTED = (226, 85, 52)


def paper_pictures(seed: int, method: Method) -> list[tuple[str, Image, Image]]:
    """A title, the frame with its detections and the frame with its tracks, for each of `SHOWN`.

    Args:
        seed: Of the environment.
        method: Detector and filter.
    """
    sequence = sequences.rendered(seed, script=sequences.SCRIPT, horizon=max(SHOWN) + 1)
    detector, tracker = create_detector(method.detector), create_tracker(method.tracker, sequence.size, 25.0)
    seen: Any = None
    believed: Any = None
    pictures = []
    for number, frame in enumerate(sequence.frames):
        seen, detections = detector.step(detector.initial(frame) if seen is None else seen, frame)
        believed, estimate = tracker.step(tracker.initial(detections) if believed is None else believed, detections)
        if number in SHOWN:
            tracks = [
                BoxTrail(label, box[None]) for label, box in zip(estimate.labels.tolist(), estimate.states, strict=True)
            ]
            title = f"frame {number}, {SHOWN[number]}"
            detected, tracked = frame.copy(), frame.copy()
            for left, top, width, height in np.rint(detections.boxes).astype(int).tolist():
                cv2.rectangle(detected, (left, top), (left + width - 1, top + height - 1), _DETECTED, 1)
            annotate(tracked, tracks)
            pictures.append((title, detected, tracked))
    return pictures
