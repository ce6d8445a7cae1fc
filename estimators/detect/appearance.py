"""Color histograms of boxes or blobs as appearance vectors, compared by a dot product."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.images import checked_image
from servotrack.estimators.types import Array
from servotrack.estimators.validation import as_numbers


def color_bins(image: ArrayLike, bins: int = 8) -> NDArray[np.int16]:
    """Compute the histogram bin of every pixel.

    Args:
        image: RGB or gray, uint8. Shape (H, W, 3) or (H, W); gray counts as a color of three equal channels.
        bins: Number of bins of each channel, 1 to 16, equally wide up to rounding.

    Returns:
        (red * bins + green) * bins + blue, where the bin of a channel is value * bins // 256. Shape (H, W), int16.

    Raises:
        ValueError: The image has another type or shape, or bins is out of range.
    """
    colors = _as_colors(checked_image(image, "image"))
    _check_bins(bins)
    out = np.empty(colors.shape[:2], np.int16)
    _bin_pixels(colors, bins, out)
    return out


def box_histograms(image: ArrayLike, boxes: ArrayLike, bins: int = 8) -> Array:
    """Color histograms of boxes over the pixels whose centers lie inside (Zhang and Li 2008, eq. 6, no kernel).

    Args:
        image: RGB or gray, uint8. Shape (H, W, 3) or (H, W).
        boxes: Left, top, width and height. Shape (k, 4), px; parts outside the image are ignored.
        bins: Number of bins of each channel, 1 to 16.

    Returns:
        Shares, which sum to 1; zeros for a box without a pixel. Shape (k, bins ** 3).

    Raises:
        ValueError: The image has another type or shape, boxes are not finite or have another shape, or bins is out of
            range.
    """
    colors = _as_colors(checked_image(image, "image"))
    _check_bins(bins)
    array = as_numbers("boxes", boxes)
    if array.size == 0:
        array = array.reshape(0, 4)
    if array.ndim != 2 or array.shape[1] != 4 or not np.isfinite(array).all():
        raise ValueError(f"boxes must be finite with shape (k, 4), left, top, width, height, got {array.shape}")
    out = np.zeros((len(array), bins**3))
    _count_boxes(colors, array, bins, out)
    return out


def box_appearance(image: ArrayLike, boxes: ArrayLike, bins: int = 8) -> Array:
    """Square roots of color histograms of boxes: unit vectors whose product is the Bhattacharyya coefficient.

    Args:
        image: RGB or gray, uint8. Shape (H, W, 3) or (H, W).
        boxes: Left, top, width and height. Shape (k, 4), px.
        bins: Number of bins of each channel, 1 to 16.

    Returns:
        Rows of unit length, zeros for a box without a pixel. Shape (k, bins ** 3).

    Raises:
        ValueError: The same errors as in `box_histograms`.
    """
    return np.sqrt(box_histograms(image, boxes, bins))


def run_appearance(image: NDArray[np.uint8], runs: NDArray[np.int32], count: int, bins: int) -> Array:
    """Square roots of color histograms over the pixels of blobs.

    Args:
        image: RGB or gray, uint8. Shape (H, W, 3) or (H, W).
        runs: Row, first column, column after the last, and index of the blob, negative for none. Shape (n, 4).
        count: Number of blobs k.
        bins: Number of bins of each channel.

    Returns:
        Rows of unit length, zeros for a blob without a pixel. Shape (k, bins ** 3).
    """
    out = np.zeros((count, bins**3))
    _count_runs(_as_colors(image), runs, bins, out)
    return out


def _as_colors(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def _check_bins(bins: int) -> None:
    if not (isinstance(bins, int | np.integer) and 1 <= bins <= 16):
        raise ValueError(f"bins must be a whole number from 1 to 16, got {bins!r}")


@njit(cache=True, nogil=True)
def _bin(image, row, column, bins):  # type: ignore[no-untyped-def]
    red = image[row, column, 0] * bins >> 8
    green = image[row, column, 1] * bins >> 8
    blue = image[row, column, 2] * bins >> 8
    return (red * bins + green) * bins + blue


@njit(cache=True, nogil=True)
def _bin_pixels(image, bins, out):  # type: ignore[no-untyped-def]
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            out[row, column] = _bin(image, row, column, bins)


@njit(cache=True, nogil=True)
def _count_boxes(image, boxes, bins, out):  # type: ignore[no-untyped-def]
    height, width = image.shape[:2]
    for k in range(boxes.shape[0]):
        left, top = boxes[k, 0], boxes[k, 1]
        first_column = int(min(max(np.ceil(left - 0.5), 0.0), width))
        last_column = int(min(max(np.ceil(left + boxes[k, 2] - 0.5), 0.0), width))
        first_row = int(min(max(np.ceil(top - 0.5), 0.0), height))
        last_row = int(min(max(np.ceil(top + boxes[k, 3] - 0.5), 0.0), height))
        pixels = (last_row - first_row) * (last_column - first_column)
        if last_row <= first_row or last_column <= first_column:
            continue
        for row in range(first_row, last_row):
            for column in range(first_column, last_column):
                out[k, _bin(image, row, column, bins)] += 1.0
        for index in range(out.shape[1]):
            out[k, index] /= pixels


@njit(cache=True, nogil=True)
def _count_runs(image, runs, bins, out):  # type: ignore[no-untyped-def]
    totals = np.zeros(out.shape[0])
    for n in range(runs.shape[0]):
        k = runs[n, 3]
        if k < 0:
            continue
        totals[k] += runs[n, 2] - runs[n, 1]
        for column in range(runs[n, 1], runs[n, 2]):
            out[k, _bin(image, runs[n, 0], column, bins)] += 1.0
    for k in range(out.shape[0]):
        if totals[k] > 0.0:
            for index in range(out.shape[1]):
                if out[k, index] > 0.0:
                    out[k, index] = np.sqrt(out[k, index] / totals[k])
