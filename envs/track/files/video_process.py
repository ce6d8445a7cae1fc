"""Program that decodes a video in a process of its own; `remote.VideoProcess` starts it.

It imports nothing of the package, so that it starts in the time that OpenCV takes to load. Requests are lines of JSON
on the standard input, answers are a JSON object behind the two lengths of `HEADER`, and the pixels of a frame.
"""

from __future__ import annotations

import os
import sys

if __name__ == "__main__" and sys.path[:1] == [os.path.dirname(os.path.abspath(__file__))]:
    # The folder of this file, whose modules could shadow others.
    del sys.path[0]

import json
import math
import signal
import struct
import time
from typing import Any, BinaryIO, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

HEADER = struct.Struct("<II")
"""Lengths of the JSON object and of the pixels of an answer, bytes."""
OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_ATTEMPTS = 5
"""Number of failed reads in a row after which a sequence of unknown length has ended."""
_MOST_ATTEMPTS = 1000
"""The same while the file claims that more frames follow."""
_TIMEOUT = 10_000
"""Time-out of OpenCV for opening a file or reading a frame, ms."""
_BUSY_INTERVAL = 1.0
"""Time between two signs of life while frames are skipped, s."""
_PACKETS = 64
"""Number of packets that tell whether the frame rate is constant."""
_REGULAR = 0.8
"""Share of their stamps that must lie on the grid of the frame rate."""
_REORDERED = 32
"""Largest number of frames by which decoders reorder."""
_ROUNDING = 1.5e-3
"""Largest error of a time stamp that counts as rounding, s."""


class Grabbed(NamedTuple):
    """Frame that was decoded.

    Attributes:
        number: Number of the frame, from 0. Frames that cannot be decoded have numbers, too.
        time: Time since frame 0, s; None if the container has no usable time stamps.
        image: Pixels if they were converted already; None if `NumberedCapture.image` has to convert them.
    """

    number: int
    time: float | None
    image: NDArray[Any] | None = None


class Clock(NamedTuple):
    """Time stamps of a stream of constant frame rate: frame n has the stamp `origin` + n / rate.

    Attributes:
        origin: Stamp of frame 0, s.
        stamped: True if the container stores the stamps. AVI counts chunks, and a decoder that reorders frames delays
            its stamps.
        lead: Number of frames that fit before the first stamp on the container's own scale.
    """

    origin: float
    stamped: bool
    lead: int = 0


