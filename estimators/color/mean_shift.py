"""Kernel mean shift with scale adaptation (Comaniciu, Ramesh and Meer), the reference method of Zhang and Li 2008."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.color.contract import (
    BoxEstimate,
    Pose,
    check_fields,
    checked_frame,
    start,
)
from servotrack.estimators.color.histogram import color_bin
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Image


class MeanShiftState(NamedTuple):
    """Memory of a `KernelMeanShift`.

    Attributes:
        pose: The last estimate.
        reference: Kernel-weighted histogram of the object, shape (bins ** 3,).
    """

    pose: Pose
    reference: Array


@dataclass(frozen=True)
class KernelMeanShift:
    """Climbs the Bhattacharyya coefficient of kernel-weighted color histograms, at three scales.

    Source: Comaniciu, Ramesh and Meer, "Kernel-based object tracking", IEEE TPAMI 25(5), 2003, sections 3 to 4.4, with
    the Epanechnikov kernel. The reference is never updated. The scale step of 10 % and the mixing of 0.1 are those of
    the source.

    Attributes:
        scale_step: Each frame is also searched with a box larger and smaller by this share; 0 keeps the scale.
        scale_mixing: Share gamma of the best scale in the new one. Raising it adapts the scale faster.
        iterations: Largest number of steps of one search.
        tolerance: A shorter step ends the search, px.
        bins: Number of bins of each color channel.
    """

    scale_step: float = 0.1
    scale_mixing: float = 0.1
    iterations: int = 20
    tolerance: float = 0.2
    bins: int = 8

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        check_fields(self, counts=("iterations",), positive=("tolerance",), shares=("scale_step", "scale_mixing"))

    def initial(self, frame: ArrayLike, box: ArrayLike) -> MeanShiftState:
        """Compute the object's reference; arguments and errors as in `MonteCarloColor.initial`."""
        image, first, pose = start(frame, box)
        return MeanShiftState(pose, kernel_histogram(image, pose.center, first[2:], self.bins))

    def step(self, state: MeanShiftState, frame: ArrayLike) -> tuple[MeanShiftState, BoxEstimate]:
        """Search from the last position; arguments and errors as in `MonteCarloColor.step`."""
        last = state.pose
        image = checked_frame(frame, last.shape)
        best_center, best_scale, best = last.center, last.scale, -1.0
        for factor in (1.0, 1.0 - self.scale_step, 1.0 + self.scale_step):
            scale = float(last.bounded(np.array(factor * last.scale)))
            center, similarity = self._climb(image, state, scale)
            if similarity > best:
                best_center, best_scale, best = center, scale, similarity
        scale = self.scale_mixing * best_scale + (1.0 - self.scale_mixing) * last.scale
        pose = last._replace(center=last.within(best_center), scale=scale)
        return state._replace(pose=pose), BoxEstimate(pose.box, best)

    def _climb(self, image: Image, state: MeanShiftState, scale: float) -> tuple[Array, float]:
        size = scale * state.pose.size
        x, y, similarity = _climb(
            image, state.pose.center, size, state.reference, self.bins, self.iterations, self.tolerance
        )
        return np.array([x, y]), min(float(similarity), 1.0)


def kernel_histogram(frame: Image, center: Array, size: Array, bins: int = 8) -> Array:
    """Color histogram weighted by the Epanechnikov kernel of the box's ellipse (eq. (2) of the source).

    Args:
        frame: RGB, shape (H, W, 3), uint8.
        center: Center of the box, shape (2,), px.
        size: Width and height of the box, px.
        bins: Number of bins of each channel.

    Returns:
        Shape (bins ** 3,); sums to 1, zeros if no pixel lies inside.
    """
    out = np.zeros(bins**3)
    _fill_histogram(frame, float(center[0]), float(center[1]), float(size[0]) / 2.0, float(size[1]) / 2.0, bins, out)
    return out


@njit(cache=True, nogil=True)
def _window(middle, half, limit):  # type: ignore[no-untyped-def]
    """First pixel, and pixel after the last, whose centers may lie within `half` of the middle."""
    return max(int(np.floor(middle - half)), 0), min(int(np.ceil(middle + half)) + 1, limit)


@njit(cache=True, nogil=True)
def _fill_histogram(image, x, y, half_width, half_height, bins, out):  # type: ignore[no-untyped-def]
    out[:] = 0.0
    left, right = _window(x, half_width, image.shape[1])
    top, bottom = _window(y, half_height, image.shape[0])
    total = 0.0
    for row in range(top, bottom):
        v = (row + 0.5 - y) / half_height
        for column in range(left, right):
            u = (column + 0.5 - x) / half_width
            weight = 1.0 - u * u - v * v
            if weight > 0.0:
                out[color_bin(image[row, column], bins)] += weight
                total += weight
    if total > 0.0:
        for k in range(out.shape[0]):
            out[k] /= total


@njit(cache=True, nogil=True)
def _coefficient(p, q):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(p.shape[0]):
        total += np.sqrt(p[k] * q[k])
    return total


@njit(cache=True, nogil=True)
def _climb(image, center, size, reference, bins, iterations, tolerance):  # type: ignore[no-untyped-def]
    """Mean shift (eqs (10) and (13) of the source); each step is halved until the coefficient does not decrease."""
    half_width, half_height = size[0] / 2.0, size[1] / 2.0
    x, y = center[0], center[1]
    here = np.zeros(reference.shape[0])
    there = np.zeros(reference.shape[0])
    _fill_histogram(image, x, y, half_width, half_height, bins, here)
    similarity = _coefficient(here, reference)
    for _ in range(iterations):
        left, right = _window(x, half_width, image.shape[1])
        top, bottom = _window(y, half_height, image.shape[0])
        total, sum_x, sum_y = 0.0, 0.0, 0.0
        for row in range(top, bottom):
            v = (row + 0.5 - y) / half_height
            for column in range(left, right):
                u = (column + 0.5 - x) / half_width
                if u * u + v * v < 1.0:
                    k = color_bin(image[row, column], bins)
                    weight = np.sqrt(reference[k] / here[k]) if here[k] > 0.0 else 0.0
                    total += weight
                    sum_x += weight * (column + 0.5)
                    sum_y += weight * (row + 0.5)
        if total <= 0.0:
            break
        new_x, new_y = sum_x / total, sum_y / total
        _fill_histogram(image, new_x, new_y, half_width, half_height, bins, there)
        new = _coefficient(there, reference)
        while new < similarity and np.hypot(new_x - x, new_y - y) > tolerance:
            new_x, new_y = (x + new_x) / 2.0, (y + new_y) / 2.0
            _fill_histogram(image, new_x, new_y, half_width, half_height, bins, there)
            new = _coefficient(there, reference)
        moved = np.hypot(new_x - x, new_y - y)
        if new < similarity:
            break
        x, y, similarity = new_x, new_y, new
        here, there = there, here
        if moved < tolerance:
            break
    return x, y, similarity
