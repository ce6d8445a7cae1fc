"""Sentences of a detector on what does not work, each said when it begins and counted when it returns."""

from __future__ import annotations

from typing import Any

_HEAD = 4
"""Number of first words that make two sentences the same notice; later ones hold numbers that change."""


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
        kind = " ".join(text.split()[:_HEAD])
        if kind not in self._first:
            self._first[kind] = f"from frame {number} on: {text}"
        self._frames[kind] = self._frames.get(kind, 0) + 1

    def lines(self) -> list[str]:
        """Return one line per notice, with the number of frames that it holds for."""
        return [f"{text} ({self._frames[kind]} frames)" for kind, text in self._first.items()]
