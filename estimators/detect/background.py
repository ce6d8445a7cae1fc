"""Motion as the difference to a background that learns only where nothing moves (paper 000, section 3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.detect.blobs import BlobFinder
from servotrack.estimators.detect.bodies import BodySizes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.detect.images import Image, checked_image


class BackgroundState(NamedTuple):
    """What the detector remembers.

    Attributes:
        background: Shape of a frame, float32, gray levels.
        rounded: The same, uint8.
        sizes: How tall people are.
        frames: Number of frames seen.
    """

    background: NDArray[np.float32]
    rounded: Image
    sizes: BodySizes
    frames: int


@dataclass(frozen=True)
class MaskedBackground:
    """Background subtraction with an update masked by the foreground.

    Args:
        threshold: Difference from which a pixel is foreground, gray levels, or "otsu".
        learning_rate: Weight of a new frame in the background, per frame.
        start: "mean" or "median" of the frames given to `initial`.
        blobs: From the mask to detections.
    """

    threshold: float | str = 25.0
    learning_rate: float = 0.02
    start: str = "median"
    blobs: BlobFinder = field(default_factory=BlobFinder)

    def initial(self, frames: ArrayLike) -> BackgroundState:
        """The first background: a frame, or the mean or median of several."""
        array = np.asarray(frames)
        if array.ndim == 4:
            array = (
                np.median(array, axis=0).astype(np.uint8) if self.start == "median" else array.mean(0).astype(np.uint8)
            )
        first = checked_image(array)
        return BackgroundState(first.astype(np.float32), first.copy(), self.blobs.initial(), 0)

    def step(self, state: BackgroundState, frame: ArrayLike) -> tuple[BackgroundState, Detections]:
        """Detect in a frame and learn from it."""
        image = checked_image(frame, shape=state.rounded.shape)
        difference = cv2.absdiff(image, state.rounded)
        if image.ndim == 3:
            red, green, blue = cv2.split(difference)
            difference = cv2.max(cv2.max(red, green), blue)
        mask = cv2.threshold(difference, self.threshold - 0.5, 255, cv2.THRESH_BINARY)[1]
        clean = self.blobs.clean(mask)
        background = state.background.copy()
        cv2.accumulateWeighted(image, background, self.learning_rate, mask=cv2.bitwise_not(clean.closed))
        sizes, found = self.blobs.find(state.sizes, clean.closed, image)
        return BackgroundState(background, cv2.convertScaleAbs(background), sizes, state.frames + 1), found
