"""Writer of H.264 films through PyAV, where it is installed: every browser plays them, and they are quick to write."""

from __future__ import annotations

import importlib.util
from fractions import Fraction
from pathlib import Path
from typing import Any

from servotrack.estimators.types import Image

_OPTIONS = {"preset": "ultrafast", "crf": "23"}
_LARGEST_DENOMINATOR = 1001


def has_h264() -> bool:
    """Return True if PyAV is installed with an encoder of H.264."""
    if importlib.util.find_spec("av") is None:
        return False
    import av

    return "libx264" in av.codecs_available


class H264Writer:
    """An MP4 file with H.264 in the pixel format that browsers play, its index at the beginning.

    Args:
        path: The file.
        rate: Frames per second.
        size: Width and height, even, px.

    Raises:
        OSError: The file cannot be written.
    """

    def __init__(self, path: Path, rate: float, size: tuple[int, int]) -> None:
        import av

        # FFmpeg takes a relative path that begins as `file:` for an address.
        self._container: Any = av.open(str(path.absolute()), "w", format="mp4", options={"movflags": "+faststart"})
        self._stream: Any = self._container.add_stream(
            "libx264", rate=Fraction(rate).limit_denominator(_LARGEST_DENOMINATOR), options=_OPTIONS
        )
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._failed = ""

    def write(self, image: Image) -> None:
        """Append an RGB frame.

        Raises:
            OSError: The disk is full, or the encoder fails.
        """
        import av

        self._append(av.VideoFrame.from_ndarray(image, "rgb24"))

    def _append(self, frame: Any) -> None:
        """Append a frame, or, for None, what the encoder still holds."""
        if self._failed:
            # Packets behind a header that could not be written crash FFmpeg.
            raise OSError(self._failed)
        try:
            self._container.mux(self._stream.encode(frame))
        except Exception as error:
            self._failed = str(error)
            raise

    def release(self) -> None:
        """Finish the file.

        Raises:
            OSError: The disk is full, now or in an earlier frame.
        """
        if self._container is None:
            return
        try:
            self._append(None)
        finally:
            container, self._container = self._container, None
            container.close()
