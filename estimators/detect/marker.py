"""Detector of a marker of known color with sub-pixel accuracy: image features for visual servoing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.detect.images import checked_stack
from servotrack.estimators.types import Array, FloatArray, Image, Mask


@dataclass(frozen=True)
class MarkerDetector:
    """Segments by color and returns the intensity-weighted centroid of the most likely blob.

    The score of a pixel is the component of its color along the marker's *chroma*, that is, the marker's color minus
    its gray part. Gray light does not change the score, so a textured gray floor or a white ring scores zero. The score
    is linear in the pixel: a pixel half covered by the marker scores half, and the centroid of the scores is that of
    the marker's true outline. Markers of another hue have a low or negative score.

    Args:
        color: Color of the marker in white light, RGB, 0 to 255. It must not be gray.
        threshold: Smallest score of a pixel in a blob, as a fraction of the marker's score in full light. Raising it
            ignores more noise and dim markers.
        least_weight: Smallest sum of scores of a blob, px of marker in full light. Raising it ignores smaller blobs.
        halo: Margin around a blob whose pixels contribute to the centroid, since they contain light of its edge, px.
        tint: Score that is subtracted in the centroid, which removes the tint of the floor and noise.

    Raises:
        ValueError: The color is gray, or a bound is out of range.
    """

    color: tuple[float, float, float] = (222.0, 64.0, 38.0)
    threshold: float = 0.25
    least_weight: float = 0.6
    halo: int = 2
    tint: float = 0.05

    def __post_init__(self) -> None:
        """Check the parameters."""
        color = np.asarray(self.color, dtype=np.float64)
        if color.shape != (3,) or not np.isfinite(color).all() or np.ptp(color) < 20.0:
            raise ValueError(f"color must be three channels that differ by at least 20 gray levels, got {self.color!r}")
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold must lie between 0 and 1, got {self.threshold!r}")
        if not self.least_weight > 0.0:
            raise ValueError(f"least_weight must be positive, got {self.least_weight!r}")
        if not self.halo >= 0 or not self.tint >= 0.0:
            raise ValueError(f"halo and tint must be at least 0, got {self.halo!r}, {self.tint!r}")

    def detect(self, images: ArrayLike) -> tuple[Array, Mask]:
        """Find the marker.

        Args:
            images: RGB, uint8. Shape (*batch, H, W, 3).

        Returns:
            Center of the marker (column, row), shape (*batch, 2), px, pixel k spans k to k + 1, zeros if it is not
            detected; and mask of detections, shape (*batch,), bool. For a marker that the image's border cuts, the
            center is that of its visible part.

        Raises:
            ValueError: The images are not uint8 with three channels.
        """
        stack = checked_stack(images)
        batch = stack.shape[:-3]
        flat = stack.reshape(-1, *stack.shape[-3:])
        centers, seen = np.zeros((len(flat), 2)), np.zeros(len(flat), dtype=np.bool_)
        for row, image in enumerate(flat):
            center = self._find(self._score(image))
            if center is not None:
                centers[row], seen[row] = center, True
        return centers.reshape(*batch, 2), seen.reshape(batch)

    def _score(self, image: Image) -> FloatArray:
        """Component along the marker's chroma, 1 for the marker in full light and about 0 for most of the image."""
        color = np.asarray(self.color, dtype=np.float64)
        chroma = color - color.mean()
        weights = (chroma / (chroma @ chroma)).astype(np.float32)
        score = cv2.transform(image.astype(np.float32), weights[None])
        # The median removes the score of a floor that is not exactly gray.
        return score - np.float32(np.median(score[::4, ::4]))

    def _find(self, score: FloatArray) -> tuple[float, float] | None:
        """Weighted centroid of the blob with the largest total score."""
        mask = (score > self.threshold).astype(np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        best, best_weight = None, self.least_weight
        for label in range(1, count):
            left, top, width, height = stats[label, :4]
            rows = slice(max(top - self.halo, 0), top + height + self.halo)
            columns = slice(max(left - self.halo, 0), left + width + self.halo)
            near = labels[rows, columns]
            # Pixels of other blobs in the margin are left out.
            weights = np.where((near == label) | (near == 0), np.maximum(score[rows, columns] - self.tint, 0.0), 0.0)
            total = float(weights.sum(dtype=np.float64))
            if total > best_weight:
                x = np.arange(weights.shape[1]) + columns.start + 0.5
                y = np.arange(weights.shape[0]) + rows.start + 0.5
                along_x, along_y = weights.sum(axis=0, dtype=np.float64), weights.sum(axis=1, dtype=np.float64)
                best, best_weight = (float(along_x @ x) / total, float(along_y @ y) / total), total
        return best
