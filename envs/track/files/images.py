"""Decoding of image files: bounded in file size and in pixels, and converted to RGB."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as ImageHeader

from servotrack.envs.track.files.bounded import read_bounded
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Image

MAX_SIDE = 16384
"""Largest accepted width and height of a frame, px."""
MAX_IMAGE_FILE = 1 << 30
"""Largest accepted size of an image file, bytes."""
_HEADER_FORMATS = ("BMP", "DIB", "JPEG", "PNG", "PPM", "TIFF", "WEBP")


def decode_image(file: Path) -> NDArray[Any]:
    """Return an image in OpenCV's format.

    Raises:
        SequenceError: If the file is not regular, cannot be read or decoded, or is too large.
    """
    content = read_bounded(file, MAX_IMAGE_FILE, "replace it by a smaller image")
    _check_header(file, content)
    try:
        with quiet():
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise SequenceError(f"{file} cannot be decoded ({reason(error)})") from error
    if image is None or image.size == 0:
        raise SequenceError(f"{file} cannot be decoded as an image; replace it or remove it from the folder")
    return image


def to_rgb(image: NDArray[Any], where: str) -> Image:
    """Convert a decoded image to RGB, uint8, shape (H, W, 3).

    Args:
        image: Image in OpenCV's format: gray, BGR or BGRA, 8 bits.
        where: Source and frame, for the error message.

    Raises:
        SequenceError: If the image has another format.
    """
    channels = 1 if image.ndim == 2 else image.shape[2]
    codes = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    if image.dtype != np.uint8 or channels not in codes:
        raise SequenceError(f"{where}: images must have 1, 3 or 4 channels, got {image.dtype}, {channels} channel(s)")
    return cv2.cvtColor(image, codes[channels])  # type: ignore[return-value]


def _check_header(file: Path, content: bytes) -> None:
    """Raise SequenceError if an image claims more pixels or bytes than it may: a decoder would take memory for them."""
    try:
        with warnings.catch_warnings():
            # Of images that are damaged, or large but below the limit.
            warnings.simplefilter("ignore")
            with ImageHeader.open(io.BytesIO(content), formats=_HEADER_FORMATS) as header:
                width, height = header.size
                # OpenCV takes memory for whatever length a chunk of a PNG file claims, up to 4 GB.
                header.verify()
    except ImageHeader.DecompressionBombError as error:
        raise SequenceError(f"{file} cannot be decoded: {error} Make it smaller") from error
    except Exception as error:
        # Pillow raises errors of many kinds. What it cannot read OpenCV might read, but without this check.
        raise SequenceError(
            f"{file} cannot be decoded as an image; replace it or remove it from the folder "
            f"({', '.join(_HEADER_FORMATS)} are read)"
        ) from error
    if max(width, height) > MAX_SIDE:
        raise SequenceError(too_large(str(file), width, height))


def too_large(name: str, width: int, height: int) -> str:
    """Return the message for frames of too many pixels."""
    return (
        f"{name}: frames of {width}x{height} px are too large, the limit is {MAX_SIDE} px per side; make them smaller"
    )


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence OpenCV's messages on the terminal; an exception reports the error."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def reason(error: cv2.error) -> str:
    """Return the message of an error of OpenCV in one line."""
    return " ".join(str(getattr(error, "err", "") or error).split())[:160]
