"""Ranges beyond those of a level, to test an agent outside the episodes that it was trained or tuned on."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from servotrack.envs.servo.levels import ServoConfig

_CENTERED = ("mounting", "principal_offset", "tilt", "aspect", "actuation_gain", "knock", "zoom")
"""Largest deviations from a center, either way."""
_RATES = ("pixel_noise", "outlier_rate", "outlier_size", "dropout", "occlusion")
"""Sizes and rates of what is random at every frame."""
_WHOLE = ("latency", "encoder_age")
_IDLE_WITHOUT = {"outlier_size": "outlier_rate", "occlusion_length": "occlusion", "zoom_period": "zoom"}
"""Quantities that have no effect where another one is 0."""
_CROWD_RATES = ("look_alikes", "clutter", "misses", "color_noise")
_LARGEST = {"mounting": math.pi, "tilt": 0.6, "aspect": 0.5, "actuation_gain": 0.5, "dropout": 0.95, "distortion": 0.33,
            "pace": 2.0, "zoom": 1.0, "look_alikes": 1.0, "misses": 0.95, "outlier_rate": 1.0,
            "latency": 4.0}  # fmt: skip


def widened_axes(config: ServoConfig, share: float = 0.25) -> dict[str, Any]:
    """Return keywords of an environment whose random quantities reach beyond the ranges of a configuration.

    A range (low, high) grows at both ends by `share` of its width, but never across zero. A largest deviation, a noise
    level or a rate grows by `share` of its value. A latency grows outwards to whole control periods. Quantities that
    are constant stay so, and the target's motion keeps its ranges. No stream changes: with share 0 every episode is the
    same to the bit.

    Args:
        config: Configuration of a level, from `servo_config`, `reach_config` or `follow_config`.
        share: Share by which ranges grow, 0 to 1. Larger values are farther from what an agent was trained on.

    Raises:
        ValueError: A share outside 0 to 1.
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share must lie in [0, 1], got {share}; 0.25 widens every range by a quarter")
    axes: dict[str, Any] = {}
    for name in (field.name for field in fields(config)):
        if name in _IDLE_WITHOUT and getattr(config, _IDLE_WITHOUT[name]) == 0.0:
            continue
        value, largest = getattr(config, name), _LARGEST.get(name, math.inf)
        if isinstance(value, tuple):
            low, high = value
            extra = share * (high - low)
            if extra == 0.0:
                continue
            if name in _WHOLE:
                extra = math.ceil(extra)
            # A distortion may be negative, all other ranges are of positive quantities.
            least = -largest if low < 0.0 else 0.0
            axes[name] = (max(low - extra, least), min(high + extra, largest))
        elif name in (*_CENTERED, *_RATES, *_CROWD_RATES) and value > 0.0:
            axes[name] = min((1.0 + share) * value, largest)
    return {name: wide for name, wide in axes.items() if wide != getattr(config, name)}
