"""OpenCV's mixture and nearest-neighbor background models (MOG2, KNN) behind the same interface and the same blobs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.detect.blobs import BlobFinder
from servotrack.estimators.detect.bodies import BodySizes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.detect.images import checked_image, checked_images
from servotrack.estimators.detect.runs import label_runs
from servotrack.estimators.types import Image

_SHADOW = 127  # OpenCV's value of a shadow in a mask


class OpenCVModel:
    """OpenCV's background model, which learns in place, and the number of frames that it was stepped through."""

    def __init__(self, subtractor: Any) -> None:
        """Hold a model that was not stepped yet."""
        self.subtractor = subtractor
        self.frames = 0


class SubtractorState(NamedTuple):
    """What such a detector remembers.

    Attributes:
        model: Shared by all states of a sequence: only the last one can be stepped from.
        shape: Of the frames.
        mask: The last frame's foreground after opening and closing, 0 or 255. Shape (H, W), uint8.
        sizes: How tall people are at each row.
        frames: Number of frames seen.
    """

    model: OpenCVModel
    shape: tuple[int, ...]
    mask: Image
    sizes: BodySizes
    frames: int


class _Subtractor:
    """What both have in common."""

    blobs: BlobFinder

    def _create(self) -> Any:
        raise NotImplementedError

    def initial(self, frames: ArrayLike) -> SubtractorState:
        """A new model that has seen the given frames.

        Args:
            frames: One frame, RGB of shape (H, W, 3) or gray of shape (H, W), uint8; or several, as an array
                (k, H, W, 3) or a sequence.

        Raises:
            ValueError: No frame, frames of unlike shapes, or not such images.
        """
        several = checked_images(frames)
        model = OpenCVModel(self._create())
        for image in several:
            model.subtractor.apply(image)
        shape = several[0].shape
        return SubtractorState(model, shape, np.zeros(shape[:2], np.uint8), self.blobs.initial(), 0)

    def step(self, state: SubtractorState, frame: ArrayLike) -> tuple[SubtractorState, Detections]:
        """Detect in a frame and learn from it; the state before is used up, since OpenCV's model learns in place.

        Args:
            state: From `initial` or the step before.
            frame: Of the first frame's shape, uint8.

        Returns:
            State and detections.

        Raises:
            ValueError: Not such an image, or a state that was stepped from before.
        """
        image = checked_image(frame, shape=state.shape)
        model = state.model
        if model.frames != state.frames:
            raise ValueError(
                f"state is of frame {state.frames}, but its OpenCV model has gone on to frame {model.frames}; "
                "step from the last state, or start again with initial(frame)"
            )
        mask = model.subtractor.apply(image)
        model.frames += 1
        _, mask = cv2.threshold(mask, _SHADOW, 255, cv2.THRESH_BINARY)
        cleaned = self.blobs.clean(mask)
        runs, regions = label_runs(cleaned)
        sizes, found = self.blobs.find(state.sizes, runs, regions, image)
        return SubtractorState(model, state.shape, cleaned, sizes, model.frames), found


@dataclass(frozen=True)
class MOG2Background(_Subtractor):
    """Mixture of Gaussians per pixel (Zivkovic, 2004), OpenCV's MOG2.

    Unlike `MaskedBackground` it also learns under foreground, so that it recovers from changes of light by itself and
    absorbs people who stand still.

    Args:
        history: Frames over which it learns.
        threshold: Squared Mahalanobis distance from which a pixel does not fit the background.
        shadows: Whether to take away what OpenCV holds for shadows.
        blobs: From the mask to detections.

    Raises:
        ValueError: A parameter out of range.
    """

    history: int = 500
    threshold: float = 50.0
    shadows: bool = False
    blobs: BlobFinder = field(default_factory=BlobFinder)

    def __post_init__(self) -> None:
        """Check the parameters."""
        _check(self.history, self.threshold)

    def _create(self) -> Any:
        return cv2.createBackgroundSubtractorMOG2(self.history, self.threshold, self.shadows)


@dataclass(frozen=True)
class KNNBackground(_Subtractor):
    """Nearest neighbors per pixel (Zivkovic and van der Heijden, 2006), OpenCV's KNN.

    Unlike `MaskedBackground` it also learns under foreground, so that it recovers from changes of light by itself and
    absorbs people who stand still.

    Args:
        history: Frames over which it learns.
        threshold: Squared distance, gray levels, from which a pixel does not fit a sample.
        shadows: Whether to take away what OpenCV holds for shadows.
        blobs: From the mask to detections.

    Raises:
        ValueError: A parameter out of range.
    """

    history: int = 500
    threshold: float = 400.0
    shadows: bool = True
    blobs: BlobFinder = field(default_factory=BlobFinder)

    def __post_init__(self) -> None:
        """Check the parameters."""
        _check(self.history, self.threshold)

    def _create(self) -> Any:
        return cv2.createBackgroundSubtractorKNN(self.history, self.threshold, self.shadows)


def _check(history: int, threshold: float) -> None:
    if not (isinstance(history, int) and history >= 1):
        raise ValueError(f"history must be a whole number of at least 1 frame, got {history!r}")
    if not 0.0 < threshold < np.inf:
        raise ValueError(f"threshold must be positive and finite, got {threshold!r}")
