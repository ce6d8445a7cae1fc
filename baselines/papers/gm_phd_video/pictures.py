"""Images of the paper's figure 2: detections and tracks at four frames of its sequence."""

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
"""Frame numbers of figure 2, with the event that each shows."""
_DETECTED = (226, 85, 52)


def paper_pictures(seed: int, method: Method) -> list[tuple[str, Image, Image]]:
    """Return title, frame with detections and frame with tracks, for each frame in `SHOWN`.

    Args:
        seed: Seed of the environment.
        method: Detector and filter.
    """
    sequence = sequences.rendered(seed, script=sequences.SCRIPT, horizon=max(SHOWN) + 1)
    detector, tracker = create_detector(method.detector), create_tracker(method.tracker, sequence.size, 25.0)
    detector_state: Any = None
    tracker_state: Any = None
    pictures = []
    for number, frame in enumerate(sequence.frames):
        if detector_state is None:
            detector_state = detector.initial(frame)
        detector_state, detections = detector.step(detector_state, frame)
        if tracker_state is None:
            tracker_state = tracker.initial(detections)
        tracker_state, estimate = tracker.step(tracker_state, detections)
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
