"""Run several detectors and filters on one sequence and compare their counts and tracks."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.people.catalog import BoxTracker, create_detector, create_tracker
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.metrics import MotScores, Track, centroid_distances, mot_scores
from servotrack.estimators.types import Array, Image, Labels

COUNTED_FRAMES = 800
"""Number of first frames in which the paper counts people."""


class Method(NamedTuple):
    """Names of a detector and a filter in `servotrack.baselines.agents.people.catalog`."""

    detector: str
    tracker: str


METHODS: Mapping[str, Method] = {
    "no filter, detector as printed": Method("masked-paper", "no-filter"),
    "GM-PHD, table 1": Method("masked-paper", "gm-phd-paper"),
    "no filter": Method("masked", "no-filter"),
    "GM-PHD, table 1, our detector": Method("masked", "gm-phd-paper"),
    "GM-PHD, tuned": Method("masked", "gm-phd"),
    "CBMeMBer": Method("masked", "gm-cbmember"),
    "Kalman + Hungarian": Method("masked", "kalman-hungarian"),
    "PMB": Method("masked", "pmb"),
}
"""Compared methods: those of the paper, with and without its filter, then filters on our detector."""


@dataclass
class Outcome:
    """Result of one method on one sequence.

    Attributes:
        counts: Number of people reported in each frame. Shape (T,).
        tracks: Reported boxes by identity, px.
        detection_seconds: Median time of the detector per frame, s.
        filter_seconds: Median time of the filter per frame, s.
    """

    counts: Labels
    tracks: list[Track]
    detection_seconds: float
    filter_seconds: float


@dataclass
class Progressing:
    """Estimates of one tracker so far.

    Attributes:
        tracker: Tracker.
        state: State of the tracker; None before the first frame.
        counts: Reported number in each frame.
        steps, boxes: Frames and boxes by identity.
        seconds: Duration of each step, s.
    """

    tracker: BoxTracker
    state: Any = None
    counts: list[int] = field(default_factory=list)
    steps: dict[int, list[int]] = field(default_factory=dict)
    boxes: dict[int, list[Array]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)

    def take(self, frame: int, detections: Detections) -> None:
        """Update with the detections of a frame."""
        begin = time.perf_counter()
        if self.state is None:
            self.state = self.tracker.initial(detections)
        self.state, estimate = self.tracker.step(self.state, detections)
        self.seconds.append(time.perf_counter() - begin)
        self.counts.append(len(estimate.labels))
        for label, box in zip(estimate.labels.tolist(), estimate.states, strict=True):
            self.steps.setdefault(label, []).append(frame)
            self.boxes.setdefault(label, []).append(box)

    def outcome(self, detection_seconds: float) -> Outcome:
        """Return the result, with the detector's time per frame, s."""
        tracks = [Track(np.array(self.steps[label]), np.array(self.boxes[label])) for label in self.steps]
        # The median ignores the first calls, which compile, and short interruptions by other programs.
        return Outcome(np.array(self.counts), tracks, detection_seconds, float(np.median(self.seconds)))


def run_methods(
    frames: Iterable[Image],
    size: tuple[int, int],
    frame_rate: float,
    methods: Mapping[str, Method] = METHODS,
    background: Sequence[Image] | None = None,
) -> dict[str, Outcome]:
    """Run all methods in one pass over the frames. Methods with the same detector share its detections.

    Args:
        frames: RGB frames of one shape, uint8.
        size: Width and height, px.
        frame_rate: Frames per second.
        methods: Methods, keyed by the name in tables.
        background: Frames that initialize the detectors' background; None for the first frame.

    Returns:
        Results, keyed like `methods`.

    Raises:
        ValueError: Unknown detector or tracker, or no frames.
    """
    detectors = {name: create_detector(name) for name in {method.detector for method in methods.values()}}
    states: dict[str, Any] = {}
    seconds: dict[str, list[float]] = {name: [] for name in detectors}
    progress = {name: Progressing(create_tracker(method.tracker, size, frame_rate)) for name, method in methods.items()}
    number = -1
    for number, frame in enumerate(frames):
        found = {}
        for name, detector in detectors.items():
            begin = time.perf_counter()
            if name not in states:
                states[name] = detector.initial(frame if background is None else background)
            states[name], found[name] = detector.step(states[name], frame)
            seconds[name].append(time.perf_counter() - begin)
        for name, method in methods.items():
            progress[name].take(number, found[method.detector])
    if number < 0:
        raise ValueError("frames must hold at least one frame, got none")
    return {
        name: progress[name].outcome(float(np.median(seconds[method.detector]))) for name, method in methods.items()
    }


def count_right(outcome: Outcome, numbers: Labels, frames: int = COUNTED_FRAMES) -> float:
    """Return the share of the first `frames` frames in which the reported number of people is right."""
    return float(np.mean(outcome.counts[:frames] == numbers[:frames]))


def scores(outcome: Outcome, truth: Sequence[Track]) -> MotScores:
    """Return CLEAR MOT, IDF1 and HOTA. Centers match within 0.6 of the true box's height."""
    return mot_scores(truth, outcome.tracks, centroid_distances, 1.2, 0.5)
