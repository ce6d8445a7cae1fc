"""Brightness range of images: which value is white, from what the images hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.files.recorded import SequenceError

WHITES = (1, 255, 1023, 4095, 16383, 65535)
"""Values that white can have: 1 bit or a fraction, and cameras of 8, 10, 12, 14 and 16 bits."""
_OUTSIDE = 1e-3
"""Largest share of the values of float images that may lie outside their range, as resampling leaves them. Images far
from black may have as many dead pixels on either side."""
_FLAT = 0.25
"""Share of the range below which the values of images far from black are spread, and the margin on either side."""


class Levels:
    """Conversion of images to 8 bits with one scale for all images of a sequence.

    The scale is that of the smallest range in `WHITES` that holds the values of sampled images: 12 bits in a 16-bit
    file, or floats of 0 to 1, fill the range of 0 to 255. Images of 8 bits stay as they are unless all samples consist
    of 0 and 1. Gray images of more bits whose values lie far from 0 and close together, as the temperatures of a
    thermal camera do, are spread from their own lowest to their highest value, with a margin.

    Args:
        sample: Function that returns images from the whole sequence.
        white: Value that becomes 255; None: from the samples.

    Attributes:
        note: Scale of images of other than 8 bits, for the user; else empty.
        clipped: Number of converted images with values outside the range.
    """

    def __init__(self, sample: Callable[[], Iterable[NDArray[Any]]], white: float | None = None) -> None:
        self._sample, self._given = sample, white
        self._ranges: dict[np.dtype[Any], tuple[float, float]] = {}
        self.note, self.clipped = "", 0

    def to_bytes(self, image: NDArray[Any], where: str) -> NDArray[Any]:
        """Return an image as uint8, shape unchanged.

        Args:
            image: Image of unsigned integers or floats.
            where: Source and frame, for the error message.

        Raises:
            SequenceError: If the image has another type, NaN, or values in no known range.
        """
        kind = image.dtype
        if kind.kind not in "uf":
            raise SequenceError(f"{where}: images must hold unsigned integers or floats, got {kind}; convert them")
        if kind.kind == "f" and not np.isfinite(image).all():
            raise SequenceError(f"{where}: images must be finite, got NaN or infinity; replace such pixels")
        known = self._ranges.get(kind)
        black, white = self._find(image, where) if known is None else known
        if kind == np.uint8 and white == 255:
            return image
        return self._scaled(image, black, white)

    def _find(self, image: NDArray[Any], where: str) -> tuple[float, float]:
        """Return the values of black and white for images of this type."""
        kind, black = image.dtype, 0.0
        if self._given is not None:
            white = float(self._given)
        elif kind == np.uint8 and image.max() > 1:
            white = 255.0
        else:
            samples = [image, *(one for one in self._sample() if one.dtype == kind)]
            found = _white(samples)
            if found is None:
                low, high = min(float(one.min()) for one in samples), max(float(one.max()) for one in samples)
                raise SequenceError(
                    f"{where}: values from {low:g} to {high:g} fit no range of 0 to {', '.join(map(str, WHITES))}; "
                    "convert the images to 8 bits, or say which value is white"
                )
            if not max(one.max() for one in samples):
                # Black so far: the next image decides.
                return 0.0, 255.0
            black, white = _own_range(samples, found) if kind.kind == "u" else (0.0, found)
        self._ranges[kind] = black, white
        if black:
            self.note = (
                f"images of {kind} are read with {black:g} as black and {white:g} as white, for their values lie far "
                "from 0 and close together; choose another value with white (--white), then 0 is black"
            )
        elif white != 255 or kind != np.uint8:
            self.note = f"images of {kind} are read with {white:g} as white; choose another value with white (--white)"
        return black, white

    def _scaled(self, image: NDArray[Any], black: float, white: float) -> NDArray[Any]:
        if black:
            # Dead pixels are outside in every image; that is said only where there are more of them.
            self.clipped += int(np.count_nonzero((image < black) | (image > white)) > 2.0 * _OUTSIDE * image.size)
            spread = (np.clip(image, black, white) - black) * (255.0 / (white - black))
            return np.asarray(np.rint(spread), dtype=np.uint8)
        outside = (image > white).any() or (image.dtype.kind == "f" and bool((image < 0).any()))
        if outside:
            self.clipped += 1
            image = np.clip(image, 0, white).astype(image.dtype)
        bits = int(white + 1).bit_length() - 1
        if image.dtype.kind == "u" and bits >= 8 and white + 1 == 1 << bits:
            return (image >> (bits - 8)).astype(np.uint8)
        return np.rint(image * (255.0 / white)).astype(np.uint8)


def _white(images: list[NDArray[Any]]) -> float | None:
    """Return the smallest range that holds the values of images of one type; None for none."""
    allowed = _OUTSIDE * sum(image.size for image in images) if images[0].dtype.kind == "f" else 0.0
    if sum(np.count_nonzero(image < 0) for image in images) > allowed:
        return None
    for white in WHITES:
        if sum(np.count_nonzero(image > white) for image in images) <= allowed:
            # Samples of 8 bits and more that are all dark would be stretched by less than cameras have bits.
            return float(white)
    return None


def _own_range(images: list[NDArray[Any]], white: float) -> tuple[float, float]:
    """Return the range of gray values far from 0 and close together, with a margin; else 0 and `white`."""
    if images[0].dtype.itemsize == 1 or any(image.ndim == 3 and image.shape[2] > 1 for image in images):
        return 0.0, white
    ends = np.array([np.quantile(image, (_OUTSIDE, 1.0 - _OUTSIDE)) for image in images])
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    span = high - low
    if span == 0.0 or span >= _FLAT * white or low < span:
        return 0.0, white
    return float(np.floor(low - _FLAT * span)), float(np.ceil(high + _FLAT * span))
