"""JPEG artifacts: a frame after encoding and decoding, identical to libjpeg's to the bit, without entropy coding.

Entropy coding is lossless and takes most of the time of an encoder, so it is left out. The rest is libjpeg's baseline
method as OpenCV uses it: luminance and two chrominance planes of half the size, blocks of 8 x 8 (`block_transform`),
and triangular interpolation of the chrominance when decoding.
"""

from __future__ import annotations

import cv2
import numpy as np

from servotrack.envs.track.pedestrians.block_transform import WIDTH, code_stripe, workspace
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Image

_int = np.int32
_HALF = 32768  # one half in fixed-point numbers with 16 fractional bits
_PLANE_WEIGHTS = np.array(
    [[19595, 38470, 7471, _HALF - (128 << 16)], [-11059, -21709, 32768, _HALF - 1], [32768, -27439, -5329, _HALF - 1]],
    dtype=np.int32,
)
"""Weights of red, green and blue in luminance (minus 128) and chrominance (ITU-R BT.601), and rounding offsets."""
_COLOR_WEIGHTS = np.array([[0, 91881], [-22554, -46802], [116130, 0]], dtype=np.int32)
"""Weights of the chrominance planes in red, green and blue."""


class JpegCoder:
    """Applies JPEG artifacts to frames of one size.

    Args:
        width: Width of the frames, px.
        height: Height of the frames, px.
        quality: JPEG quality, 1 to 100. Smaller values give stronger artifacts.
    """

    def __init__(self, width: int, height: int, quality: int) -> None:
        self._width, self._height = width, height
        wide, high = -(-width // 16) * 16, -(-height // 16) * 16
        self._padding = wide - width
        self._luminance, self._chrominance = workspace(quality, False), workspace(quality, True)
        # Planes are padded to whole stripes; the padding is coded, too, but not used.
        self._brightness = np.zeros((high, -(-wide // WIDTH) * WIDTH), np.int16)
        self._differences = np.zeros((2, high // 2, -(-wide // 2 // WIDTH) * WIDTH), np.int16)
        self._rows = np.zeros((7, wide + 2), np.int32)
        self._colors = [np.zeros((height, wide), np.uint8) for _ in range(3)]

    def code(self, image: Image) -> Image:
        """Return a frame after encoding and decoding, as a new array.

        Args:
            image: RGB image of the coder's size.
        """
        if self._padding:
            image = np.asarray(cv2.copyMakeBorder(image, 0, 0, 0, self._padding, cv2.BORDER_REPLICATE), dtype=np.uint8)
        red, green, blue = self._colors
        cv2.split(image, self._colors)
        _split_planes(red, green, blue, self._brightness, self._differences, _PLANE_WEIGHTS, self._rows)
        _code_plane(self._brightness, *self._luminance)
        for plane in self._differences:
            _code_plane(plane, *self._chrominance)
        _merge_planes(self._brightness, self._differences, _COLOR_WEIGHTS, self._rows, self._width, red, green, blue)
        coded = cv2.merge(self._colors)
        return np.ascontiguousarray(coded[:, : self._width], dtype=np.uint8)


@njit(cache=True, nogil=True)
def _widen(row, out):  # type: ignore[no-untyped-def]
    """Copy a row to 32-bit numbers, which keeps later loops vectorized."""
    for j in range(len(row)):
        out[j] = row[j]


@njit(cache=True, nogil=True)
def _weigh(red, green, blue, weights, out):  # type: ignore[no-untyped-def]
    a, b, c, rounding = weights[0], weights[1], weights[2], weights[3]
    for j in range(len(out)):
        out[j] = _int(_int(_int(red[j] * a) + _int(green[j] * b)) + _int(_int(blue[j] * c) + rounding)) >> 16


@njit(cache=True, nogil=True)
def _halve(upper, lower, sums, out):  # type: ignore[no-untyped-def]
    """Average 2 x 2 samples; halves are rounded down and up in turn."""
    for j in range(2 * len(out)):
        sums[j] = upper[j] + lower[j]
    for j in range(len(out)):
        out[j] = _int(_int(sums[2 * j] + sums[2 * j + 1]) + _int(1 + (j & 1))) >> 2


@njit(cache=True, nogil=True)
def _split_planes(red, green, blue, brightness, differences, weights, rows):  # type: ignore[no-untyped-def]
    """Convert colors to luminance and chrominance. Below the frame its last rows are repeated."""
    height, width = red.shape
    r, g, b = rows[0, :width], rows[1, :width], rows[2, :width]
    for i in range(0, 2 * differences.shape[1], 2):
        if i >= height:
            brightness[i : i + 2] = brightness[height - 1]
            differences[:, i // 2] = differences[:, i // 2 - 1]
            continue
        for k in range(2):
            if i + k < height:
                _widen(red[i + k], r)
                _widen(green[i + k], g)
                _widen(blue[i + k], b)
            _weigh(r, g, b, weights[0], brightness[i + k, :width])
            _weigh(r, g, b, weights[1], rows[3 + k, :width])
            _weigh(r, g, b, weights[2], rows[5 + k, :width])
        _halve(rows[3], rows[4], rows[3], differences[0, i // 2, : width // 2])
        _halve(rows[5], rows[6], rows[5], differences[1, i // 2, : width // 2])


@njit(cache=True, nogil=True)
def _code_plane(plane, room, inverses):  # type: ignore[no-untyped-def]
    for top in range(0, plane.shape[0], 8):
        for left in range(0, plane.shape[1], WIDTH):
            code_stripe(plane, top, left, room, inverses)


@njit(cache=True, nogil=True)
def _enlarge(near, far, sums, out):  # type: ignore[no-untyped-def]
    """Interpolate one of two rows from a row of chrominance, with weights 3/4 (near) and 1/4 (far)."""
    count = len(sums) - 2
    for j in range(count):
        sums[j + 1] = 3 * near[j] + far[j]
    sums[0], sums[count + 1] = sums[1], sums[count]
    for j in range(count):
        middle = _int(sums[j + 1] * 3)
        out[2 * j] = _int(_int(middle + sums[j]) + 8) >> 4
        out[2 * j + 1] = _int(_int(middle + sums[j + 2]) + 7) >> 4


@njit(cache=True, nogil=True)
def _mix(bright, first, second, weights, out):  # type: ignore[no-untyped-def]
    a, b = weights[0], weights[1]
    black, white = _int(0), _int(255)
    for j in range(len(out)):
        tinted = _int(_int(bright[j] + 128) + _int(_int(_int(_int(first[j] * a) + _int(second[j] * b)) + _HALF) >> 16))
        out[j] = np.uint8(min(max(tinted, black), white))


@njit(cache=True, nogil=True)
def _merge_planes(brightness, differences, weights, rows, width, red, green, blue):  # type: ignore[no-untyped-def]
    """Convert luminance and chrominance to colors, in columns up to `width`."""
    height = red.shape[0]
    count, last = (width + 1) // 2, (height + 1) // 2 - 1
    for i in range(height):
        near = i // 2
        far = max(near - 1, 0) if i % 2 == 0 else min(near + 1, last)
        for c in range(2):
            plane = differences[c]
            _enlarge(plane[near], plane[far], rows[1, : count + 2], rows[2 + c])
        _widen(brightness[i, :width], rows[4])
        _mix(rows[4], rows[2], rows[3], weights[0], red[i, :width])
        _mix(rows[4], rows[2], rows[3], weights[1], green[i, :width])
        _mix(rows[4], rows[2], rows[3], weights[2], blue[i, :width])
