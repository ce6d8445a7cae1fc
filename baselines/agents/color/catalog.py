"""Trackers of one object by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
"""Class in `servotrack.estimators.color`, and parameters where the search on tune seeds found others than its defaults.

The last two need OpenCV's contrib wheel.
"""


def color_tracker(tracker: str, **parameters: Any) -> Any:
    """A tracker with `initial(frame, box)` and `step(state, frame)`.

    Args:
        tracker: A name of `COLOR_TRACKERS`.
        **parameters: Fields of its class that are not to have their default.

    Raises:
        ValueError: Another name, a bad parameter, or a tracker that the installed OpenCV lacks.
    """
    if tracker not in COLOR_TRACKERS:
        raise ValueError(f"color tracker must be one of {', '.join(COLOR_TRACKERS)}, got {tracker!r}")
    from servotrack.estimators import color

    name, fixed = COLOR_TRACKERS[tracker]
    return getattr(color, name)(**{**fixed, **parameters})
