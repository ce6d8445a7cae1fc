"""Reference of a tracker: the first box turned by many angles, under the light of the present frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.color.cells import (
    CHANNELS,
    ORIENTATIONS,
    cell_weights,
    describe,
    integrate_channels,
    turned_part,
)
from servotrack.estimators.color.light import relit
from servotrack.estimators.elementary import cosine
from servotrack.estimators.types import Array, FloatArray, Image, Labels

_SATURATED = np.iinfo(np.uint8).max


class TurnedViews(NamedTuple):
    """Features of the first box, turned by each of the angles.

    Attributes:
        part: The part of the first frame that the turned boxes show, shape (h, w, 3), uint8.
        center: Center of the box in that part, shape (2,), px.
        size: Width and height of the box, px.
        grid: Number of cells per side.
        features: Features of each view, shape (angles, 2, f).
        gains: Logarithm of the gains of the light of each view since the first frame, shape (angles, 3).
    """

    part: Image
    center: Array
    size: Array
    grid: int
    features: FloatArray
    gains: Array

    def under(self, gains: Array, chosen: Labels, tolerance: float, corners: float) -> TurnedViews:
        """Return the views with those of some angles drawn anew where the light has changed since they were drawn.

        Args:
            gains: Logarithm of the present gains, shape (3,).
            chosen: Indices of the angles.
            tolerance: Largest difference of logarithmic gains that counts as no change.
            corners: Weight of the corners of the box in the features.
        """
        if np.abs(self.gains - gains).max() <= tolerance:
            return self
        stale = chosen[(np.abs(self.gains[chosen] - gains) > tolerance).any(axis=1)]
        if not stale.size:
            return self
        views = self._replace(features=self.features.copy(), gains=self.gains.copy())
        for k in np.unique(stale).tolist():
            views.features[k] = self._features(k, gains, cell_weights(self.grid, corners))
            views.gains[k] = gains
        return views

    def unsaturated(self, gains: Array) -> float:
        """Share of the box that is not saturated under the given gains, of what was not in the first frame; 0 to 1."""
        low = np.maximum(np.floor(self.center - 0.5 * self.size), 0.0).astype(np.int64)
        high = np.ceil(self.center + 0.5 * self.size).astype(np.int64)
        part = self.part[low[1] : high[1], low[0] : high[0]]
        before, now = int((part < _SATURATED).sum()), int((relit(part, gains) < _SATURATED).sum())
        return min(now / max(before, 1), 1.0)

    def _features(self, k: int, gains: Array, weights: FloatArray) -> FloatArray:
        angle = np.array([2.0 * np.pi * k / len(self.features)])
        width, height = turned_sizes(self.size, angle)[0]
        # Gradients at the border need a rim of a pixel, and the middle of the box is that of the part.
        rows, columns = (2 * int(np.ceil(0.5 * side + 2.0)) for side in (height, width))
        part = np.empty((rows, columns, 3), np.uint8)
        turned_part(self.part, self.center, float(cosine(angle[0])), float(cosine(angle[0] - 0.5 * np.pi)), part)
        if gains.any():
            part = relit(part, gains)
        integral = np.empty((rows + 1, columns + 1, CHANNELS), np.float32)
        integrate_channels(part, np.zeros(1, np.float32), 1, integral)
        box = np.array([[0.5 * (columns - width), 0.5 * (rows - height), width, height]])
        found = np.zeros((1, 2, self.features.shape[2]), np.float32)
        # The contrast is not used, and any rim will do.
        describe(integral, box, self.grid, 1.0, weights, found, np.zeros(1))
        return found[0]


def turned_views(image: Image, box: Array, angles: int, grid: int) -> TurnedViews:
    """Draw the views of a box.

    Args:
        image: RGB, shape (H, W, 3), uint8.
        box: Left, top, width and height, shape (4,), px.
        angles: Number of angles, from 0 to 2 pi.
        grid: Number of cells per side.
    """
    center = box[:2] + 0.5 * box[2:]
    reach = 0.5 * np.hypot(*box[2:]) + 6.0
    size = np.array([image.shape[1], image.shape[0]])
    low = np.clip(np.floor(center - reach).astype(np.int64), 0, size - 1)
    high = np.maximum(np.clip(np.ceil(center + reach).astype(np.int64), 0, size), low + 1)
    part = image[low[1] : high[1], low[0] : high[0]].copy()
    # Gains of no light, so that every view is drawn.
    empty = np.zeros((angles, 2, grid**2 * ORIENTATIONS), np.float32), np.full((angles, 3), np.inf)
    views = TurnedViews(part, center - low, box[2:], grid, *empty)
    return views.under(np.zeros(3), np.arange(angles), 0.0, 1.0)


def turned_sizes(size: Array, angles: Array) -> Array:
    """Widths and heights of the boxes around an ellipse that fills a box, turned.

    Args:
        size: Width and height of the box, px.
        angles: Angles, shape (n,), rad.

    Returns:
        Shape (n, 2), px.
    """
    cos, sin = cosine(np.stack([angles, angles - 0.5 * np.pi]))[..., None]
    return np.sqrt((cos * size) ** 2 + (sin * size[::-1]) ** 2)
