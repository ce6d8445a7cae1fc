"""Sentences of a detector on what does not work, each said when it begins and counted when it returns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from servotrack.estimators.types import Array

_OFTEN, _LEAST = 0.1, 5
"""Share and number of the frames from which a motion of the camera is said."""


def kind_of(sentence: str) -> str:
    """Return a sentence without its numbers: notices that differ in numbers only are the same."""
    return re.sub(r"\d[\d.,]*", "#", sentence)


class Notices:
    """Notices of the states of a detector."""

    def __init__(self) -> None:
        self._first: dict[str, str] = {}
        self._frames: dict[str, int] = {}
        self.begun = False

    def take(self, number: int, state: Any) -> None:
        """Read the notice of a state, if its detector has any.

        Args:
            number: Number of the frame, from 0.
            state: State of the detector after the frame.
        """
        self.begun = True
        text = getattr(state, "notice", "")
        if not text:
            return
        kind = kind_of(text)
        if kind not in self._first:
            self._first[kind] = f"from frame {number} on: {text}"
        self._frames[kind] = self._frames.get(kind, 0) + 1

    def lines(self) -> list[str]:
        """Return one line per notice, with the number of frames that it holds for."""
        return [f"{text} ({self._frames[kind]} frames)" for kind, text in self._first.items()]


class CameraReport:
    """Motion of the camera over a run, for the user."""

    def __init__(self) -> None:
        self._shifts: list[float] = []
        self._unknown, self._first = 0, -1

    def take(self, number: int, motion: Array | None, shape: Sequence[int]) -> None:
        """Read the motion of the camera of a frame.

        Args:
            number: Number of the frame, from 0.
            motion: See `PictureMotion.step`.
            shape: Height and width of the frame, px.
        """
        if motion is None:
            self._unknown += 1
            return
        middle = np.array([shape[1] / 2.0, shape[0] / 2.0])
        length = float(np.hypot(*(motion[:, :2] @ middle + motion[:, 2] - middle))) / shape[1]
        if length > 0.0 and self._first < 0:
            self._first = number
        self._shifts.append(length)

    def lines(self) -> list[str]:
        """Return one sentence where the camera moved, or where its motion is unknown in many frames."""
        lines, moved = [], [100.0 * shift for shift in self._shifts if shift > 0.0]
        if len(moved) >= max(_LEAST, _OFTEN * len(self._shifts)):
            lines.append(
                f"the camera moves from frame {self._first} on, by {np.median(moved):.2f} % of the width in the median "
                f"of {len(moved)} frames, {max(moved):.1f} % at most; of the trackers, only `pmb` allows for it"
            )
        # The motion of the first frame is never known.
        if self._unknown - 1 >= max(_LEAST, _OFTEN * (len(self._shifts) + self._unknown)):
            lines.append(
                f"the motion of the camera is unknown in {self._unknown - 1} frames, which show too little background "
                "with texture; there it is taken from the tracks"
            )
        return lines


class NewNotes:
    """Notes of a source that are new since the last call, frame by frame."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def of(self, notes: Sequence[str]) -> list[str]:
        """Return the notes of new kinds; the next call leaves them out.

        Args:
            notes: All notes so far.
        """
        new = {kind_of(note): note for note in notes if kind_of(note) not in self._said}
        self._said.update(new)
        return list(new.values())
