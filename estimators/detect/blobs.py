"""From a foreground mask to detections: morphology, connected regions, and separation of people who touch."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeAlias

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
from servotrack.estimators.detect.runs import keep_regions, label_runs, measure_runs
from servotrack.estimators.detect.scene_sizes import (
    TABLE,
    SceneRules,
    SceneSizes,
    contradicted,
    judge_line,
    learn_scene,
    lies,
    no_scene_sizes,
    supported,
)
from servotrack.estimators.types import Array, Image

REFERENCE_HEIGHT = 66.0
"""Height of people that `BlobFinder.closing` refers to, px."""


Sizes: TypeAlias = BodySizes | SceneSizes
"""State of a `BlobFinder`: heights of people by row."""


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
        scene: Parameters of learning heights from regions that vote with their pixels, with a test of whether the scene
            supports them (see `servotrack.estimators.detect.scene_sizes`). Regions are divided and joined only then.
            None: heights per band of rows from counts of regions, which `least_height` belongs to.

    Raises:
        ValueError: A parameter is out of range.
    """

    opening: int = 2
    closing: tuple[int, int] = (3, 7)
    smallest: int = 12
    split: bool = True
    least_height: float = 20.0
    bins: int = 8
    cover: Cover = field(default_factory=Cover)
    filled: float = 0.2
    scene: SceneRules | None = field(default_factory=SceneRules)

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

    def initial(self) -> Sizes:
        """State before the first mask: no known sizes of people."""
        return no_scene_sizes() if self.split and self.scene is not None else no_sizes()

    def typical_height(self, state: Sizes) -> float:
        """Median height of people in the scene, px; 0 before it is known."""
        if not isinstance(state, SceneSizes) or state.line is None or state.seen < self.cover.join_after:
            return 0.0
        return state.line.typical

    def notice(self, state: Sizes) -> str:
        """Sentence on why regions are no people or not divided, empty if they are or if too few were seen."""
        if not isinstance(state, SceneSizes) or self.scene is None:
            return ""
        if lies(state, self.scene):
            return (
                "most things are wider than they are tall, where upright people are expected; turn the picture if the "
                "camera lies on its side; for vehicles use a detector of theirs, such as --detector model.onnx"
            )
        if state.seen < self.scene.sure:
            return ""
        if not supported(state, self.scene):
            reason = "the heights of people do not follow from their place in the image"
        elif contradicted(state, self.scene) >= self.scene.contradiction:
            reason = "most regions with the shape of one person would be divided"
        else:
            return ""
        return (
            f"people who touch count as one, because {reason}; use a detector that finds people by their shape, such "
            "as --detector model.onnx"
        )

    def expected_heights(self, state: Sizes, boxes: Array) -> Array:
        """Height of a person at the place of each region, shape (k,), px; 0 where none is known.

        Args:
            state: Sizes of people so far.
            boxes: Boxes of the regions. Shape (k, 4), px.
        """
        typical = self.typical_height(state)
        heights = np.full(len(boxes), typical)
        if typical and isinstance(state, SceneSizes) and state.line is not None and supported(state, self.scene):
            heights = np.maximum(state.line.intercept + state.line.slope * (boxes[:, 1] + boxes[:, 3]), TABLE.lowest)
        return heights

    def clean(self, mask: Image, typical: float = 0.0) -> Image:
        """Apply the opening, which removes specks, and the closing, which joins the parts of a body.

        Args:
            mask: Nonzero on the foreground. Shape (H, W), uint8.
            typical: Height of people, px, with which the closing shrinks below `REFERENCE_HEIGHT`; 0 if unknown.

        Returns:
            Mask of the same shape and type.
        """
        clean = mask
        if self.opening > 1:
            clean = _open(clean, self.opening)
        closing = self.closing
        if typical:
            share = min(typical / REFERENCE_HEIGHT, 1.0)
            closing = (max(round(closing[0] * share), 1), max(round(closing[1] * share), 1))
        if closing != (1, 1):
            clean = _morphology(clean, cv2.MORPH_CLOSE, *closing)
        return clean

    def step(self, state: Sizes, mask: ArrayLike, image: ArrayLike) -> tuple[Sizes, Detections]:
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

    def find(self, state: Sizes, runs: NDArray[np.int32], regions: int, image: Image) -> tuple[Sizes, Detections]:
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
        keep_regions(runs, keep)
        boxes, centroids, areas = boxes[keep], centroids[keep], areas[keep]
        confidences = np.ones(len(boxes))
        if isinstance(state, SceneSizes):
            return self._find_in_scene(state, runs, boxes, centroids, areas, image)
        if self.split:
            line = body_line(state, image.shape[0], self.cover)
            cover = self.cover if divisible(state, self.cover) else self.cover._replace(wide=np.inf, tall=np.inf)
            state = learn_sizes(state, boxes, areas, image.shape, self.cover)
            if line is not None:
                runs, boxes, heights = find_bodies(runs, boxes, line, cover)
                keep = np.maximum(heights, boxes[:, 3]) >= self.least_height
                keep_regions(runs, keep)
                boxes = boxes[keep]
                _, centroids, areas = measure_runs(runs, len(boxes))
                whole = self.filled * heights[keep] ** 2
                # The part of a person beyond the image's border does not count as hidden.
                cut = (boxes[:, 0] <= 0.0) | (boxes[:, 0] + boxes[:, 2] >= image.shape[1])
                whole[cut] *= np.minimum(boxes[cut, 2] / (self.cover.aspect * heights[keep][cut]), 1.0)
                confidences = np.minimum(areas / whole, 1.0)
        features = run_appearance(image, runs, len(boxes), self.bins) if self.bins else np.zeros((len(boxes), 0))
        return state, Detections(boxes, centroids, areas, confidences, features)

    def _find_in_scene(
        self, state: SceneSizes, runs: NDArray[np.int32], boxes: Array, centroids: Array, areas: Array, image: Image
    ) -> tuple[SceneSizes, Detections]:
        """Find detections with the heights of the scene, as far as it supports them."""
        rules, shape = self.scene, image.shape
        assert rules is not None
        state = learn_scene(state, boxes, areas, shape, rules)
        confidences = np.ones(len(boxes))
        whole, keep = np.zeros(len(boxes)), np.ones(len(boxes), np.bool_)
        if len(areas) and state.seen < self.cover.join_after:
            # Before people are known, the largest region is the measure.
            keep = areas >= rules.speck * areas.max()
        elif state.line is not None:
            line = state.line
            whole = np.full(len(boxes), self.filled * line.typical**2)
            keep = areas >= rules.speck * whole
            if supported(state, rules):
                divide = state.seen >= self.cover.divide_after and contradicted(state, rules) < rules.contradiction
                state = judge_line(state, boxes, areas, shape, self.cover.tall, rules)
                cover = self.cover._replace(first_row=line.first_row, last_row=line.last_row if divide else -np.inf)
                runs, boxes, heights = find_bodies(runs, boxes, (line.intercept, line.slope), cover)
                _, centroids, areas = measure_runs(runs, len(boxes))
                whole = self.filled * heights**2
                # The part of a person beyond the image's border does not count as hidden.
                cut = (boxes[:, 0] <= 0.0) | (boxes[:, 0] + boxes[:, 2] >= shape[1])
                whole[cut] *= np.minimum(boxes[cut, 2] / (self.cover.aspect * heights[cut]), 1.0)
                confidences = np.minimum(areas / whole, 1.0)
                keep = (confidences >= rules.part) & (np.maximum(heights, boxes[:, 3]) >= rules.far * line.typical)
        keep_regions(runs, keep)
        boxes, centroids, areas, confidences = boxes[keep], centroids[keep], areas[keep], confidences[keep]
        features = run_appearance(image, runs, len(boxes), self.bins) if self.bins else np.zeros((len(boxes), 0))
        return state, Detections(boxes, centroids, areas, confidences, features)


def _open(mask: Image, side: int) -> Image:
    """Erosion and dilation by a square. For an even side the anchors differ, so that nothing is shifted."""
    square, far = _rectangle(side, side), side // 2
    eroded = cv2.erode(mask, square, anchor=(far, far))
    return np.asarray(cv2.dilate(eroded, square, anchor=(side - 1 - far, side - 1 - far)), dtype=np.uint8)


@lru_cache(maxsize=32)
def _rectangle(width: int, height: int) -> Image:
    return np.ones((height, width), np.uint8)


def _morphology(mask: Image, operation: int, width: int, height: int) -> Image:
    return np.asarray(cv2.morphologyEx(mask, operation, _rectangle(width, height)), dtype=np.uint8)
