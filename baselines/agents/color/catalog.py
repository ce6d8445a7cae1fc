"""Trackers of one colored object by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from servotrack.estimators.color import BoxEstimate


class ColorTracker(Protocol):
    """Contract of a tracker of one object; unlike an `Estimator` it starts from a frame and a box."""

    def initial(self, frame: ArrayLike, box: ArrayLike) -> Any:
        """Return the state after the first frame, shape (H, W, 3), with the object's box, shape (4,), px."""

    def step(self, state: Any, frame: ArrayLike) -> tuple[Any, BoxEstimate]:
        """Return the state and the estimate after one more frame."""


COLOR_TRACKERS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "monte-carlo-color": ("MonteCarloColor", {}),
    "monte-carlo-color-plus": ("MonteCarloColorPlus", {}),
    "color-particle-filter": ("ColorParticleFilter", {}),
    "kernel-mean-shift": ("KernelMeanShift", {}),
    "opencv-meanshift": ("BackProjection", {"method": "meanshift", "saturation": 30}),
    "opencv-camshift": ("BackProjection", {"method": "camshift", "saturation": 90, "bins": 128, "darkest": 0}),
    "mil": ("OpenCVTracker", {"name": "MIL"}),
    "csrt": ("OpenCVTracker", {"name": "CSRT"}),
    "kcf": ("OpenCVTracker", {"name": "KCF"}),
}
"""Class in `servotrack.estimators.color`, and parameters that the search on tune seeds changed from its defaults.

The last two need OpenCV's contrib wheel.
"""


def color_tracker(tracker: str, **parameters: Any) -> ColorTracker:
    """Create a tracker of one object.

    Args:
        tracker: A name of `COLOR_TRACKERS`.
        **parameters: Fields of its class that differ from the defaults.

    Raises:
        ValueError: An unknown name, an invalid parameter, or a tracker that the installed OpenCV lacks.
    """
    if tracker not in COLOR_TRACKERS:
        raise ValueError(f"color tracker must be one of {', '.join(COLOR_TRACKERS)}, got {tracker!r}")
    from servotrack.estimators import color

    name, fixed = COLOR_TRACKERS[tracker]
    return getattr(color, name)(**{**fixed, **parameters})
