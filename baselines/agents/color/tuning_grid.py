"""Values that the search tries for the color trackers, and its number of environment steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

EPISODES = 4
"""Number of tune seeds of each scenario."""
_SCENARIOS, _LEVELS, _FRAMES = 6, 8, 200
_HUES: Mapping[str, Sequence[Any]] = {
    "saturation": (0, 30, 60, 90, 120, 150),
    "bins": (16, 32, 64, 128),
    "darkest": (0, 32, 64, 96),
}
GRIDS: Mapping[str, Mapping[str, Sequence[Any]]] = {
    "monte-carlo-color": {
        "distance_deviation": (0.03, 0.05, 0.08, 0.12, 0.2),
        "update_threshold": (0.8, 0.9, 0.95, 0.98),
        "center_deviation": (4.0, 7.0, 10.0, 14.0),
        "scale_deviation": (0.01, 0.02, 0.04, 0.08),
        "update_rate": (0.01, 0.02, 0.05, 0.1),
    },
    "color-particle-filter": {
        "distance_deviation": (0.02, 0.035, 0.06, 0.1, 0.15),
        "update_threshold": (0.8, 0.9, 0.95, 0.98),
        "center_deviation": (3.0, 5.0, 8.0, 12.0),
        "scale_deviation": (0.01, 0.02, 0.04, 0.08),
        "damping": (0.0, 0.5, 0.8, 1.0),
        "update_rate": (0.01, 0.02, 0.05, 0.1),
    },
    "kernel-mean-shift": {
        "scale_mixing": (0.0, 0.05, 0.1, 0.2, 0.4),
        "scale_step": (0.05, 0.1, 0.2),
        "bins": (4, 8, 16),
    },
    "opencv-meanshift": _HUES,
    "opencv-camshift": _HUES,
    "monte-carlo-color-plus": {
        "loyalty": (0.5, 0.7, 0.85, 1.0),
        "gradient_share": (0.45, 0.6, 0.7),
        "color_share": (0.1, 0.2, 0.3),
        "scale_deviation": (0.03, 0.05, 0.08),
        "sharpness": (30.0, 60.0, 120.0),
        "center_deviation": (0.16, 0.22, 0.3),
        "hidden_below": (0.45, 0.55, 0.65),
        "update_rate": (0.03, 0.06, 0.1),
    },
}
"""Values tried, by tracker and parameter. Samples and cells are budgets of time and are not searched.

A threshold of 1 would disable eq. (12) of the paper.
"""
ROBUST_GRIDS: Mapping[str, Mapping[str, Sequence[Any]]] = {
    "monte-carlo-color-plus": {"scale_deviation": (0.05, 0.08, 0.11), "angle_deviation": (0.07, 0.1, 0.15)},
}
"""Values tried afterward on all levels, the paper's scenarios and two more, and chosen by the worst level."""


def tuning_steps(name: str) -> int:
    """Return the environment steps of one round of the searches: every value on every film; 0 without a grid."""
    films = _SCENARIOS * sum(map(len, GRIDS.get(name, {}).values()))
    films += _LEVELS * sum(map(len, ROBUST_GRIDS.get(name, {}).values()))
    return EPISODES * films * _FRAMES
