"""Sampled curves in few bytes: rounded, differences, byte planes, zlib, Base64. JavaScript reads all of it."""

from __future__ import annotations

import base64
import zlib

import numpy as np
from numpy.typing import ArrayLike

ANGLE_STEP = 1e-4
"""Rounding of joint angles, rad: some 0.05 mm at the tool."""
PLACE_STEP = 2e-5
"""Rounding of positions on the floor, m."""
RATE_STEP = 1e-4
"""Rounding of noise on joint rates, rad/s."""
_LARGEST = 2**15
_HIGHEST_ORDER = 3
"""Highest order of differences that is tried; the one with the smallest numbers is kept."""


class Packer:
    """Gathers curves into one text.

    Attributes:
        curves: First value in steps, number of samples, step and order of differences of each curve, as added.
    """

    def __init__(self) -> None:
        self.curves: list[tuple[int, int, float, int]] = []
        self._words: list[np.ndarray] = []

    def add(self, values: ArrayLike, step: float, order: int | None = None) -> int:
        """Add a curve.

        Args:
            values: Samples, shape (k,), k at least 1.
            step: Rounding; raising it saves bytes.
            order: Order of differences, 0 for samples that do not follow from each other; None for the best from 1 on.

        Returns:
            Number of the curve.

        Raises:
            ValueError: A sample that is not finite, or a curve so rough that its differences need more than 16 bits.
        """
        samples = np.asarray(values, dtype=np.float64)
        if not np.isfinite(samples).all() or np.abs(samples).max() > 1e6 * step * _LARGEST:
            raise ValueError(f"values must be finite and at most {1e6 * step * _LARGEST:g}, got {samples}")
        rounded = np.rint(samples / step).astype(np.int64)
        first = rounded.min() if order == 0 else rounded[0]
        orders = [rounded - first]
        for _ in range(_HIGHEST_ORDER):
            orders.append(np.diff(orders[-1], prepend=0))
        if order is None:
            order = min(range(1, _HIGHEST_ORDER + 1), key=lambda order: int(np.abs(orders[order]).sum()))
        bends = orders[order]
        if np.abs(bends).max() >= _LARGEST:
            raise ValueError(f"values must bend by less than {step * _LARGEST:g} per sample, got {samples}")
        # Zigzag: small numbers of both signs have an empty high byte.
        self._words.append(((bends << 1) ^ (bends >> 63)).astype(np.uint16))
        self.curves.append((int(first), len(rounded), step, order))
        return len(self.curves) - 1

    def text(self) -> str:
        """All curves, Base64 of a zlib stream: the low bytes of all samples, then the high ones."""
        words = np.concatenate(self._words) if self._words else np.zeros(0, np.uint16)
        planes = (words & 0xFF).astype(np.uint8).tobytes() + (words >> 8).astype(np.uint8).tobytes()
        return base64.b64encode(zlib.compress(planes, 9)).decode("ascii")
