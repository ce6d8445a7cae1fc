"""Decoders of video files, addresses and cameras, and the choice of the decoder for a source."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from servotrack.envs.track.files.avi import first_damaged_frame
from servotrack.envs.track.files.containers import DEMUXERS, check_container
from servotrack.envs.track.files.decoder import Decoder, Picture
from servotrack.envs.track.files.image_folder import ImageFolder
from servotrack.envs.track.files.images import MAX_SIDE, quiet, reason, too_large
from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.envs.track.files.recorded import FRAME_RATES, SequenceError
from servotrack.envs.track.files.remote import RemoteVideo, VideoEnd
from servotrack.envs.track.files.video_process import OPTIONS_VARIABLE

_ATTEMPTS = 5
"""Number of failed reads in a row after which a camera has ended."""
_LEAST_LEAD = 3
"""Number of frames before the first time stamp from which it is said. Fewer are common in sound files."""
_ADDRESS = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]*)://")
PROTOCOLS = {
    "http": "http,tcp",
    "https": "https,tls,tcp",
    "rtsp": "rtsp,rtp,rtcp,udp,tcp",
    "rtsps": "rtsps,rtsp,rtp,rtcp,udp,tcp,tls",
}
"""Schemes of addresses that are opened, and the protocols of FFmpeg that each of them needs."""


def find_decoder(source: str | Path | int, white: float | None = None) -> Decoder:
    """Return the unopened decoder for a source: the index of a camera, an address, a folder, or a file.

    Args:
        source: The source; see `servotrack.envs.track.files.frames.open_frames`.
        white: Value that is white in the images of a folder; None: from the images.

    Raises:
        SequenceError: If the source does not exist or is empty.
    """
    if isinstance(source, bool):
        raise SequenceError(f"source must be a path, an address or a camera's index, got {source!r}")
    if isinstance(source, (int, np.integer)):
        return Camera(int(source))
    text, path = str(source), Path(source)
    if not text:
        raise SequenceError("source is empty: give a video file, an image folder or a camera's index")
    if isinstance(source, str) and _ADDRESS.match(text):
        return VideoAddress(text)
    try:
        folder, there = path.is_dir(), path.exists()
    except (OSError, ValueError) as error:
        raise SequenceError(f"source {text!r} cannot be a path ({error})") from error
    if folder:
        return _folder_decoder(path, white)
    if not there and text.isascii() and text.isdigit():
        return Camera(int(text))
    if not there:
        raise SequenceError(f"source {text!r} does not exist: give a video file, an image folder or a camera's index")
    return VideoFile(path)


def _folder_decoder(path: Path, white: float | None) -> Decoder:
    sequence = find_mot_folder(path)
    if sequence is None:
        return ImageFolder(path, path.resolve().name, None, white=white)
    if sequence.images is None:
        raise SequenceError(
            f"{path} is a MOTChallenge sequence without images: it has no folder {sequence.info.images}"
        )
    return ImageFolder(sequence.images, sequence.info.name, sequence.info.frame_rate, counted=True, white=white)


class _Video(Decoder):
    """Video that another process decodes."""

    _remote: RemoteVideo | None = None
    _file = True
    repeated = 0

    def _address(self) -> str:
        raise NotImplementedError

    def _options(self) -> str:
        raise NotImplementedError

    def _failure(self) -> str:
        raise NotImplementedError

    def open(self, start: int = 0, stride: int = 1) -> None:
        """Open the video; do nothing if it is open."""
        if self._remote is not None:
            return
        remote = RemoteVideo(
            self.name,
            self._address(),
            self._options(),
            file=self._file,
            start=start,
            stride=stride,
            largest=MAX_SIDE,
        )
        if "large" in remote.form or "closed" in remote.form:
            remote.close()
            large = remote.form.get("large")
            raise SequenceError(self._failure() if large is None else too_large(self.name, *large))
        # Other rates are errors of the header.
        rate = remote.form["rate"]
        self.frame_rate = rate if rate is not None and FRAME_RATES[0] <= rate <= FRAME_RATES[1] else None
        self.length = None if self.live else remote.form["length"]
        self._remote, self.end = remote, None

    def read(self) -> Picture | None:
        """Return the next wanted image; None at the end."""
        assert self._remote is not None
        found = self._remote.read()
        if isinstance(found, VideoEnd):
            self.end, self.repeated = found
            return None
        return Picture(*found)

    def close(self) -> None:
        """Close the video."""
        if self._remote is not None:
            self._remote.close()
        self._remote = None


class VideoFile(_Video):
    """A video file."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path
        self._doubt: str | None = None
        self._note = ""

    @property
    def notes(self) -> list[str]:
        """Facts about the source for the user."""
        return [self._note] if self._note else []

    def open(self, start: int = 0, stride: int = 1) -> None:
        """Open the video; do nothing if it is open."""
        super().open(start, stride)
        assert self._remote is not None
        lead = self._remote.form["lead"]
        if lead >= _LEAST_LEAD and self._from_zero():
            self._note = (
                f"{self.path}: its first time stamp is that of frame {lead}; frames are counted from there, which is "
                "wrong if its beginning was lost"
            )

    def _from_zero(self) -> bool:
        """Return True if the time stamps of the container begin at 0: MP4, Matroska, WebM, FLV."""
        with self.path.open("rb") as file:
            head = file.read(8)
        return head[4:] == b"ftyp" or head.startswith((b"\x1aE\xdf\xa3", b"FLV"))

    @property
    def warning(self) -> str:
        """Reason for doubt in the images so far; empty if there is none."""
        if self.end is None:
            return ""
        if self._doubt is None:
            damaged = first_damaged_frame(self.path)
            doubts = [] if damaged is None else [
                f"its structure is damaged at frame {damaged}; without time stamps later frames may have wrong numbers"
            ]  # fmt: skip
            if self.repeated:
                doubts.append(f"{self.repeated} frame(s) with the time stamps of others were left out")
            self._doubt = "; ".join(f"{self.path}: {doubt}" for doubt in doubts)
        return self._doubt

    def _address(self) -> str:
        check_container(self.path)
        # FFmpeg takes a relative path that begins as `file:` or `concat:` for an address.
        return str(self.path.absolute())

    def _options(self) -> str:
        return _ffmpeg_options(f"format_whitelist;{','.join(DEMUXERS)}|protocol_whitelist;file|enable_drefs;0")

    def _failure(self) -> str:
        return (
            f"{self.path} cannot be decoded: an unknown codec, damaged, or truncated "
            "(an unfinished mp4 file has no index)"
        )


