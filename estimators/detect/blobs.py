"""From a mask of foreground to detections: clean it, connect it, tell people who touch apart."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.detect.appearance import run_appearance
from servotrack.estimators.detect.bodies import (
    BODY_ASPECT,
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

_FILLED = 0.2  # pixels of a person who is seen whole, in squares of the height


@dataclass(frozen=True)
class BlobFinder:
    """Opening, closing, connected regions, and a model of how tall people are at each row of the image.

    A region is one detection as long as nothing is known about sizes. The height of a person by the row of the feet is
    learned from regions that look like one person; from then on, regions too large for one person are explained by
    several (`split`), and parts that stand one above the other are joined.

    Args:
        opening: Side of the square of the opening, px; 1 for none.
        closing: Width and height of the rectangle of the closing, px; (1, 1) for none. Taller than wide it joins head,
            trunk and legs rather than people side by side.
        smallest: Least number of a region's pixels.
        split: Whether to learn sizes and tell people who touch apart.
        least_height: People who are smaller where their feet are, as learned, are too far away and left out, px; 0 for
            none. Only with `split`.
        bins: Bins per channel of the color histograms that serve as appearance, 0 for none.

        cover: When regions are joined and divided.

    The confidence of a detection is 1 for a person who is seen whole, and less by the share that is hidden.

    Raises:
        ValueError: A parameter out of range.
    """

    opening: int = 3
    closing: tuple[int, int] = (3, 7)
    smallest: int = 40
    split: bool = True
    least_height: float = 20.0
    bins: int = 8
    cover: Cover = field(default_factory=Cover)

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

    def initial(self) -> BodySizes:
        """Nothing is known about the sizes of people yet."""
        return no_sizes()

    def clean(self, mask: Image) -> Image:
        """The opening, which takes specks away, and the closing, which joins the parts of a body.

        Args:
            mask: Not 0 on the foreground. Shape (H, W), uint8.

        Returns:
            A mask of the same kind.
        """
        clean = mask
        if self.opening > 1:
            clean = _morphology(clean, cv2.MORPH_OPEN, self.opening, self.opening)
        if self.closing != (1, 1):
            clean = _morphology(clean, cv2.MORPH_CLOSE, *self.closing)
        return clean

    def step(self, state: BodySizes, mask: ArrayLike, image: ArrayLike) -> tuple[BodySizes, Detections]:
        """Detections of one mask.

        Args:
            state: What is known about the sizes of people.
            mask: Not 0 on the foreground. Shape (H, W), uint8.
            image: The frame that the colors are taken from, RGB or gray, uint8. Shape (H, W, 3) or (H, W).

        Returns:
            State and detections.

        Raises:
            ValueError: Arrays of another type or shape.
        """
        checked = checked_image(image, "image")
        cleaned = self.clean(checked_image(mask, "mask", checked.shape[:2]))
        runs, regions = label_runs(cleaned)
        return self.find(state, runs, regions, checked)

    def find(
        self, state: BodySizes, runs: NDArray[np.int32], regions: int, image: Image
    ) -> tuple[BodySizes, Detections]:
        """Detections of regions that are connected already.

        Args:
            state: What is known about the sizes of people.
            runs: The regions' pixels, as `label_runs` gives them; changed. A negative number belongs to no region.
            regions: Number of regions.
            image: RGB or gray, uint8. Shape (H, W, 3) or (H, W).

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
            line = body_line(state, image.shape[0])
            cover = self.cover if divisible(state) else self.cover._replace(wide=np.inf, tall=np.inf)
            state = learn_sizes(state, boxes, areas, image.shape)
            if line is not None:
                runs, boxes, heights = find_bodies(runs, boxes, line, cover)
                keep = np.maximum(heights, boxes[:, 3]) >= self.least_height
                runs[:, 3] = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)[runs[:, 3]]
                boxes = boxes[keep]
                _, centroids, areas = measure_runs(runs, len(boxes))
                whole = _FILLED * heights[keep] ** 2
                # What the image's border cuts off is not hidden by anybody.
                cut = (boxes[:, 0] <= 0.0) | (boxes[:, 0] + boxes[:, 2] >= image.shape[1])
                whole[cut] *= np.minimum(boxes[cut, 2] / (BODY_ASPECT * heights[keep][cut]), 1.0)
                confidences = np.minimum(areas / whole, 1.0)
        features = run_appearance(image, runs, len(boxes), self.bins) if self.bins else np.zeros((len(boxes), 0))
        return state, Detections(boxes, centroids, areas, confidences, features)


def _morphology(mask: Image, operation: int, width: int, height: int) -> Image:
    return np.asarray(cv2.morphologyEx(mask, operation, np.ones((height, width), np.uint8)), dtype=np.uint8)
