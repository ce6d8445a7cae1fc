"""Frames of videos, image folders, cameras and MOTChallenge folders, behind one iterator."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2

from servotrack.envs.track.files.decoder import Decoder, Picture
from servotrack.envs.track.files.decoders import find_decoder
from servotrack.envs.track.files.images import MAX_SIDE, to_rgb
from servotrack.envs.track.files.recorded import MAX_FRAME, SequenceError
from servotrack.estimators.types import Image

SIDES = (8, MAX_SIDE)
"""Range of width and height for resized frames, px."""


class NumberedFrame(NamedTuple):
    """One frame of a sequence.

    Attributes:
        number: Number of the frame in the source, from 0. Frames that are missing or cannot be decoded leave gaps.
        time: Time since frame 0, s: the time stamp of the file, or of arrival for a camera; None if unknown.
        image: RGB, uint8, shape (H, W, 3).
    """

    number: int
    time: float | None
    image: Image


class FrameSource:
    """Frames of a sequence: RGB, uint8, all of the same size. Made by `open_frames`.

    Every iteration starts at the first frame; only a camera or an address continues. Frames are decoded one by one and
    not kept; videos are decoded in a process of their own, which a damaged file may end. Gray images get three equal
    channels, images of more than 8 bits or of floats are scaled to 0..255 by the range of their values, alpha is
    dropped, and the orientation tag of a camera is not applied. If the size changes within a video, OpenCV 4.13 and
    later resize to the size of the first frame, and earlier versions deliver damaged frames; in a folder it is an
    error. A frame has at most 16384 px per side, an image file at most 1 GiB, and a sequence that is not live at most
    10 million frames.

    Attributes:
        name: Name for titles and messages.
        frame_rate: Frames of the source per second; None if unknown.
        source_size: Width and height of the decoded frames, px.
        size: Width and height of the delivered frames, px.
        length: Number of frames that the source claims, missing ones included; None if unknown. It can be wrong.
        live: True for a camera or an address.
        warning: Reasons for doubt in the last iteration: an early end, or missing frames; empty without any.
    """

    def __init__(
        self, decoder: Decoder, width: int | None, height: int | None, start: int, count: int | None, stride: int
    ) -> None:
        self._decoder = decoder
        self._start, self._count, self._stride = start, count, stride
        self.name, self.live, self.warning = decoder.name, decoder.live, ""
        self._pending: Picture | None = None
        try:
            # A live source does not come back to its first frame.
            decoder.open(start if self.live else 0, stride if self.live else 1)
            first = decoder.read()
        except BaseException:
            decoder.close()
            raise
        if first is None:
            decoder.close()
            raise SequenceError(f"{self.name} holds no frame that can be decoded; check that a video player opens it")
        to_rgb(first.image, self.name)
        self.length, self.frame_rate = decoder.length, decoder.frame_rate
        self.source_size = (first.image.shape[1], first.image.shape[0])
        self.size = resized(self.source_size, width, height)
        if self.live:
            self._pending = first
        else:
            decoder.close()

    @property
    def notes(self) -> Sequence[str]:
        """Facts about the source for the user."""
        return self._decoder.notes

    def __iter__(self) -> Iterator[Image]:
        """Yield the images of `numbered`."""
        return (frame.image for frame in self.numbered())

    def numbered(self) -> Iterator[NumberedFrame]:
        """Yield the frames from `start` on, with their numbers.

        Raises:
            SequenceError: If there is no frame, or a frame cannot be decoded or differs in size from the first one.
        """
        decoder, self.warning = self._decoder, ""
        gaps = _Gaps(self._start, self._stride)
        delivered = 0
        try:
            decoder.open(self._start, self._stride)
            while self._count is None or delivered < self._count:
                picture, self._pending = self._pending or decoder.read(), None
                if picture is None:
                    break
                if picture.number >= MAX_FRAME and not self.live:
                    raise SequenceError(f"{self.name} holds more than {MAX_FRAME} frames; split it")
                gaps.add(picture.number)
                yield NumberedFrame(picture.number, picture.time, self._deliver(picture))
                delivered += 1
            else:
                self.warning = self._doubts(gaps)
                return
        finally:
            if not self.live:
                decoder.close()
        self._check_end(gaps, delivered)

    def held(self) -> Iterator[Image]:
        """Yield one image for each wanted number; where a frame is missing, the image before it again.

        Raises:
            SequenceError: As `numbered`.
        """
        expected, last = self._start, None
        for frame in self.numbered():
            for _ in range((frame.number - expected) // self._stride):
                yield frame.image if last is None else last
            yield frame.image
            expected, last = frame.number + self._stride, frame.image

    def close(self) -> None:
        """Close the camera or file."""
        self._decoder.close()

    def _deliver(self, picture: Picture) -> Image:
        image = picture.image
        where = f"{self.name}, frame {picture.number}{self._decoder.detail(picture.number)}"
        if (image.shape[1], image.shape[0]) != self.source_size:
            raise SequenceError(
                f"{where}: it has {image.shape[1]}x{image.shape[0]} px, the first one "
                f"{self.source_size[0]}x{self.source_size[1]}; resize all frames to one size"
            )
        return resize(to_rgb(image, where), self.size)

    def _doubts(self, gaps: _Gaps, end: str = "") -> str:
        return "; ".join(text for text in (end, gaps.text(self.name), self._decoder.warning) if text)

    def _check_end(self, gaps: _Gaps, delivered: int) -> None:
        end = gaps.last + 1 if self._decoder.end is None else self._decoder.end
        if delivered == 0:
            raise SequenceError(
                f"{self.name} ends after {end} frame(s), before the first wanted one; start was {self._start}"
            )
        claimed, text = self.length, ""
        if self.live:
            text = f"{self.name} delivers no more frames after frame {end}"
        elif claimed is not None and claimed - end > max(2, claimed // 100):
            text = (
                f"{self.name}: no frame can be decoded after frame {end - 1}, though {claimed} are claimed; "
                "the file is truncated or damaged, or its count is wrong"
            )
        self.warning = self._doubts(gaps, text)


class _Gaps:
    """Wanted frames that did not come."""

    def __init__(self, start: int, stride: int) -> None:
        self._stride = stride
        self.last, self._expected = start - 1, start
        self._count, self._first = 0, -1

    def add(self, number: int) -> None:
        """Add a frame that came."""
        missing = (number - self._expected) // self._stride
        if missing and not self._count:
            self._first = self._expected
        self._count += missing
        self.last, self._expected = number, number + self._stride

    def text(self, name: str) -> str:
        """Return the warning; empty without missing frames."""
        if not self._count:
            return ""
        return (
            f"{name}: {self._count} frame(s) are missing or cannot be decoded, the first is frame {self._first}; "
            "the others keep their numbers"
        )


def open_frames(
    source: str | Path | int,
    *,
    width: int | None = None,
    height: int | None = None,
    start: int = 0,
    count: int | None = None,
    stride: int = 1,
    white: float | None = None,
) -> FrameSource:
    """Open the frames of a sequence.

    Args:
        source: Video file, folder of images (sorted by the numbers in their names), folder of a MOTChallenge sequence,
            index of a camera, or an address that begins with http, https, rtsp or rtsps. A video file is one regular
            file in a container such as MP4, AVI, Matroska, MPEG or Ogg; playlists and scripts that name other files are
            refused.
        width: Width to which frames are resized, px; None: follows from `height`, or no resizing.
        height: Height to which frames are resized, px; None: follows from `width`, or no resizing.
        start: First frame, counted from 0.
        count: Maximum number of frames; None: all.
        stride: Use every N-th frame.
        white: Value that is white in images of more than 8 bits or of floats; None: the smallest of 1, 255, 1023, 4095,
            16383 and 65535 that holds the values of 16 images of the folder.

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
    if white is not None and not (math.isfinite(white) and white > 0):
        raise ValueError(f"white must be finite and > 0, got {white!r}")
    return FrameSource(find_decoder(source, white), width, height, int(start), count, int(stride))


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
