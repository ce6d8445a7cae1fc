"""From a foreground mask to detections: morphology, connected regions, and separation of people who touch."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.detect.appearance import run_appearance
from servotrack.estimators.detect.bodies import (
    BodySizes,
    Cover,
    body_line,
    divisible,
    find_bodies,
    learn_sizes,
    no_sizes,
)
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.detect.images import checked_image
from servotrack.estimators.detect.runs import label_runs, measure_runs
from servotrack.estimators.types import Image


@dataclass(frozen=True)
class BlobFinder:
    """Opening, closing, connected regions, and a model of the height of people by image row.

    A region is one detection as long as no sizes are known. The height of a person by the row of the feet is learned
    from regions with the shape of one person; then regions too large for one person are divided into several people
    (`split`), and parts one above the other are joined.

    The confidence of a detection is 1 for a person who is entirely visible, and less by the hidden share.

    Args:
        opening: Side of the square of the opening, px; 1 for none. Raising it removes larger specks.
        closing: Width and height of the rectangle of the closing, px; (1, 1) for none. A rectangle taller than wide
            joins head, trunk and legs rather than people side by side.
        smallest: Smallest number of pixels of a region.
        split: True to learn sizes and separate people who touch.
        least_height: People with a smaller expected height at their feet are too far away and left out, px; 0 for none.
            Only with `split`.
        bins: Number of bins per channel of the color histograms that serve as appearance, 0 for none.
        cover: Parameters of learning heights, joining parts and dividing regions.
        filled: Number of pixels of a person who is entirely visible, in squares of the height. Raising it lowers the
            confidences.

    Raises:
        ValueError: A parameter is out of range.
    """

    opening: int = 3
    closing: tuple[int, int] = (3, 7)
    smallest: int = 40
    split: bool = True
    least_height: float = 20.0
    bins: int = 8
    cover: Cover = field(default_factory=Cover)
    filled: float = 0.2

    def __post_init__(self) -> None:
        """Check the parameters."""
        if not (isinstance(self.opening, int) and self.opening >= 1):
            raise ValueError(f"opening must be a whole number of at least 1 px, got {self.opening!r}")
        if len(self.closing) != 2 or not all(isinstance(side, int) and side >= 1 for side in self.closing):
            raise ValueError(f"closing must be two whole numbers of at least 1 px, got {self.closing!r}")
        if not self.smallest >= 1:
            raise ValueError(f"smallest must be at least 1 px, got {self.smallest!r}")
        if not (isinstance(self.bins, int) and 0 <= self.bins <= 16):
            raise ValueError(f"bins must be a whole number from 0 to 16, got {self.bins!r}")
        if not 0.0 <= self.least_height < np.inf:
            raise ValueError(f"least_height must be finite and at least 0 px, got {self.least_height!r}")
        if not 0.0 < self.filled <= 1.0:
            raise ValueError(f"filled must be above 0 and at most 1, got {self.filled!r}")

    def initial(self) -> BodySizes:
        """State before the first mask: no known sizes of people."""
        return no_sizes()

    def clean(self, mask: Image) -> Image:
        """Apply the opening, which removes specks, and the closing, which joins the parts of a body.

        Args:
            mask: Nonzero on the foreground. Shape (H, W), uint8.

        Returns:
            Mask of the same shape and type.
        """
        clean = mask
        if self.opening > 1:
            clean = _morphology(clean, cv2.MORPH_OPEN, self.opening, self.opening)
        if self.closing != (1, 1):
            clean = _morphology(clean, cv2.MORPH_CLOSE, *self.closing)
        return clean

    def step(self, state: BodySizes, mask: ArrayLike, image: ArrayLike) -> tuple[BodySizes, Detections]:
        """Find the detections of one mask.

        Args:
            state: Sizes of people so far.
            mask: Nonzero on the foreground. Shape (H, W), uint8.
            image: Frame for the color histograms, RGB or gray, uint8. Shape (H, W, 3) or (H, W).

        Returns:
            State and detections.

        Raises:
            ValueError: An array has another type or shape.
        """
        checked = checked_image(image, "image")
        cleaned = self.clean(checked_image(mask, "mask", checked.shape[:2]))
        runs, regions = label_runs(cleaned)
        return self.find(state, runs, regions, checked)

    def find(
        self, state: BodySizes, runs: NDArray[np.int32], regions: int, image: Image
    ) -> tuple[BodySizes, Detections]:
        """Find the detections of labeled regions.

        Args:
            state: Sizes of people so far.
            runs: Pixels of the regions from `label_runs`; changed. Runs with a negative index belong to no region.
            regions: Number of regions.
            image: Frame for the color histograms, RGB or gray, uint8. Shape (H, W, 3) or (H, W).

        Returns:
            State and detections.
        """
        boxes, centroids, areas = measure_runs(runs, regions)
        keep = areas >= self.smallest
        number = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)
        runs[:, 3] = number[runs[:, 3]]
        boxes, centroids, areas = boxes[keep], centroids[keep], areas[keep]
        confidences = np.ones(len(boxes))
        if self.split:
            line = body_line(state, image.shape[0], self.cover)
            cover = self.cover if divisible(state, self.cover) else self.cover._replace(wide=np.inf, tall=np.inf)
            state = learn_sizes(state, boxes, areas, image.shape, self.cover)
            if line is not None:
                runs, boxes, heights = find_bodies(runs, boxes, line, cover)
                keep = np.maximum(heights, boxes[:, 3]) >= self.least_height
                runs[:, 3] = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)[runs[:, 3]]
                boxes = boxes[keep]
                _, centroids, areas = measure_runs(runs, len(boxes))
                whole = self.filled * heights[keep] ** 2
                # The part of a person beyond the image's border does not count as hidden.
                cut = (boxes[:, 0] <= 0.0) | (boxes[:, 0] + boxes[:, 2] >= image.shape[1])
                whole[cut] *= np.minimum(boxes[cut, 2] / (self.cover.aspect * heights[keep][cut]), 1.0)
                confidences = np.minimum(areas / whole, 1.0)
        features = run_appearance(image, runs, len(boxes), self.bins) if self.bins else np.zeros((len(boxes), 0))
        return state, Detections(boxes, centroids, areas, confidences, features)


def _morphology(mask: Image, operation: int, width: int, height: int) -> Image:
    return np.asarray(cv2.morphologyEx(mask, operation, np.ones((height, width), np.uint8)), dtype=np.uint8)
