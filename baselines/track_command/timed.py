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
from servotrack.estimators.validation import as_numbers

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
        period, now = self._period(time)
        # Kept only now: a refusal leaves everything as it was.
        self._state, estimate = self._stepped(detections, period, motion)
        self._time = now
        # Reported people first.
        labels, held = self._small(estimate.labels), self._small(estimate.held_labels)
        return replace(estimate, labels=labels, held_labels=held)

    def _small(self, labels: Labels) -> Labels:
        known = self._ids
        return np.array([known.setdefault(label, len(known) + 1) for label in labels.tolist()], np.int64)

    def _stepped(
        self, detections: Detections, period: float | None, motion: ArrayLike | None
    ) -> tuple[Any, SetEstimate]:
        state = self.tracker.initial(detections) if self._state is None else self._state
        known: dict[str, Any] = {}
        if self._takes_time and period is not None:
            known["dt"] = period
        if self._takes_motion and motion is not None:
            known["motion"] = motion
        if period is not None and not self._takes_time:
            nothing = detections_from_boxes(np.zeros((0, 4)))
            for _ in range(max(round(period * self._rate) - 1, 0)):
                state, _ = self.tracker.step(state, nothing)
        state, estimate = self.tracker.step(state, detections, **known)
        return state, estimate

    def _period(self, time: float | None) -> tuple[float | None, float | None]:
        """Return the time since the last frame, s, None for the nominal one and at the first frame; and the time."""
        before = self._time
        if time is None:
            return None, None if before is None else before + 1.0 / self._rate
        now = as_numbers("time", time)
        if now.ndim or not math.isfinite(now) or (before is not None and now <= before):
            since = "" if before is None else f" and after that of the last frame, {before}"
            raise ValueError(f"time must be a finite number{since}, got {time!r}")
        if before is None:
            return None, float(now)
        period = min(float(now) - before, LONGEST_GAP)
        return None if abs(period * self._rate - 1.0) <= _SAME else period, float(now)


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
