"""Motion detection by the difference to a background that learns outside the foreground (Wu and Hu 2010, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.blobs import BlobFinder
from servotrack.estimators.detect.bodies import BodySizes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.detect.faint import FaintRules, add_faint_regions, join_by_faint_regions
from servotrack.estimators.detect.healing import HealingRules, heal_regions
from servotrack.estimators.detect.images import checked_image, checked_images
from servotrack.estimators.detect.runs import label_runs, measure_runs
from servotrack.estimators.types import FloatArray, Image


class BackgroundState(NamedTuple):
    """State of a `MaskedBackground`; its arrays are never changed in place.

    Attributes:
        background: Background with the shape of a frame, float32, gray levels.
        rounded: Background in uint8.
        mask: Foreground of the last frame after opening and closing, 0 or 255. Shape (H, W), uint8.
        sizes: Heights of people by row.
        frames: Number of frames so far.
        flooded: Number of consecutive frames whose foreground covered more than `flood` of the image.
    """

    background: FloatArray
    rounded: Image
    mask: Image
    sizes: BodySizes
    frames: int
    flooded: int


@dataclass(frozen=True)
class MaskedBackground:
    """Background subtraction whose background does not learn under foreground (Wu and Hu 2010, equations 5 and 6).

    P = |I - B| >= threshold and B' = (1 - a) B + a P.B + a (1 - P).I. This rule never absorbs a person who stands
    still. For the same reason it never recovers from a change of light larger than the threshold, nor from people in
    the first frame. `heal_every` corrects both (see `servotrack.estimators.detect.healing`), `flood` the rest.

    Args:
        threshold: Difference from which a pixel is foreground, gray levels, or "otsu" for Otsu's threshold of every
            frame. Raising it gives less foreground.
        least_threshold: Lower limit of Otsu's threshold, gray levels; in an empty scene Otsu's threshold divides noise.
        faint: Lower threshold for slender regions around clear foreground, gray levels; 0 for none. It completes people
            in the background's colors; slender regions cannot join people.
        learning_rate: Weight a of a new frame, per frame, in (0, 1). Raising it adapts faster.
        start: First background from the frames given to `initial`: their "median", or their "mean", as in the paper.
        color: Difference of a pixel: "max" over the channels, or of "gray" values.
        hold: Region where the background does not learn: the "pixels" above the threshold, as in the paper, or the
            "blobs", so that specks are learned and holes in people are not.
        shadows: True to remove pixels that are darker than the background and have its color.
        heal_every: Number of frames between two searches for ghosts and changed light; 0 for never.
        flood: Share of the image above which the foreground cannot be people. Then no detections are reported, and
            after `flood_frames` such frames the frame becomes the background. 1 for never.
        flood_frames: Number of consecutive frames above `flood` after which the background is replaced.
        blobs: Converts the mask to detections.
        faint_rules: Conditions under which a faint region completes a person.
        healing: Conditions under which a region is a ghost or changed light.

    Raises:
        ValueError: A parameter is out of range.
    """

    threshold: float | str = 30.0
    least_threshold: float = 15.0
    faint: float = 10.0
    learning_rate: float = 0.02
    start: str = "median"
    color: str = "max"
    hold: str = "blobs"
    shadows: bool = False
    heal_every: int = 5
    flood: float = 0.5
    flood_frames: int = 20
    blobs: BlobFinder = field(default_factory=BlobFinder)
    faint_rules: FaintRules = field(default_factory=FaintRules)
    healing: HealingRules = field(default_factory=HealingRules)

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.threshold != "otsu" and not (isinstance(self.threshold, int | float) and 0.0 < self.threshold <= 255.0):
            raise ValueError(
                f'threshold must be above 0 and at most 255 gray levels, or "otsu", got {self.threshold!r}'
            )
        if not 0.0 < self.least_threshold <= 255.0:
            raise ValueError(f"least_threshold must be above 0 and at most 255, got {self.least_threshold!r}")
        if not 0.0 <= self.faint <= 255.0:
            raise ValueError(f"faint must be at least 0, for none, and at most 255 gray levels, got {self.faint!r}")
        if not 0.0 < self.learning_rate < 1.0:
            raise ValueError(f"learning_rate must lie between 0 and 1, got {self.learning_rate!r}")
        for name, kinds in (("start", ("median", "mean")), ("color", ("max", "gray")), ("hold", ("blobs", "pixels"))):
            if getattr(self, name) not in kinds:
                raise ValueError(f"{name} must be one of {', '.join(kinds)}, got {getattr(self, name)!r}")
        if not (isinstance(self.heal_every, int) and self.heal_every >= 0):
            raise ValueError(f"heal_every must be a whole number of frames, 0 for never, got {self.heal_every!r}")
        if not 0.0 < self.flood <= 1.0:
            raise ValueError(f"flood must be a share above 0 and at most 1, got {self.flood!r}")
        if not (isinstance(self.flood_frames, int) and self.flood_frames >= 1):
            raise ValueError(f"flood_frames must be a whole number of at least 1, got {self.flood_frames!r}")

    @classmethod
    def paper(cls) -> MaskedBackground:
        """Create the paper's detector: mean of the first frames, gray, hold at pixels, one opening, no healing.

        The paper does not give threshold, learning rate and smallest blob.
        """
        return cls(
            threshold=25.0,
            faint=0.0,
            start="mean",
            color="gray",
            hold="pixels",
            heal_every=0,
            flood=1.0,
            blobs=BlobFinder(closing=(1, 1), split=False),
        )

    def initial(self, frames: ArrayLike) -> BackgroundState:
        """Compute the first background.

        Args:
            frames: One frame, RGB of shape (H, W, 3) or gray of shape (H, W), uint8; or several, as an array
                (k, H, W, 3) or a sequence: for the median about 40 frames over a minute or more, so that people who
                pass are removed; for the mean, frames without people.

        Raises:
            ValueError: There is no frame, frames differ in shape, or a frame is not a valid image.
        """
        several = checked_images(frames)
        average = np.median if self.start == "median" else np.mean
        whole = several[0] if len(several) == 1 else average(np.stack(several), axis=0)
        first = np.array(whole, dtype=np.float32)
        mask = np.zeros(first.shape[:2], np.uint8)
        return BackgroundState(first, _rounded(first), mask, self.blobs.initial(), 0, 0)

    def step(self, state: BackgroundState, frame: ArrayLike) -> tuple[BackgroundState, Detections]:
        """Detect in a frame, then learn from it.

        Args:
            state: Result of `initial` or of the last `step`.
            frame: Frame with the shape of the first one, uint8.

        Returns:
            State and detections.

        Raises:
            ValueError: The frame is not a valid image, or its shape differs.
        """
        image = checked_image(frame, shape=state.rounded.shape)
        difference = self._difference(image, state.rounded)
        foreground, threshold = self._foreground(difference, image, state.rounded)
        mask = self.blobs.clean(foreground)
        if 0.0 < self.faint < threshold:
            faint_runs, faint_regions = label_runs(self.blobs.clean(_above(difference, self.faint)))
            # The mask may be the foreground itself, which `hold` needs unchanged.
            mask = mask.copy() if mask is foreground else mask
            faint_boxes = measure_runs(faint_runs, faint_regions)[0]
            add_faint_regions(mask, faint_runs, faint_boxes, self.faint_rules)
            runs, regions = label_runs(mask)
            join_by_faint_regions(runs, regions, faint_runs, faint_boxes, self.faint_rules)
        else:
            runs, regions = label_runs(mask)
        held = foreground if self.hold == "pixels" else mask
        background = state.background.copy()
        cv2.accumulateWeighted(image, background, self.learning_rate, mask=cv2.bitwise_not(held))
        frames = state.frames + 1
        flooded = state.flooded + 1 if cv2.countNonZero(mask) > self.flood * mask.size else 0
        if flooded > self.flood_frames:
            background, flooded = image.astype(np.float32), 0
            runs[:, 3] = -1
        elif self.heal_every and frames % self.heal_every == 0 and regions:
            channels = image.reshape(*image.shape[:2], -1)
            heal_regions(channels, background.reshape(channels.shape), runs, regions, threshold, self.healing)
        if flooded:
            runs[:, 3] = -1
        sizes, found = self.blobs.find(state.sizes, runs, regions, image)
        return BackgroundState(background, _rounded(background), mask, sizes, frames, flooded), found

    def _difference(self, image: Image, background: Image) -> Image:
        """Difference of each pixel to the background, gray levels."""
        if self.color == "gray" and image.ndim == 3:
            gray, gray_background = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in (image, background))
            return np.asarray(cv2.absdiff(gray, gray_background), dtype=np.uint8)
        difference = cv2.absdiff(image, background)
        if image.ndim == 3:
            red, green, blue = cv2.split(difference)
            difference = cv2.max(cv2.max(red, green), blue)
        return np.asarray(difference, dtype=np.uint8)

    def _foreground(self, difference: Image, image: Image, background: Image) -> tuple[Image, float]:
        """Mask of the pixels that differ (equation 5), and the threshold."""
        if isinstance(self.threshold, str):
            found, _ = cv2.threshold(difference, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
            threshold = max(found + 1.0, self.least_threshold)
        else:
            threshold = float(self.threshold)
        mask = _above(difference, threshold)
        if self.shadows and image.ndim == 3:
            _drop_shadows(mask, image, background)
        return mask, threshold


def _rounded(background: FloatArray) -> Image:
    return np.asarray(cv2.convertScaleAbs(background), dtype=np.uint8)


def _above(difference: Image, threshold: float) -> Image:
    """Mask of 255 where the difference is at least the threshold; OpenCV tests "greater than" on whole numbers."""
    return np.asarray(cv2.threshold(difference, math.ceil(threshold) - 1, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)


@njit(cache=True, nogil=True)
def _drop_shadows(mask, image, background):  # type: ignore[no-untyped-def]
    """Remove pixels whose channels are all darker by about the same factor, from 0.4 to 0.95."""
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            if mask[row, column] == 0:
                continue
            low, high = 10.0, 0.0
            for channel in range(3):
                ratio = (image[row, column, channel] + 1.0) / (background[row, column, channel] + 1.0)
                low, high = min(low, ratio), max(high, ratio)
            if low > 0.4 and high < 0.95 and high - low < 0.12:
                mask[row, column] = 0
