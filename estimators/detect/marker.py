"""Finds a marker of known color in images, to a fraction of a pixel: features for a servo that is given images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array, FloatArray, Image, Mask

_HALO = 2  # px around a blob that still hold light of its edge


@dataclass(frozen=True)
class MarkerDetector:
    """Segments by color and returns the intensity-weighted centroid of the most likely blob.

    Every pixel is scored by its color's component along the marker's *chroma*, which is the marker's color less its
    own gray. The score does not see gray light, so neither a textured gray floor nor a white ring; it is linear in
    the pixel, so that a pixel half covered by the marker scores half, and the centroid of the scores is that of the
    marker's true outline. Markers of another hue score below zero or low.

    Args:
        color: The marker's color in white light, RGB, 0 to 255. It must not be gray.
        threshold: Least score, as a fraction of the marker's in full light, of a pixel that belongs to a blob.
        least_weight: Least sum of a blob's scores, px of marker in full light; smaller blobs are taken for noise.

    Raises:
        ValueError: A gray color, or bounds that are not positive.
    """

    color: tuple[float, float, float] = (222.0, 64.0, 38.0)
    threshold: float = 0.25
    least_weight: float = 0.6

    def __post_init__(self) -> None:
        """Check the parameters."""
        color = np.asarray(self.color, dtype=np.float64)
        if color.shape != (3,) or not np.isfinite(color).all() or np.ptp(color) < 20.0:
            raise ValueError(f"color must be three channels that differ by at least 20 gray levels, got {self.color!r}")
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold must lie between 0 and 1, got {self.threshold!r}")
        if not self.least_weight > 0.0:
            raise ValueError(f"least_weight must be positive, got {self.least_weight!r}")

    def detect(self, images: ArrayLike) -> tuple[Array, Mask]:
        """Find the marker.

        Args:
            images: RGB, uint8. Shape (*batch, H, W, 3).

        Returns:
            Its center, column and row, where pixel k spans k to k + 1, shape (*batch, 2), px, zeros where it is not
            seen; and whether it is seen, shape (*batch,), bool. A marker that the image's border cuts is reported
            where its visible part is.

        Raises:
            ValueError: Not uint8 images of three channels.
        """
        stack = np.asarray(images)
        if stack.dtype != np.uint8 or stack.ndim < 3 or stack.shape[-1] != 3 or 0 in stack.shape[-3:-1]:
            raise ValueError(f"images must be uint8 of shape (*batch, H, W, 3), got {stack.dtype} {stack.shape}")
        batch = stack.shape[:-3]
        flat = stack.reshape(-1, *stack.shape[-3:])
        centers, seen = np.zeros((len(flat), 2)), np.zeros(len(flat), dtype=np.bool_)
        for row, image in enumerate(flat):
            center = self._find(self._score(image))
            if center is not None:
                centers[row], seen[row] = center, True
        return centers.reshape(*batch, 2), seen.reshape(batch)

    def _score(self, image: Image) -> FloatArray:
        """Component along the marker's chroma, 1 for the marker in full light, and about 0 for most of the image."""
        color = np.asarray(self.color, dtype=np.float64)
        chroma = color - color.mean()
        weights = (chroma / (chroma @ chroma)).astype(np.float32)
        score = cv2.transform(image.astype(np.float32), weights[None])
        # A floor that is not quite gray has a score of its own.
        return score - np.float32(np.median(score[::4, ::4]))

    def _find(self, score: FloatArray) -> tuple[float, float] | None:
        """Weighted centroid of the blob of greatest total score."""
        mask = (score > self.threshold).astype(np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        best, best_weight = None, self.least_weight
        for label in range(1, count):
            left, top, width, height = stats[label, :4]
            rows = slice(max(top - _HALO, 0), top + height + _HALO)
            columns = slice(max(left - _HALO, 0), left + width + _HALO)
            near = labels[rows, columns]
            # Pixels of other blobs are not this one's halo.
            weights = np.where((near == label) | (near == 0), np.maximum(score[rows, columns] - _FAINT, 0.0), 0.0)
            total = float(weights.sum(dtype=np.float64))
            if total > best_weight:
                x = np.arange(weights.shape[1]) + columns.start + 0.5
                y = np.arange(weights.shape[0]) + rows.start + 0.5
                along_x, along_y = weights.sum(axis=0, dtype=np.float64), weights.sum(axis=1, dtype=np.float64)
                best, best_weight = (float(along_x @ x) / total, float(along_y @ y) / total), total
        return best


_FAINT = 0.05
"""Scores below this are a floor's tint and noise, not marker."""
