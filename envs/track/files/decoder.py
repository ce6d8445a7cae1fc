"""Interface of the decoders of video files, cameras and image folders."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

from numpy.typing import NDArray


class Picture(NamedTuple):
    """Decoded image.

    Attributes:
        number: Number of the frame in the source, from 0.
        time: Time since frame 0, s; None if unknown.
        image: Pixels in OpenCV's format, uint8.
    """

    number: int
    time: float | None
    image: NDArray[Any]


class Decoder(ABC):
    """Source of decoded images, one by one. It can be opened again after `close`.

    Attributes:
        name: Name for titles and messages.
        live: True if the source cannot restart.
        length: Number of images that the source claims, once open; None if unknown.
        frame_rate: Frames per second, once open; None if unknown.
        notes: Facts about the source for the user.
        warning: Reason for doubt in the images so far; empty if there is none.
        end: Number after that of the last frame, at the end; None if it is that of the last delivered one.
    """

    live = False
    length: int | None = None
    frame_rate: float | None = None
    end: int | None = None

    def __init__(self, name: str) -> None:
        self.name = name

    @property
    def notes(self) -> Sequence[str]:
        """Facts about the source for the user."""
        return ()

    @property
    def warning(self) -> str:
        """Reason for doubt in the images so far; empty if there is none."""
        return ""

    @abstractmethod
    def open(self, start: int = 0, stride: int = 1) -> None:
        """Open the source.

        Args:
            start: Number of the first wanted image, from 0.
            stride: Every stride-th number from there is wanted.
        """

    @abstractmethod
    def read(self) -> Picture | None:
        """Return the next wanted image; None at the end."""

    @abstractmethod
    def close(self) -> None:
        """Close files."""

    def detail(self, position: int) -> str:
        """Return additional text for messages about an image, e.g. its file name."""
        return ""
