"""Recorder for pictures of tracking in video: trails of identities, numbers of people, errors."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from servotrack.envs.drawing.plots import TRAIL_LENGTH
from servotrack.envs.track.people.box_paint import BoxTrail
from servotrack.envs.track.people.box_render import BoxScene
from servotrack.envs.track.people.place_paint import PlaceMark
from servotrack.estimators.types import Array, Image


class BoxRecorder:
    """Recorder with bounded memory. Call `record` after every answer and `reset` before a new episode.

    Args:
        horizon: Number of frames that the plots span.
    """

    def __init__(self, horizon: int = 300) -> None:
        self._horizon = horizon
        self.reset()

    def reset(self) -> None:
        """Clear all stored frames."""
        self._frame = 0
        self._past: dict[int, deque[Array]] = {}
        self._last_seen: dict[int, int] = {}
        self._now: list[tuple[int, bool]] = []
        self._reported: deque[float] = deque(maxlen=self._horizon)
        self._true: deque[float] = deque(maxlen=self._horizon)
        self._errors: deque[float] = deque(maxlen=self._horizon)
        self._intervals: deque[tuple[int, int]] = deque(maxlen=self._horizon)

    def record(
        self,
        labels: ArrayLike,
        states: ArrayLike,
        reported: ArrayLike | None = None,
        true_number: int | None = None,
        error: float | None = None,
        interval: tuple[int, int] | None = None,
    ) -> None:
        """Store the answer to one frame.

        Args:
            labels: Identity of each row, shape (k,); negative for an unused row.
            states: Boxes, shape (k, 4), or points, shape (k, 2), px.
            reported: True for reported rows, False for identities that are only held, shape (k,); None: all reported.
            true_number: True number of people, if known.
            error: Error of the answer, if known.
            interval: Interval of the number of people, if known.
        """
        names = np.asarray(labels, dtype=np.int64).tolist()
        rows = np.array(states, dtype=np.float64)
        flags = [True] * len(names) if reported is None else np.asarray(reported, dtype=bool).tolist()
        self._now = []
        for name, row, flag in zip(names, rows, flags, strict=True):
            if name < 0:
                continue
            self._past.setdefault(name, deque(maxlen=TRAIL_LENGTH)).append(row)
            self._last_seen[name] = self._frame
            self._now.append((name, flag))
        for name in [name for name, seen in self._last_seen.items() if self._frame - seen >= TRAIL_LENGTH]:
            del self._past[name], self._last_seen[name]
        self._frame += 1
        self._reported.append(float(sum(flag for _, flag in self._now)))
        if true_number is not None:
            self._true.append(float(true_number))
        if error is not None:
            self._errors.append(float(error))
        if interval is not None:
            self._intervals.append(interval)

    def trails(self) -> tuple[list[BoxTrail], list[BoxTrail]]:
        """Return the trails of reported identities, and of those that are held without being reported."""
        both: tuple[list[BoxTrail], list[BoxTrail]] = ([], [])
        for name, flag in self._now:
            both[0 if flag else 1].append(BoxTrail(name, np.array(self._past[name])))
        return both

    def scene(
        self,
        frame: Image,
        truth: Array | None = None,
        detections: Array | None = None,
        title: str = "people",
        error_name: str = "ospa",
        cutoff: float = 1.0,
        places: Sequence[PlaceMark] = (),
    ) -> BoxScene:
        """Return the input of `box_render.draw` for the last answered frame.

        Args:
            frame: RGB or gray, uint8.
            truth: True boxes or points to show, px.
            detections: Found boxes or points to show, px.
            title: Title of the plot of numbers.
            error_name: Name of the error metric.
            cutoff: Largest error.
            places: Counting zones and lines to show.
        """
        reported, held = self.trails()
        empty = np.empty((0, 4))
        return BoxScene(
            frame=frame,
            reported=reported,
            held=held,
            truth=empty if truth is None else truth,
            detections=empty if detections is None else detections,
            reported_numbers=np.array(self._reported),
            true_numbers=np.array(self._true) if self._true else None,
            errors=np.array(self._errors) if self._errors else None,
            error_name=error_name,
            cutoff=cutoff,
            horizon=self._horizon,
            title=title,
            places=places,
            intervals=np.array(self._intervals) if self._intervals else None,
        )
