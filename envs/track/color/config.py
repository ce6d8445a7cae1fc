"""Parameters of the color tracking environment, and the levels that set them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from servotrack.envs.arguments import check_fields, check_keywords, check_level

PAPER_SCENARIOS = ("irregular", "occlusion", "distractor", "scale", "light", "pan_zoom")
"""Scenarios of Zhang and Li 2008 (figure 4 and text)."""
LEVEL_NAMES = (*PAPER_SCENARIOS, "rotation", "growth")
"""Names of the levels, in their order."""


@dataclass(frozen=True)
class ColorConfig:
    """Parameters of a color tracking environment. The value 0 turns a difficulty off; for factors it is 1.

    Attributes:
        horizon: Number of answered frames of an episode.
        width: Width of the frame, px.
        height: Height of the frame, px.
        frame_rate: Frames per second.
        head_height: Height of the head at zoom 1, without long hair, px.
        speed: Maximum speed of the head, px per frame.
        restlessness: Mean number of velocity changes of the head per second.
        turning: Amplitude of the yaw of the head, 0 (always frontal) to 1 (face nearly invisible).
        tilt: Standard deviation of the head's roll, rad.
        spin: Standard deviation of the angular velocity with which the whole figure turns over, rad/s.
        growth: Maximum factor by which the head comes closer or moves away, within some tenths of a second. Camera and
            room stay.
        occlusions: Number of times that an object occludes the head.
        occlusion_frames: Approximate duration of an occlusion, frames.
        distractors: Number of people near the target who look like it.
        similarity: Similarity of distractors to the target, 0 (random appearance) to 1 (same head).
        zoom: Maximum factor by which the camera zooms in or out.
        pan: Standard deviation of the camera's pan, px of the scene.
        light_change: Maximum factor by which the light gets brighter or darker.
        light_tint: Maximum ratio of red to blue light, and of blue to red.
        camouflage: Share of the objects in the background that have the colors of the target, 0 to 1.
        sensor_noise: Standard deviation of the pixel noise, gray levels.
    """

    horizon: int = 200
    width: int = 300
    height: int = 245
    frame_rate: float = 25.0
    head_height: float = 48.0
    speed: float = 2.5
    restlessness: float = 1.0
    turning: float = 0.5
    tilt: float = 0.08
    spin: float = 0.0
    growth: float = 1.0
    occlusions: int = 0
    occlusion_frames: float = 6.0
    distractors: int = 0
    similarity: float = 0.8
    zoom: float = 1.0
    pan: float = 0.0
    light_change: float = 1.0
    light_tint: float = 1.0
    camouflage: float = 0.15
    sensor_noise: float = 3.0

    def __post_init__(self) -> None:
        """Check every field. A ValueError names the argument, its value and the valid values."""
        check_fields(self, _BOUNDS, _WHOLE)
        tallest = min(_MAX_HEIGHT_SHARE * self.height, _MAX_WIDTH_SHARE * self.width)
        largest = self.head_height * self.zoom * self.growth
        if largest > tallest:
            raise ValueError(
                f"head_height * zoom * growth must be at most {_MAX_HEIGHT_SHARE:g} of the frame's height and "
                f"{_MAX_WIDTH_SHARE:g} of its width = {tallest:g} px, got {largest:g}; the head must fit into the frame"
            )


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("horizon", 1, 100_000),
    ("width", 96, 1920),
    ("height", 96, 1920),
    ("frame_rate", 1.0, 1000.0),
    ("head_height", 12.0, 400.0),
    ("speed", 0.0, 50.0),
    ("restlessness", 0.0, 25.0),
    ("turning", 0.0, 1.0),
    ("tilt", 0.0, 0.5),
    ("spin", 0.0, 20.0),
    ("growth", 1.0, 2.5),
    ("occlusions", 0, 50),
    ("occlusion_frames", 0.0, 100.0),
    ("distractors", 0, 8),
    ("similarity", 0.0, 1.0),
    ("zoom", 1.0, 2.5),
    ("pan", 0.0, 100.0),
    ("light_change", 1.0, 4.0),
    ("light_tint", 1.0, 2.0),
    ("camouflage", 0.0, 1.0),
    ("sensor_noise", 0.0, 30.0),
)
_WHOLE = frozenset({"horizon", "width", "height", "occlusions", "distractors"})
_MAX_HEIGHT_SHARE = 0.5
"""Maximum height of a head, as a share of the frame height."""
_MAX_WIDTH_SHARE = 0.75
"""Maximum height of a head, as a share of the frame width. With its hair a head is slightly wider than high."""

_LEVELS: tuple[dict[str, Any], ...] = (
    {"speed": 8.0, "restlessness": 3.0, "turning": 0.8, "tilt": 0.15},
    {"occlusions": 3},
    {"distractors": 1},
    {"zoom": 1.8},
    {"light_change": 1.9, "light_tint": 1.25},
    {"zoom": 1.5, "pan": 45.0, "speed": 4.0},
    {"spin": 2.5},
    {"growth": 1.8},
)
AXES = tuple(f.name for f in fields(ColorConfig))


def color_config(level: int = 0, scenario: str | None = None, **axes: Any) -> ColorConfig:
    """Return the configuration of a level, with some parameters overridden.

    Args:
        level: 0 `irregular`, 1 `occlusion`, 2 `distractor`, 3 `scale`, 4 `light`, 5 `pan_zoom`,
            6 `rotation`, 7 `growth`.
        scenario: Name of a level, instead of `level`.
        **axes: Fields of `ColorConfig` with the values to use.

    Raises:
        ValueError: If the level or scenario does not exist or a value is outside its bounds.
        TypeError: If a keyword is unknown; the message suggests the nearest known one.
    """
    check_keywords(axes, AXES, ("normalized_actions", "render_mode"))
    return replace(ColorConfig(), **{**_LEVELS[color_level(level, scenario)], **axes})


def color_level(level: int = 0, scenario: str | None = None) -> int:
    """Return the number of a level that is given by number or by name.

    Raises:
        ValueError: If the level or scenario does not exist.
    """
    if scenario is not None:
        if scenario not in LEVEL_NAMES:
            raise ValueError(f"scenario must be one of {', '.join(LEVEL_NAMES)}, got {scenario!r}")
        return LEVEL_NAMES.index(scenario)
    return check_level(level, len(_LEVELS))
