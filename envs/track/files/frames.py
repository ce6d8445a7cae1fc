"""Frames of videos, image folders, cameras and MOTChallenge folders, behind one iterator."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from servotrack.envs.track.files.decoders import Decoder, find_decoder
from servotrack.envs.track.files.images import MAX_SIDE, to_rgb
from servotrack.envs.track.files.recorded import MAX_FRAME, SequenceError
from servotrack.estimators.types import Image

SIDES = (8, MAX_SIDE)
"""Range of width and height for resized frames, px."""


class FrameSource:
    """Frames of a sequence: RGB, uint8, all of the same size. Made by `open_frames`.

    Every iteration starts at the first frame; only a camera continues. Frames are decoded one by one and not kept. Gray
    images get three equal channels, of 16-bit images the high byte is used, alpha is dropped, and the orientation tag
    of a camera is not applied. If the size changes within a video, OpenCV 4.13 and later resize to the size of the
    first frame, and earlier versions deliver damaged frames; in a folder it is an error. A frame has at most 16384 px
    per side, an image file at most 1 GiB, and a sequence that is not live at most 10 million frames.

    Attributes:
        name: Name for titles and messages.
        frame_rate: Frames of the source per second; None if unknown.
        source_size: Width and height of the decoded frames, px.
        size: Width and height of the delivered frames, px.
        length: Number of frames that the source claims; None if unknown. The claim can be wrong.
        live: True for a camera.
        warning: Reason why the last iteration ended earlier than the source claims; empty if it did not.
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
            raise SequenceError(f"{self.name} holds no frame that can be decoded; check that a video player opens it")
        to_rgb(first, self.name)
        self.length, self.frame_rate = decoder.length, decoder.frame_rate
        self.source_size = (first.shape[1], first.shape[0])
        self.size = resized(self.source_size, width, height)
        if not self.live:
            decoder.close()

    def __iter__(self) -> Iterator[Image]:
        """Yield the frames from `start` on.

        Raises:
            SequenceError: If there is no frame, or a frame cannot be decoded or differs in size from the first one.
        """
        decoder, self.warning = self._decoder, ""
        position = delivered = 0
        try:
            decoder.open()
            while self._count is None or delivered < self._count:
                if position == MAX_FRAME and not self.live:
                    raise SequenceError(f"{self.name} holds more than {MAX_FRAME} frames; split it")
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
        """Close the camera or file."""
        self._decoder.close()

    def _deliver(self, image: NDArray[Any], position: int) -> Image:
        where = f"{self.name}, frame {position}{self._decoder.detail(position)}"
        if (image.shape[1], image.shape[0]) != self.source_size:
            raise SequenceError(
                f"{where}: it has {image.shape[1]}x{image.shape[0]} px, the first one "
                f"{self.source_size[0]}x{self.source_size[1]}; resize all frames to one size"
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
    """Open the frames of a sequence.

    Args:
        source: Video file, folder of images (sorted by the numbers in their names), folder of a MOTChallenge sequence,
            or index of a camera. A video file is one regular file in a container such as MP4, AVI, Matroska, MPEG or
            Ogg; playlists and scripts that name other files are refused.
        width: Width to which frames are resized, px; None: follows from `height`, or no resizing.
        height: Height to which frames are resized, px; None: follows from `width`, or no resizing.
        start: First frame, counted from 0.
        count: Maximum number of frames; None: all.
        stride: Use every N-th frame.

    Returns:
        Iterable over the frames.

    Raises:
        SequenceError: If the source does not exist, is empty or cannot be decoded.
        ValueError: If another argument is out of its range.
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
    """Resize an image to (width, height): area averaging when a side shrinks, otherwise bilinear interpolation."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    shrinks = size[0] < image.shape[1] or size[1] < image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)  # type: ignore[return-value]


def resized(size: tuple[int, int], width: int | None, height: int | None) -> tuple[int, int]:
    """Return the resized (width, height) of frames, px. With only one side given, the aspect ratio is kept."""
    if width is None and height is None:
        return size
    if width is None:
        assert height is not None
        width = max(round(size[0] * height / size[1]), 1)
    elif height is None:
        height = max(round(size[1] * width / size[0]), 1)
    return int(width), int(height)
