"""Color histograms of many boxes at once, by an integral histogram over the nonzero bins of the reference.

The result is exact: other bins add nothing to the Bhattacharyya coefficient and need not be counted.
"""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.appearance import box_histograms
from servotrack.estimators.elementary import exponential
from servotrack.estimators.types import Array, Image, Labels


def color_histogram(frame: Image, box: Array, bins: int = 8) -> Array:
    """Share of a box's pixels in each color bin (Zhang and Li 2008, eq. (7)).

    Args:
        frame: RGB, shape (H, W, 3), uint8.
        box: Left, top, width and height, px; parts outside the frame are ignored.
        bins: Number of bins of each channel.

    Returns:
        Shape (bins ** 3,); sums to 1, zeros for a box without a pixel.
    """
    return box_histograms(frame, box[None], bins)[0]


def bhattacharyya(p: Array, q: Array) -> float:
    """Bhattacharyya coefficient of two histograms: sum of sqrt(p_j q_j) (Zhang and Li 2008, eq. (8), with its root)."""
    return float(np.sqrt(p * q).sum())


def color_weights(similarity: Array, variance: float) -> Array:
    """Weights of sum 1 from Bhattacharyya coefficients (Zhang and Li 2008, eqs (9) and (11)).

    Args:
        similarity: Coefficients rho, shape (n,); the distance is the square root of 1 - rho.
        variance: Divisor of the squared distances; the factor before the exponential cancels. Raising it makes the
            weights more equal.

    Returns:
        Shape (n,).
    """
    squared = np.maximum(1.0 - similarity, 0.0)
    # The nearest candidate has exponent 0, so that not all weights underflow.
    weights = exponential((squared.min() - squared) / variance)
    return weights / weights.sum()


def learn(reference: Array, found: Array, rate: float, threshold: float) -> tuple[float, Array]:
    """Update a reference with the histogram of the estimated box if they are similar (Zhang and Li 2008, eq. (12)).

    Args:
        reference: Reference histogram, shape (bins ** 3,).
        found: Histogram of the estimated box, of the same shape.
        rate: Weight alpha of the new histogram.
        threshold: Similarity above which the reference is updated.

    Returns:
        Similarity of the two histograms, 0 to 1, and the new reference.
    """
    similarity = min(bhattacharyya(reference, found), 1.0)
    return similarity, (1.0 - rate) * reference + rate * found if similarity > threshold else reference


def similarities(frame: Image, boxes: Array, reference: Array, bins: int = 8) -> Array:
    """Bhattacharyya coefficient of every box's histogram with a reference (Zhang and Li 2008, eqs (7) and (8)).

    Args:
        frame: RGB, shape (H, W, 3), uint8, contiguous.
        boxes: Left, top, width and height. Shape (n, 4), px; parts outside the frame are ignored.
        reference: Reference histogram, shape (bins ** 3,).
        bins: Number of bins of each channel.

    Returns:
        Coefficients from 0 to 1, 0 for a box without a pixel. Shape (n,).
    """
    edges = pixel_edges(boxes, frame.shape)
    areas = (edges[:, 2] - edges[:, 0]) * (edges[:, 3] - edges[:, 1])
    found = np.zeros(len(boxes))
    if not areas.any():
        return found
    kept = np.flatnonzero(reference)
    columns = np.full(bins**3, len(kept), np.int32)
    columns[kept] = np.arange(len(kept))
    left, top = edges[areas > 0, :2].min(axis=0)
    right, bottom = edges[areas > 0, 2:].max(axis=0)
    region = frame[top:bottom, left:right]
    # Differences of 16-bit counters are exact for counts that fit, even if the counters overflow.
    counting = np.uint16 if areas.max() <= np.iinfo(np.uint16).max else np.uint32
    # One more column than kept bins: all other colors are counted there and never read.
    integral = np.empty((bottom - top + 1, right - left + 1, len(kept) + 1), counting)
    _integrate(region, bins, columns, integral)
    _compare(integral, edges - np.array([left, top, left, top]), np.sqrt(reference[kept]), found)
    return found


def pixel_edges(boxes: Array, shape: tuple[int, ...]) -> Labels:
    """First column and row, and column and row after the last, of the pixels with centers inside. Shape (n, 4)."""
    corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
    limit = np.array([shape[1], shape[0], shape[1], shape[0]], dtype=np.float64)
    edges = np.clip(np.ceil(corners - 0.5), 0.0, limit).astype(np.int64)
    edges[:, 2:] = np.maximum(edges[:, 2:], edges[:, :2])
    return edges


@njit(cache=True, nogil=True)
def color_bin(pixel, bins):  # type: ignore[no-untyped-def]
    """Bin of a pixel, numbered as in `servotrack.estimators.detect.appearance.color_bins`."""
    return ((pixel[0] * bins >> 8) * bins + (pixel[1] * bins >> 8)) * bins + (pixel[2] * bins >> 8)


@njit(cache=True, nogil=True)
def _integrate(region, bins, columns, integral):  # type: ignore[no-untyped-def]
    """Count the pixels of every kept bin above and left of every corner, modulo the type's range."""
    rows, width, kept = region.shape[0], region.shape[1], integral.shape[2]
    integral[0] = 0
    integral[:, 0] = 0
    so_far = np.empty(kept, integral.dtype)
    for row in range(rows):
        so_far[:] = 0
        for column in range(width):
            so_far[columns[color_bin(region[row, column], bins)]] += 1
            above, here = integral[row, column + 1], integral[row + 1, column + 1]
            for k in range(kept):
                here[k] = above[k] + so_far[k]


@njit(cache=True, nogil=True)
def _compare(integral, edges, roots, found):  # type: ignore[no-untyped-def]
    for n in range(edges.shape[0]):
        left, top, right, bottom = edges[n]
        area = (right - left) * (bottom - top)
        if area <= 0:
            continue
        a, b = integral[top, left], integral[top, right]
        c, d = integral[bottom, left], integral[bottom, right]
        total = 0.0
        for k in range(roots.shape[0]):
            count = np.uint32(d[k] - b[k] - c[k] + a[k])
            if integral.itemsize == 2:
                count = count & np.uint32(0xFFFF)
            total += roots[k] * np.sqrt(np.float64(count))
        found[n] = total / np.sqrt(np.float64(area))