class NumberedCapture:
    """OpenCV's VideoCapture with the numbers of the frames in the file.

    OpenCV only counts the frames that it delivers. Here a frame that fails to decode leaves a gap in the numbers. In a
    stream of constant frame rate the numbers follow the time stamps: the first frames of a cut recording and frames
    that the decoder drops leave gaps, too, and a frame with the stamp of an earlier one is left out.

    Args:
        capture: Opened VideoCapture.
        clock: Time stamps; None where the frame rate varies or is unknown.

    Attributes:
        clock: Time stamps; None where the frame rate varies or is unknown.
        rate: Frames per second; None if unknown.
        length: Claimed number of frames; None if unknown.
        next: Number after that of the last frame.
        repeated: Number of frames left out for their stamps.
    """

    def __init__(self, capture: Any, clock: Clock | None = None) -> None:
        self._capture = capture
        self.clock = clock
        self.rate = _rate(capture)
        length = self._property(cv2.CAP_PROP_FRAME_COUNT)
        self.length = int(length) if 1.0 <= length < 2**31 else None
        self.next = self.repeated = 0
        self._last: float | None = None
        self._ahead: tuple[float, int] | None = None

    def grab(self) -> Grabbed | None:
        """Advance to the next frame that can be decoded; None at the end."""
        while (advanced := self._advance()) is not None:
            stamp, failures = advanced
            if self.clock is not None and self.next == 0 and not (failures or self.clock.stamped):
                self.clock = self.clock._replace(origin=stamp)
            by_time, image = self._by_time(stamp), None
            number = self.next + failures
            if by_time is not None:
                if by_time < self.next and stamp > 0.0:
                    self.repeated += 1
                    continue
                if by_time > self.next and not failures:
                    image = self.image()
                    number = by_time if self._goes_on(by_time) else number
                elif by_time >= self.next:
                    number = by_time
            elif failures and self.rate is not None and self._last is not None:
                number = self.next - 1 + self._bounded(round((stamp - self._last) * self.rate), 1 + failures)
            self._last, self.next = stamp, number + 1
            return Grabbed(number, self._seconds(stamp, number), image)
        return None

    def image(self) -> NDArray[Any] | None:
        """Return the pixels of the grabbed frame; None if they cannot be converted."""
        delivered, image = self._capture.retrieve()
        return image if delivered and image is not None and image.size else None

    def _advance(self) -> tuple[float, int] | None:
        """Return the stamp of the next frame, s, and the number of failures before it."""
        if self._ahead is not None:
            ahead, self._ahead = self._ahead, None
            return ahead
        failures = 0
        while not self._capture.grab():
            failures += 1
            if failures >= self._patience():
                return None
        return self._property(cv2.CAP_PROP_POS_MSEC) / 1e3, failures

    def _by_time(self, stamp: float) -> int | None:
        if self.clock is None or self.rate is None:
            return None
        number = round((stamp - self.clock.origin) * self.rate)
        most = self.next + 10 * round(self.rate) if self.length is None else max(self.length, self.next + 1)
        return number if number < most else None

    def _goes_on(self, number: int) -> bool:
        """Return True if the next frame's stamp confirms that this frame has the given number, not a damaged stamp."""
        self._ahead = self._advance()
        if self._ahead is None:
            return True
        following = self._by_time(self._ahead[0])
        return following is not None and following > number

    def _seconds(self, stamp: float, number: int) -> float | None:
        if self.clock is not None and self.rate is not None:
            return number / self.rate
        return stamp if stamp > 0.0 or number == 0 else None

    def _patience(self) -> int:
        left = 0 if self.length is None else self.length - self.next
        return min(max(left, _ATTEMPTS), _MOST_ATTEMPTS)

    def _bounded(self, frames: int, otherwise: int) -> int:
        most = 10 * round(self.rate or 25.0) if self.length is None else self.length - self.next + 1
        return frames if 1 <= frames <= most else otherwise

    def _property(self, which: int) -> float:
        value = float(self._capture.get(which))
        return value if math.isfinite(value) else -1.0


def _rate(capture: Any) -> float | None:
    rate = float(capture.get(cv2.CAP_PROP_FPS))
    return rate if math.isfinite(rate) and 0.1 <= rate <= 1000.0 else None


def read_clock(packets: Any, stamped: bool) -> Clock | None:
    """Return the time stamps of a stream; None if its frame rate varies or differs from the claimed one.

    Args:
        packets: VideoCapture of the same file that delivers packets instead of images. It is used up.
        stamped: True if the container stores stamps.
    """
    rate = _rate(packets)
    if rate is None:
        return None
    found = [
        (packets.get(cv2.CAP_PROP_POS_MSEC) / 1e3, packets.get(cv2.CAP_PROP_PTS))
        for _ in range(_PACKETS)
        if packets.grab()
    ]
    if not found:
        return None
    stamps, counts = np.array(found).T
    steps = np.diff(np.sort(stamps)) * rate
    # The grid of most stamps, because damaged ones can be anywhere.
    nearest = [np.abs((stamps - origin) * rate - np.rint((stamps - origin) * rate)) for origin in stamps]
    fits = [error <= min(_ROUNDING * rate, 0.2) for error in nearest]
    best = int(np.argmax([fit.sum() for fit in fits]))
    regular = len(steps) == 0 or np.median(steps) <= 1.2
    if fits[best].mean() < _REGULAR or not regular:
        return None
    origin = _first(stamps[fits[best]], rate)
    return Clock(origin, stamped, int(counts[stamps == origin].min()))


def _first(stamps: NDArray[Any], rate: float) -> float:
    """Return the earliest stamp that another one follows within the time for which decoders reorder frames."""
    ordered = np.sort(stamps)
    near = np.append(np.diff(ordered) * rate <= _REORDERED, len(ordered) == 1)
    return float(ordered[np.argmax(near)])


def open_video(address: str, options: str, file: bool) -> tuple[NumberedCapture | None, Any]:
    """Open a video.

    Args:
        address: Absolute path of a file, or a URL.
        options: FFmpeg's options, in the form of the variable OPENCV_FFMPEG_CAPTURE_OPTIONS.
        file: True for a file.

    Returns:
        Capture with numbers, and the bare capture; None if no backend opens it.
    """
    os.environ[OPTIONS_VARIABLE] = options
    for backend, parameters in _backends():
        try:
            capture = cv2.VideoCapture(address, backend, parameters)
        except cv2.error:
            continue
        if capture.isOpened():
            timed = file and backend == cv2.CAP_FFMPEG
            return NumberedCapture(capture, _clock(address, parameters) if timed else None), capture
    return None, None


