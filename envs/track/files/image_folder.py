"""Decoder of a folder of images."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.files.decoder import Decoder, Picture
from servotrack.envs.track.files.images import decode_image
from servotrack.envs.track.files.levels import Levels
from servotrack.envs.track.files.numbering import natural_key, number_images
from servotrack.envs.track.files.recorded import SequenceError

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
_SAMPLES = 16
"""Number of images that tell the range of brightness."""


class ImageFolder(Decoder):
    """A folder of images, in the order of the numbers in their names.

    Args:
        path: Folder.
        name: Name for titles and messages.
        frame_rate: Frames per second; None if unknown.
        counted: True for a MOTChallenge sequence, whose image n is frame n.
        white: Value that is white; None: from the images.
    """

    def __init__(
        self, path: Path, name: str, frame_rate: float | None, counted: bool = False, white: float | None = None
    ) -> None:
        super().__init__(name)
        try:
            names = [entry.name for entry in os.scandir(path) if entry.name.lower().endswith(IMAGE_SUFFIXES)]
        except OSError as error:
            raise SequenceError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
        if not names:
            raise SequenceError(f"{path} holds no images ({', '.join(IMAGE_SUFFIXES)})")
        self._path = path
        self._names = sorted(names, key=natural_key)
        self._numbers, note = number_images(self._names, counted)
        self._levels = Levels(self._samples, white)
        self._numbering_note = note
        self._at, self._stride = 0, 1
        self._start = 0
        self.length, self.frame_rate = int(self._numbers[-1]) + 1, frame_rate

    @property
    def notes(self) -> list[str]:
        """Facts about the images for the user."""
        return [note for note in (self._numbering_note, self._levels.note) if note]

    @property
    def warning(self) -> str:
        """Reason for doubt in the delivered images; empty if there is none."""
        clipped = self._levels.clipped
        return f"{clipped} image(s) hold values outside the range that was found; say which is white" if clipped else ""

    def open(self, start: int = 0, stride: int = 1) -> None:
        """Start at the first wanted image."""
        self._start, self._stride, self._at = start, stride, 0

    def read(self) -> Picture | None:
        """Return the next wanted image; None at the end."""
        while self._at < len(self._names):
            number = int(self._numbers[self._at])
            self._at += 1
            if number >= self._start and (number - self._start) % self._stride == 0:
                file = self._path / self._names[self._at - 1]
                image = self._levels.to_bytes(decode_image(file), str(file))
                return Picture(number, number / self.frame_rate if self.frame_rate else None, image)
        return None

    def close(self) -> None:
        """Do nothing: no file stays open between images."""

    def detail(self, position: int) -> str:
        """Return the file name of an image."""
        return f" ({self._names[int(np.searchsorted(self._numbers, position))]})"

    def _samples(self) -> Iterator[NDArray[Any]]:
        """Yield images from the whole folder."""
        chosen = np.unique(np.linspace(0, len(self._names) - 1, _SAMPLES).round().astype(int))
        for at in chosen.tolist():
            try:
                yield decode_image(self._path / self._names[at])
            except SequenceError:
                # Reading stops at that image, and says why.
                continue
