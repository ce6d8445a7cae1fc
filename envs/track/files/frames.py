"""Frames of recorded and live sequences: one iterator over videos, image folders, cameras and MOTChallenge folders."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from servotrack.envs.track.files.decoders import Decoder, find_decoder, to_rgb
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Image

SIDES = (8, 16384)
"""Smallest and largest side that frames may be resized to, px."""


class FrameSource:
    """The frames of a sequence, RGB, uint8, all of one size; `open_frames` makes it.

    Every iteration starts anew at the first frame, except over a camera, which goes on. Frames are decoded one by one;
    none is kept. Gray images get three equal channels, of 16-bit images the high byte counts, alpha is dropped, and
    an orientation that a camera noted is not applied. OpenCV brings a video whose size changes to that of its first
    frame; in a folder such a change is an error.

    Attributes:
        name: For titles and messages.
        frame_rate: Frames of the source per second; None where it does not tell.
        source_size: Width and height as decoded, px.
        size: Width and height of the frames that are delivered, px.
        length: Frames that the source claims to have; None where it does not tell. It may lie.
        live: Whether it is a camera.
        warning: Why the newest iteration ended earlier than the source claims; empty where it did not.
    """

    def __init__(
        self, decoder: Decoder, width: int | None, height: int | None, start: int, count: int | None, stride: int
    ) -> None:
        self._decoder = decoder
        self._start, self._count, self._stride = start, count, stride
        self.name, self.live, self.warning = decoder.name, decoder.live, ""
        try:
            decoder.open()
            first = decoder.read()
        except BaseException:
            decoder.close()
            raise
        if first is None:
            decoder.close()
            raise SequenceError(f"{self.name} holds no frame that can be decoded; check that it plays elsewhere")
        to_rgb(first, self.name)
        self.length, self.frame_rate = decoder.length, decoder.frame_rate
        self.source_size = (first.shape[1], first.shape[0])
        self.size = resized(self.source_size, width, height)
        if not self.live:
            decoder.close()

    def __iter__(self) -> Iterator[Image]:
        """Frames, from `start` on.

        Raises:
            SequenceError: A frame that cannot be decoded, or of another size than the first; no frame at all.
        """
        decoder, self.warning = self._decoder, ""
        position = delivered = 0
        try:
            decoder.open()
            while self._count is None or delivered < self._count:
                wanted = position >= self._start and (position - self._start) % self._stride == 0
                if not wanted:
                    if not decoder.skip():
                        break
                    position += 1
                    continue
                image = decoder.read()
                if image is None:
                    break
                yield self._deliver(image, position)
                position += 1
                delivered += 1
            else:
                return
        finally:
            if not self.live:
                decoder.close()
        self._check_end(position, delivered)

    def close(self) -> None:
        """Let go of the camera or file."""
        self._decoder.close()

    def _deliver(self, image: NDArray[Any], position: int) -> Image:
        where = f"{self.name}, frame {position}{self._decoder.detail(position)}"
        if (image.shape[1], image.shape[0]) != self.source_size:
            raise SequenceError(
                f"{where}: it has {image.shape[1]}x{image.shape[0]} px, the first one "
                f"{self.source_size[0]}x{self.source_size[1]}; bring all to one size"
            )
        return resize(to_rgb(image, where), self.size)

    def _check_end(self, position: int, delivered: int) -> None:
        if delivered == 0:
            raise SequenceError(
                f"{self.name} ends after {position} frame(s), before the first wanted one; start was {self._start}"
            )
        claimed = self.length
        if self.live:
            self.warning = f"{self.name} delivers no more frames after frame {position}"
        elif claimed is not None and claimed - position > max(2, claimed // 100):
            self.warning = (
                f"{self.name}: no frame can be decoded after frame {position - 1}, though {claimed} are claimed; "
                "the file is truncated or damaged, or its count is wrong"
            )


def open_frames(
    source: str | Path | int,
    *,
    width: int | None = None,
    height: int | None = None,
    start: int = 0,
    count: int | None = None,
    stride: int = 1,
) -> FrameSource:
    """Open a sequence.

    Args:
        source: A video file, a folder of images (taken in the order of the numbers in their names), the folder of a
            MOTChallenge sequence, or a camera's index.
        width: Resize to this, px; with only one of the two, the shape is kept.
        height: Resize to this, px.
        start: First frame, counted from 0.
        count: Most frames; None for all.
        stride: Take every so manieth frame.

    Raises:
        SequenceError: Nothing there, nothing in it, or nothing that can be decoded.
        ValueError: Another argument out of its range.
    """
    for name, value, low, high in (
        ("width", width, *SIDES),
        ("height", height, *SIDES),
        ("start", start, 0, math.inf),
        ("count", count, 1, math.inf),
        ("stride", stride, 1, math.inf),
    ):
        if value is not None and (isinstance(value, bool) or int(value) != value or not low <= value <= high):
            raise ValueError(f"{name} must be a whole number from {low} to {high}, got {value!r}")
    return FrameSource(find_decoder(source), width, height, int(start), count, int(stride))


def resize(image: Image, size: tuple[int, int]) -> Image:
    """An image brought to (width, height), by areas where it shrinks; itself where it has that size."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    shrinks = size[0] < image.shape[1] or size[1] < image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)  # type: ignore[return-value]


def resized(size: tuple[int, int], width: int | None, height: int | None) -> tuple[int, int]:
    """The size that frames of `size` are brought to; with only one side given, the shape is kept; px."""
    if width is None and height is None:
        return size
    if width is None:
        assert height is not None
        width = max(round(size[0] * height / size[1]), 1)
    elif height is None:
        height = max(round(size[1] * width / size[0]), 1)
    return int(width), int(height)
