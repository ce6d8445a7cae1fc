"""OpenCV's meanShift and CamShift on the back-projection of a hue histogram."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.color.contract import BoxEstimate, check_count, checked_frame, start
from servotrack.estimators.color.histogram import pixel_edges
from servotrack.estimators.types import FloatArray, Image

Window = tuple[int, int, int, int]
Method = Literal["meanshift", "camshift"]


class BackProjectionState(NamedTuple):
    """Memory of a `BackProjection`.

    Attributes:
        window: Left, top, width and height, whole px, inside the frame.
        histogram: Histogram of the object's hue, scaled to a largest bin of 255. Shape (bins, 1), float32.
        shape: Height and width of the frames.
    """

    window: Window
    histogram: FloatArray
    shape: tuple[int, int]


@dataclass(frozen=True)
class BackProjection:
    """Finds the densest window of pixels with the object's hue.

    Source: Bradski, "Computer vision face tracking for use in a perceptual user interface", Intel Technology Journal,
    1998, in OpenCV's implementation. Unlike in `KernelMeanShift`, each pixel has a weight by its own hue.

    Attributes:
        method: `meanshift` keeps the window's size, `camshift` adapts it.
        bins: Number of bins of the hue.
        saturation: Pixels of less saturation have weight 0, 0 to 255. Raising it ignores grayish pixels.
        darkest: Pixels of less value have weight 0, 0 to 255. Raising it ignores darker pixels.
        iterations: Largest number of iterations per frame.
    """

    method: Method = "meanshift"
    bins: int = 32
    saturation: int = 0
    darkest: int = 64
    iterations: int = 10

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}, got {self.method!r}")
        check_count(bins=self.bins, iterations=self.iterations)
        for name in ("saturation", "darkest"):
            if not 0 <= getattr(self, name) <= 255:
                raise ValueError(f"{name} must lie in [0, 255], got {getattr(self, name)!r}")

    def initial(self, frame: ArrayLike, box: ArrayLike) -> BackProjectionState:
        """Compute the object's hue histogram; arguments and errors as in `MonteCarloColor.initial`."""
        image, first, pose = start(frame, box)
        left, top, right, bottom = pixel_edges(first[None], image.shape)[0].tolist()
        hsv = np.asarray(cv2.cvtColor(image[top:bottom, left:right], cv2.COLOR_RGB2HSV), np.uint8)
        histogram = cv2.calcHist([hsv], [0], self._votes(hsv), [self.bins], [0, 180])
        if not histogram.any():
            # For an object without color all pixels count; gray pixels have hue 0.
            histogram = cv2.calcHist([hsv], [0], None, [self.bins], [0, 180])
        scaled = (histogram * (255.0 / histogram.max())).astype(np.float32)
        return BackProjectionState((left, top, right - left, bottom - top), scaled, pose.shape)

    def step(self, state: BackProjectionState, frame: ArrayLike) -> tuple[BackProjectionState, BoxEstimate]:
        """Search from the last window; arguments and errors as in `MonteCarloColor.step`."""
        image = checked_frame(frame, state.shape)
        hsv = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2HSV), np.uint8)
        likely = cv2.calcBackProject([hsv], [0], state.histogram, [0, 180], 1.0)
        likely = np.asarray(cv2.bitwise_and(likely, self._votes(hsv)), np.uint8)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, self.iterations, 1.0)
        if self.method == "meanshift":
            _, window = cv2.meanShift(likely, state.window, criteria)
        else:
            _, window = cv2.CamShift(likely, state.window, criteria)
        left, top, width, height = (int(value) for value in window)
        if width < 2 or height < 2:
            # CamShift's window vanishes if all pixels have weight 0; then the last window is kept.
            left, top, width, height = state.window
        votes = likely[max(top, 0) : top + height, max(left, 0) : left + width]
        similarity = float(votes.mean()) / 255.0 if votes.size else 0.0
        box = np.array([left, top, width, height], dtype=np.float64)
        return state._replace(window=(left, top, width, height)), BoxEstimate(box, similarity)

    def _votes(self, hsv: Image) -> Image:
        mask = cv2.inRange(hsv, (0, self.saturation, self.darkest), (180, 255, 255))
        return np.asarray(mask, np.uint8)