def _backends() -> list[tuple[int, list[int]]]:
    """Return OpenCV's backends for files, with parameters: FFmpeg, whose behavior is known, or all if it is missing."""
    if cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG):
        return [(cv2.CAP_FFMPEG, [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT])]
    # The backend for images would take a digit in the name for a counter, and open the file's neighbors.
    return [(backend, []) for backend in cv2.videoio_registry.getStreamBackends() if backend != cv2.CAP_IMAGES]


def _clock(address: str, parameters: list[int]) -> Clock | None:
    packets = cv2.VideoCapture(address, cv2.CAP_FFMPEG, [*parameters, cv2.CAP_PROP_FORMAT, -1])
    with open(address, "rb") as file:
        counted = file.read(4) == b"RIFF"
    try:
        return read_clock(packets, not counted) if packets.isOpened() else None
    finally:
        packets.release()


class _Server:
    """Answers requests until the standard input ends."""

    def __init__(self, requests: BinaryIO, answers: BinaryIO) -> None:
        self._requests, self._answers = requests, answers
        self._capture: NumberedCapture | None = None
        self._bare: Any = None
        self._start, self._stride = 0, 1

    def serve(self) -> None:
        while line := self._requests.readline():
            request = json.loads(line)
            try:
                self._handle(request)
            except cv2.error as error:
                reason = " ".join(str(getattr(error, "err", "") or error).split())[:160]
                self._send({"error": f"the decoder failed ({reason})"})

    def _handle(self, request: dict[str, Any]) -> None:
        if request["do"] == "open":
            self._close()
            self._start, self._stride = request["start"], request["stride"]
            self._capture, self._bare = open_video(request["address"], request["options"], request["file"])
            self._send(self._form(request["largest"]))
        elif request["do"] == "next":
            self._next()
        else:
            self._close()

    def _form(self, largest: int) -> dict[str, Any]:
        if self._capture is None:
            return {"closed": True}
        width, height = self._bare.get(cv2.CAP_PROP_FRAME_WIDTH), self._bare.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if max(width, height) > largest:
            self._close()
            return {"large": [int(width), int(height)]}
        lead = 0 if self._capture.clock is None else self._capture.clock.lead
        return {"rate": self._capture.rate, "length": self._capture.length, "lead": lead}

    def _next(self) -> None:
        """Send the next wanted frame."""
        capture = self._capture
        alive = time.monotonic()
        while capture is not None:
            grabbed = capture.grab()
            if grabbed is None:
                break
            number = grabbed.number
            if number >= self._start and (number - self._start) % self._stride == 0:
                image = capture.image() if grabbed.image is None else grabbed.image
                if image is not None:
                    pixels = np.ascontiguousarray(image)
                    frame = {"number": number, "time": grabbed.time, "shape": pixels.shape, "type": pixels.dtype.str}
                    self._send(frame, pixels.data.cast("B"))
                    return
            if time.monotonic() - alive > _BUSY_INTERVAL:
                alive = time.monotonic()
                self._send({"busy": number})
        self._send(
            {"end": 0, "repeated": 0} if capture is None else {"end": capture.next, "repeated": capture.repeated}
        )

    def _close(self) -> None:
        if self._bare is not None:
            self._bare.release()
        self._capture = self._bare = None

    def _send(self, answer: dict[str, Any], pixels: memoryview | None = None) -> None:
        content = b"" if pixels is None else pixels
        text = json.dumps(answer).encode()
        self._answers.write(HEADER.pack(len(text), len(content)) + text)
        self._answers.write(content)
        self._answers.flush()


def main() -> None:
    """Serve the parent process until it closes the pipe or ends."""
    for name in ("SIGINT", "SIGHUP", "SIGTERM"):
        # A signal to the group of processes is the parent's to handle; it closes the pipe.
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    # Otherwise FFmpeg prints every damaged block.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        _Server(sys.stdin.buffer, sys.stdout.buffer).serve()
    except BrokenPipeError:
        os._exit(0)


if __name__ == "__main__":
    main()
