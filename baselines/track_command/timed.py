"""A tracker with its state and its clock: time stamps for trackers that take them, empty frames for the others."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.people.catalog import BoxTracker
from servotrack.baselines.track_command.inputs import Input, Step
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Labels

LONGEST_GAP = 60.0
"""Longest time that is bridged, s. No tracker keeps a track for longer."""
_SAME = 1e-6
"""Largest difference between a period and the nominal one that is rounding, relative."""


class TimedTracker:
    """A tracker of boxes with the times of the frames, and with small numbers as identities.

    Args:
        tracker: The tracker.
        frame_rate: Nominal frames per second.
    """

    def __init__(self, tracker: BoxTracker, frame_rate: float) -> None:
        self.tracker, self._rate = tracker, frame_rate
        self._state: Any = None
        self._time: float | None = None
        self._takes_time = takes(tracker, "dt")
        self._takes_motion = takes(tracker, "motion")
        self._ids: dict[int, int] = {}

    def step(self, detections: Detections, time: float | None = None, motion: ArrayLike | None = None) -> SetEstimate:
        """Process the detections of one frame.

        Identities count from 1 in the order of their first report. Labels of filters can exceed what readers of
        tracks take.

        Args:
            detections: The detections.
            time: Time of the frame, s, on any scale; None: one period after the last frame.
            motion: Motion of the picture by the camera, see `BoxPMB.step`; None where it is unknown. Trackers that do
                not take it see moving people.

        Raises:
            ValueError: The time is not after that of the last frame, or the motion is no similarity.
        """
        estimate = self._stepped(detections, self._period(time), motion)
        # Reported people first.
        labels, held = self._small(estimate.labels), self._small(estimate.held_labels)
        return replace(estimate, labels=labels, held_labels=held)

    def _small(self, labels: Labels) -> Labels:
        known = self._ids
        return np.array([known.setdefault(label, len(known) + 1) for label in labels.tolist()], np.int64)

    def _stepped(self, detections: Detections, period: float | None, motion: ArrayLike | None) -> SetEstimate:
        if self._state is None:
            self._state = self.tracker.initial(detections)
        known: dict[str, Any] = {}
        if self._takes_time and period is not None:
            known["dt"] = period
        if self._takes_motion and motion is not None:
            known["motion"] = motion
        if period is not None and not self._takes_time:
            nothing = detections_from_boxes(np.zeros((0, 4)))
            for _ in range(max(round(period * self._rate) - 1, 0)):
                self._state, _ = self.tracker.step(self._state, nothing)
        self._state, estimate = self.tracker.step(self._state, detections, **known)
        return estimate

    def _period(self, time: float | None) -> float | None:
        """Return the time since the last frame, s; None for the nominal one and at the first frame."""
        before = self._time
        if time is None:
            self._time = None if before is None else before + 1.0 / self._rate
            return None
        if not math.isfinite(time) or (before is not None and time <= before):
            raise ValueError(f"time must be finite and after that of the last frame, {before}, got {time!r}")
        self._time = float(time)
        if before is None:
            return None
        period = min(time - before, LONGEST_GAP)
        return None if abs(period * self._rate - 1.0) <= _SAME else period


def takes(tracker: BoxTracker, name: str) -> bool:
    """Return True if the `step` of a tracker, and of the one that it holds, takes a parameter of this name."""
    if name not in inspect.signature(tracker.step).parameters:
        return False
    inner = getattr(tracker, "tracker", None)
    return inner is None or takes(inner, name)


def estimates(source: Input, tracker: TimedTracker) -> Iterator[tuple[Step, SetEstimate]]:
    """Yield every step of a source with its tracks, in px of the source.

    Raises:
        SequenceError: The source is broken.
    """
    factor = np.array([*source.scale, *source.scale])
    for step in source:
        estimate = tracker.step(step.detections, step.time, step.motion)
        yield step, replace(estimate, states=estimate.states * factor, held_states=estimate.held_states * factor)
