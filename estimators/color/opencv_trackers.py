"""OpenCV's trackers of one object with the interface of the other trackers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.color.contract import BoxEstimate, checked_frame, start
from servotrack.estimators.color.histogram import pixel_edges
from servotrack.estimators.types import Array

Name = Literal["MIL", "CSRT", "KCF"]


class Tracker(Protocol):
    """OpenCV's tracker object, which every call changes."""

    def init(self, image: Any, window: Any, /) -> Any:
        """Start with a BGR image and a window (left, top, width, height), px."""

    def update(self, image: Any, /) -> Any:
        """Return a success flag and the window in the next BGR image."""


class OpenCVState(NamedTuple):
    """Memory of an `OpenCVTracker`; it is mutable, so an old state cannot be stepped from again.

    Attributes:
        tracker: OpenCV's object, changed by every step.
        box: The last box, shape (4,), px.
        shape: Height and width of the frames.
    """

    tracker: Tracker
    box: Array
    shape: tuple[int, int]


@dataclass(frozen=True)
class OpenCVTracker:
    """MIL, CSRT or KCF as OpenCV implements them.

    MIL (Babenko, Yang and Belongie, "Robust object tracking with online multiple instance learning", IEEE TPAMI 33(8),
    2011) is in the main wheel; CSRT and KCF only in `opencv-contrib-python-headless`. A state serves one sequence: its
    object changes with every step, and an old state cannot be stepped from again. MIL draws random numbers from the
    clock, so two runs differ.

    Attributes:
        name: `MIL`, `CSRT` or `KCF`.
        smallest_side: Smallest width and height of the visible part of the first box, px, at least 5. With less, OpenCV
            does not return.

    Raises:
        ValueError: The name is unknown, `smallest_side` is below 5, or the installed OpenCV lacks the tracker.
    """

    name: Name = "MIL"
    smallest_side: int = 5

    def __post_init__(self) -> None:
        """Check that the installed OpenCV has the tracker."""
        if self.name not in get_args(Name):
            raise ValueError(f"name must be one of {', '.join(get_args(Name))}, got {self.name!r}")
        if not self.smallest_side >= 5:
            raise ValueError(f"smallest_side must be at least 5 px, got {self.smallest_side!r}")
        if self._maker() is None:
            raise ValueError(
                f"name must be a tracker of the installed OpenCV {cv2.__version__}, which lacks {self.name}; install "
                "opencv-contrib-python-headless in place of opencv-python-headless, or choose MIL"
            )

    def _maker(self) -> Callable[[], Tracker] | None:
        for place in (cv2, getattr(cv2, "legacy", None)):
            maker = getattr(place, f"Tracker{self.name}_create", None)
            if maker is not None:
                return maker
        return None

    def initial(self, frame: ArrayLike, box: ArrayLike) -> OpenCVState:
        """Start a tracker; arguments as in `MonteCarloColor.initial`.

        Raises:
            ValueError: The frame or the box is invalid, or OpenCV's tracker finds no pixels to learn from.
        """
        image, first, pose = start(frame, box)
        left, top, right, bottom = pixel_edges(first[None], image.shape)[0].tolist()
        if min(right - left, bottom - top) < self.smallest_side:
            # In a smaller window MIL searches for random features for ever.
            raise ValueError(
                f"box must show at least {self.smallest_side} x {self.smallest_side} px inside the frame for "
                f"{self.name}, got {right - left} x {bottom - top} px of {first.tolist()} in a frame of "
                f"{image.shape[1]} x {image.shape[0]} px; choose a larger box, or another tracker"
            )
        maker = self._maker()
        assert maker is not None, "the constructor checks it"
        tracker = maker()
        try:
            tracker.init(_bgr(image), (left, top, right - left, bottom - top))
        except cv2.error as error:
            raise ValueError(
                f"box must leave {self.name} pixels inside and around it to learn from, got {first.tolist()} in a "
                f"frame of {image.shape[1]} x {image.shape[0]} px; choose a smaller or larger box, or another tracker"
            ) from error
        return OpenCVState(tracker, first, pose.shape)

    def step(self, state: OpenCVState, frame: ArrayLike) -> tuple[OpenCVState, BoxEstimate]:
        """Update the tracker with the next frame; arguments and errors as in `MonteCarloColor.step`."""
        image = checked_frame(frame, state.shape)
        try:
            found, window = state.tracker.update(_bgr(image))
        except cv2.error:
            # OpenCV raises if no candidate is left, such as at the frame's corner; then the last box is kept.
            found, window = False, None
        box = np.array(window, dtype=np.float64) if found else state.box
        return state._replace(box=box), BoxEstimate(box.copy(), float(bool(found)))


def _bgr(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(image[..., ::-1])
