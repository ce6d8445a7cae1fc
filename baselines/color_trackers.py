"""Trackers of one object by name."""

from __future__ import annotations

from typing import Any

COLOR_TRACKERS = (
    "monte-carlo-color",
    "monte-carlo-color-plus",
    "color-particle-filter",
    "kernel-mean-shift",
    "opencv-meanshift",
    "opencv-camshift",
    "mil",
    "csrt",
    "kcf",
)
"""All names; the last two need OpenCV's contrib wheel."""


def color_tracker(name: str, **parameters: Any) -> Any:
    """A tracker with `initial(frame, box)` and `step(state, frame)`.

    Args:
        name: One of `COLOR_TRACKERS`.
        **parameters: Fields of its class that are not to have their default.

    Raises:
        ValueError: Another name, a bad parameter, or a tracker that the installed OpenCV lacks.
    """
    # Only what is asked for is imported: compiled kernels take a moment.
    if name == "monte-carlo-color":
        from servotrack.estimators.color.monte_carlo import MonteCarloColor

        return MonteCarloColor(**parameters)
    if name == "monte-carlo-color-plus":
        from servotrack.estimators.color.monte_carlo_plus import MonteCarloColorPlus

        return MonteCarloColorPlus(**parameters)
    if name == "color-particle-filter":
        from servotrack.estimators.color.particle_filter import ColorParticleFilter

        return ColorParticleFilter(**parameters)
    if name == "kernel-mean-shift":
        from servotrack.estimators.color.mean_shift import KernelMeanShift

        return KernelMeanShift(**parameters)
    if name in ("opencv-meanshift", "opencv-camshift"):
        from servotrack.estimators.color.back_projection import BackProjection

        return BackProjection(**{"method": name.removeprefix("opencv-"), **parameters})
    if name in ("mil", "csrt", "kcf"):
        from servotrack.estimators.color.opencv_trackers import OpenCVTracker

        return OpenCVTracker(**{"name": name.upper(), **parameters})
    raise ValueError(f"color tracker must be one of {', '.join(COLOR_TRACKERS)}, got {name!r}")