class VideoAddress(_Video):
    """A stream or file at an address of one of the schemes in `PROTOCOLS`. No other scheme is followed from there."""

    live = True
    _file = False

    def __init__(self, address: str) -> None:
        match = _ADDRESS.match(address)
        scheme = match.group(1).lower() if match else ""
        if scheme not in PROTOCOLS:
            raise SequenceError(
                f"source {scheme}://... cannot be opened: addresses begin with {', '.join(PROTOCOLS)}; "
                "give a local file by its path"
            )
        # A password in the address belongs into no message or file.
        super().__init__(re.sub(r"//[^/@]*@", "//", address).split("?")[0])
        self._text, self._scheme = address, scheme

    def _address(self) -> str:
        return self._text

    def _options(self) -> str:
        formats = ",".join([*DEMUXERS, "mpjpeg", "rtsp"])
        return _ffmpeg_options(
            f"rtsp_transport;tcp|format_whitelist;{formats}|protocol_whitelist;{PROTOCOLS[self._scheme]}|enable_drefs;0"
        )

    def _failure(self) -> str:
        return (
            f"{self.name} cannot be opened: no answer, no video, or a playlist; only {self._scheme} itself is used, "
            "redirections to other schemes are not followed. Check the address with a video player"
        )


def _ffmpeg_options(ours: str) -> str:
    """Return the user's options of FFmpeg and then ours: of two values of an option the last one counts."""
    before = os.environ.get(OPTIONS_VARIABLE)
    return f"{before}|{ours}" if before else ours


class Camera(Decoder):
    """A camera that is attached to this machine. Frames are numbered as they arrive."""

    live = True
    _capture: Any = None

    def __init__(self, index: int) -> None:
        super().__init__(f"camera {index}")
        self._index, self._next, self._begin = index, 0, 0.0
        self._start, self._stride = 0, 1

    def open(self, start: int = 0, stride: int = 1) -> None:
        """Open the camera; if it is open, go on."""
        self._start, self._stride = start, stride
        if self._capture is not None:
            return
        with quiet():
            capture = cv2.VideoCapture(self._index) if 0 <= self._index < 2**31 else None
        if capture is None or not capture.isOpened():
            raise SequenceError(
                f"camera {self._index} cannot be opened; check that it is attached and not used by another program"
            )
        self._capture, self._next = capture, 0
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        self.frame_rate = rate if FRAME_RATES[0] <= rate <= FRAME_RATES[1] else None

    def read(self) -> Picture | None:
        """Return the next wanted image, after up to `_ATTEMPTS` reads; None at the end."""
        failures = 0
        while failures < _ATTEMPTS:
            try:
                delivered, image = self._capture.read()
            except cv2.error as error:
                raise SequenceError(f"{self.name}: the decoder failed ({reason(error)})") from error
            if not delivered or image is None or not image.size:
                failures += 1
                continue
            failures = 0
            now, number = time.monotonic(), self._next
            self._begin = now if number == 0 else self._begin
            self._next += 1
            if number >= self._start and (number - self._start) % self._stride == 0:
                return Picture(number, now - self._begin, image)
        return None

    def close(self) -> None:
        """Close the camera."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
