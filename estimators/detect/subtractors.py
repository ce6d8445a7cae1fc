"""OpenCV's mixture and nearest-neighbor background models (MOG2, KNN) with the interface of `MaskedBackground`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.detect.blobs import BlobFinder, Sizes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.detect.images import checked_image, checked_images
from servotrack.estimators.detect.runs import label_runs
from servotrack.estimators.types import Image

_SHADOW = 127
"""OpenCV's value of a shadow pixel in a mask."""


class BackgroundSubtractor(Protocol):
    """OpenCV's background model, which learns in place."""

    def apply(self, image: Any, /) -> Any:
        """Return the foreground mask of an image, shape (H, W), uint8, and learn from it."""


class OpenCVModel:
    """OpenCV's background model and the number of frames that it has learned from.

    Args:
        subtractor: A new model.
    """

    def __init__(self, subtractor: BackgroundSubtractor) -> None:
        self.subtractor = subtractor
        self.frames = 0


class SubtractorState(NamedTuple):
    """State of a `MOG2Background` or `KNNBackground`.

    Attributes:
        model: OpenCV's model, shared by all states of a sequence: only the last state can be stepped from.
        shape: Shape of the frames.
        mask: Foreground of the last frame after opening and closing, 0 or 255. Shape (H, W), uint8.
        sizes: Heights of people by row.
        frames: Number of frames so far.
    """

    model: OpenCVModel
    shape: tuple[int, ...]
    mask: Image
    sizes: Sizes
    frames: int


class _Subtractor:
    """Base of the detectors with one of OpenCV's models.

    OpenCV draws from a generator of its own, which all models share: `cv2.setRNGSeed(0)` before `initial` makes a run
    repeatable.
    """

    blobs: BlobFinder

    def _create(self) -> BackgroundSubtractor:
        raise NotImplementedError

    def initial(self, frames: ArrayLike) -> SubtractorState:
        """Create a model and let it learn from the given frames.

        Args:
            frames: One frame, RGB of shape (H, W, 3) or gray of shape (H, W), uint8; or several, as an array
                (k, H, W, 3) or a sequence.

        Raises:
            ValueError: There is no frame, frames differ in shape, or a frame is not a valid image.
        """
        several = checked_images(frames)
        model = OpenCVModel(self._create())
        for image in several:
            model.subtractor.apply(image)
        shape = several[0].shape
        return SubtractorState(model, shape, np.zeros(shape[:2], np.uint8), self.blobs.initial(), 0)

    def step(self, state: SubtractorState, frame: ArrayLike) -> tuple[SubtractorState, Detections]:
        """Detect in a frame and learn from it; OpenCV's model learns in place, so the given state becomes invalid.

        Args:
            state: Result of `initial` or of the last `step`.
            frame: Frame with the shape of the first one, uint8.

        Returns:
            State and detections.

        Raises:
            ValueError: The frame is not a valid image, or the state was stepped from before.
        """
        image = checked_image(frame, shape=state.shape)
        model = state.model
        if model.frames != state.frames:
            raise ValueError(
                f"state is of frame {state.frames}, but its OpenCV model has learned up to frame {model.frames}; "
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
        history: Number of frames over which it learns. Raising it adapts more slowly.
        threshold: Squared Mahalanobis distance from which a pixel is foreground. Raising it gives less foreground.
        shadows: True to remove pixels that OpenCV classifies as shadow.
        blobs: Converts the mask to detections.

    Raises:
        ValueError: A parameter is out of range.
    """

    history: int = 500
    threshold: float = 50.0
    shadows: bool = False
    blobs: BlobFinder = field(default_factory=BlobFinder)

    def __post_init__(self) -> None:
        """Check the parameters."""
        _check(self.history, self.threshold)

    def _create(self) -> BackgroundSubtractor:
        return cv2.createBackgroundSubtractorMOG2(self.history, self.threshold, self.shadows)


@dataclass(frozen=True)
class KNNBackground(_Subtractor):
    """Nearest neighbors per pixel (Zivkovic and van der Heijden, 2006), OpenCV's KNN.

    Unlike `MaskedBackground` it also learns under foreground, so that it recovers from changes of light by itself and
    absorbs people who stand still.

    Args:
        history: Number of frames over which it learns. Raising it adapts more slowly.
        threshold: Squared distance from which a pixel does not match a sample, gray levels squared. Raising it gives
            less foreground.
        shadows: True to remove pixels that OpenCV classifies as shadow.
        blobs: Converts the mask to detections.

    Raises:
        ValueError: A parameter is out of range.
    """

    history: int = 500
    threshold: float = 400.0
    shadows: bool = True
    blobs: BlobFinder = field(default_factory=BlobFinder)

    def __post_init__(self) -> None:
        """Check the parameters."""
        _check(self.history, self.threshold)

    def _create(self) -> BackgroundSubtractor:
        return cv2.createBackgroundSubtractorKNN(self.history, self.threshold, self.shadows)


def _check(history: int, threshold: float) -> None:
    if not (isinstance(history, int) and history >= 1):
        raise ValueError(f"history must be a whole number of at least 1 frame, got {history!r}")
    if not 0.0 < threshold < np.inf:
        raise ValueError(f"threshold must be positive and finite, got {threshold!r}")
