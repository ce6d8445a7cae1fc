"""Sentences of a detector on what does not work, each said when it begins and counted when it returns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any


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
