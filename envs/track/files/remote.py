"""Videos decoded in another process: a file that crashes the decoder ends with a message, not with this process."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.files.video_process import HEADER

_PATIENCE = 60.0
"""Longest time without an answer, s. Opening and reading have time-outs of 10 s of their own."""
_AHEAD = 2
"""Number of frames that are decoded ahead."""
_MOST_IDLE = 2
"""Number of processes that are kept for the next video."""
_PROGRAM = Path(__file__).with_name("video_process.py")
_PIPE_SIZE = 1 << 20


class DecoderLostError(Exception):
    """The decoding process has ended. The message is the reason."""


class VideoProcess:
    """A decoding process and the requests that it has not answered yet.

    Raises:
        DecoderLostError: The process cannot be started, has ended, or does not answer.
    """

    def __init__(self) -> None:
        options = ["-P"] if sys.version_info >= (3, 11) else []
        try:
            self._process = subprocess.Popen(
                [sys.executable, *options, str(_PROGRAM)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                bufsize=0,
            )
        except OSError as error:
            raise DecoderLostError(f"the decoding process cannot be started ({error})") from error
        assert self._process.stdin is not None and self._process.stdout is not None
        self._requests, self._answers = self._process.stdin, self._process.stdout
        with contextlib.suppress(ImportError, AttributeError, OSError):
            import fcntl

            # Fewer changes between the two processes for each frame.
            fcntl.fcntl(self._answers.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_SIZE)  # type: ignore[attr-defined]
        self._asked = 0
        self.owner = os.getpid()

    def open(self, address: str, options: str, file: bool, start: int, stride: int, largest: int) -> dict[str, Any]:
        """Open a video and return what it claims; see `video_process`."""
        self._ask(
            {
                "do": "open", "address": address, "options": options, "file": file, "start": start, "stride": stride,
                "largest": largest,
            }
        )  # fmt: skip
        return self._answer()[0]

    def next(self) -> tuple[dict[str, Any], NDArray[Any] | None]:
        """Return the next wanted frame, or why there is none."""
        while self._asked < _AHEAD:
            self._ask({"do": "next"})
            self._asked += 1
        found, pixels = self._answer()
        while "busy" in found:
            found, pixels = self._answer()
        self._asked -= 1
        if "shape" not in found:
            return found, None
        return found, pixels.view(found["type"]).reshape(found["shape"])

    def close(self) -> None:
        """Close the video; the process can open another one."""
        while self._asked:
            found, _ = self._answer()
            self._asked -= "busy" not in found
        self._ask({"do": "close"})

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._requests, self._answers):
            with contextlib.suppress(OSError):
                stream.close()

    def _ask(self, request: dict[str, Any]) -> None:
        try:
            self._requests.write(json.dumps(request).encode() + b"\n")
        except OSError as error:
            raise self._lost() from error

    def _answer(self) -> tuple[dict[str, Any], NDArray[np.uint8]]:
        lengths = HEADER.unpack(self._read(HEADER.size).data)
        found = json.loads(self._read(lengths[0]).tobytes())
        return found, self._read(lengths[1])

    def _read(self, count: int) -> NDArray[np.uint8]:
        # Not filled with zeros first, as a bytearray is.
        content = np.empty(count, np.uint8)
        rest = content.data
        while rest:
            if os.name == "posix" and not select.select([self._answers], [], [], _PATIENCE)[0]:
                self._process.kill()
                raise DecoderLostError(f"the decoder gave no answer for {_PATIENCE:.0f} s")
            got = self._answers.readinto(rest)  # type: ignore[attr-defined]
            if not got:
                raise self._lost()
            rest = rest[got:]
        return content

    def _lost(self) -> DecoderLostError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        code = self._process.returncode
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                return DecoderLostError(f"the decoder crashed ({signal.Signals(-code).name})")
        return DecoderLostError(f"the decoding process ended (exit code {code})")


class _Pool:
    """Processes that wait for the next video. Starting one takes some tenths of a second."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[VideoProcess] = []

    def take(self) -> VideoProcess:
        with self._lock:
            # After a fork the processes are the parent's.
            self._idle = [process for process in self._idle if process.owner == os.getpid()]
            return self._idle.pop() if self._idle else VideoProcess()

    def give(self, process: VideoProcess) -> None:
        if process.owner != os.getpid():
            return
        try:
            process.close()
        except DecoderLostError:
            process.end()
            return
        with self._lock:
            self._idle.append(process)
            surplus = self._idle[:-_MOST_IDLE]
            del self._idle[:-_MOST_IDLE]
        for one in surplus:
            one.end()

    def end(self) -> None:
        with self._lock:
            for process in self._idle:
                if process.owner == os.getpid():
                    process.end()
            self._idle.clear()


_pool = _Pool()
atexit.register(_pool.end)


class VideoEnd(NamedTuple):
    """End of a video.

    Attributes:
        number: Number after that of the last frame.
        repeated: Number of frames that were left out for their time stamps.
    """

    number: int
    repeated: int


class RemoteVideo:
    """A video that another process decodes.

    Args:
        name: Name for messages.
        address: Absolute path of a file, or a URL.
        options: FFmpeg's options.
        file: True for a file.
        start: First wanted frame, from 0.
        stride: Every stride-th frame from there is wanted.
        largest: Largest side of a frame, px.

    Attributes:
        form: Claims of the video: `rate` and `length`, None where unknown; `closed` if it cannot be opened; `large`,
            width and height, if its frames are too large.

    Raises:
        SequenceError: The decoder crashed, or cannot be started.
    """

    def __init__(
        self, name: str, address: str, options: str, *, file: bool, start: int, stride: int, largest: int
    ) -> None:
        self._name, self._number = name, -1
        try:
            self._process = _pool.take()
        except DecoderLostError as error:
            raise SequenceError(f"{name} cannot be decoded: {error}") from error
        try:
            self.form = self._process.open(address, options, file, start, stride, largest)
        except DecoderLostError as error:
            self._process.end()
            raise self._failed(error) from error
        self._release = weakref.finalize(self, _pool.give, self._process)

    def read(self) -> tuple[int, float | None, NDArray[Any]] | VideoEnd:
        """Return number, time (s) and pixels of the next wanted frame, or the end.

        Raises:
            SequenceError: The decoder failed or crashed.
        """
        try:
            found, image = self._process.next()
        except DecoderLostError as error:
            raise self._failed(error) from error
        if image is None:
            if "error" in found:
                raise SequenceError(f"{self._name}: {found['error']}")
            return VideoEnd(found["end"], found["repeated"])
        self._number = int(found["number"])
        return self._number, found["time"], image

    def close(self) -> None:
        """Close the video."""
        self._release()

    def _failed(self, error: DecoderLostError) -> SequenceError:
        where = "before its first frame" if self._number < 0 else f"after frame {self._number}"
        return SequenceError(
            f"{self._name} cannot be decoded {where}: {error}; the file is damaged, convert it with a tool that "
            "repairs it"
        )
