"""Every parameter of the color world, and the levels that set them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from servotrack.envs.arguments import check_fields, check_keywords, check_level

LEVEL_NAMES = ("irregular", "occlusion", "distractor", "scale", "light", "pan_zoom")
"""The scenarios of paper 001's figure 4 and of its text, in the order of the levels."""


@dataclass(frozen=True)
class ColorConfig:
    """All that defines a color world. An axis at 0 is off.

    Attributes:
        horizon: Frames of an episode that are answered.
        width: Of the frame, px.
        height: Of the frame, px.
        frame_rate: Frames per second.
        head_height: Height of the head before any zoom, without hair that hangs down, px.
        speed: Largest speed that the head takes up, px per frame.
        restlessness: Mean number of times a second that the head takes up another velocity.
        turning: How far the head turns to the sides, 0 (never) to 1 (the face nearly gone).
        tilt: Standard deviation of the head's roll, rad.
        occlusions: How often something passes before the head.
        occlusion_frames: About how many frames the head is then out of sight.
        distractors: People beside the target who look like it.
        similarity: How much distractors look like the target, 0 (as strangers do) to 1 (alike).
        zoom: Largest factor by which the camera zooms in or out.
        pan: Standard deviation of the camera's pan, px of the scene.
        light_change: Largest factor by which the light gets brighter or darker.
        light_tint: Largest factor between the red and the blue light.
        camouflage: Share of the backdrop that is painted in the target's own colors, 0 to 1.
        sensor_noise: Standard deviation of a pixel's noise, gray levels.
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
        """Check every field; raises ValueError that names the argument, the value and what would be right."""
        check_fields(self, _BOUNDS, _WHOLE)
        tallest = min(_ROOM * self.height, _BREADTH * self.width)
        if self.head_height * self.zoom > tallest:
            raise ValueError(
                f"head_height * zoom must be at most {_ROOM:g} of the frame's height and {_BREADTH:g} of its width = "
                f"{tallest:g} px, got {self.head_height * self.zoom:g}; the head has to stay inside"
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
_ROOM = 0.5
"""Largest share of the frame's height that a head may take."""
_BREADTH = 0.75
"""Largest height of a head, which with all its hair is a little wider than high, as a share of the frame's width."""

_LEVELS: tuple[dict[str, Any], ...] = (
    {"speed": 8.0, "restlessness": 3.0, "turning": 0.8, "tilt": 0.15},
    {"occlusions": 3},
    {"distractors": 1},
    {"zoom": 1.8},
    {"light_change": 1.9, "light_tint": 1.25},
    {"zoom": 1.5, "pan": 45.0, "speed": 4.0},
)
AXES = tuple(f.name for f in fields(ColorConfig))


def color_config(level: int = 0, scenario: str | None = None, **axes: Any) -> ColorConfig:
    """The configuration of a level, with single parameters overridden.

    Args:
        level: 0 `irregular`, 1 `occlusion`, 2 `distractor`, 3 `scale`, 4 `light`, 5 `pan_zoom`.
        scenario: One of these names, instead of a level.
        **axes: Fields of `ColorConfig`.

    Raises:
        ValueError: A level or scenario that does not exist, or a value outside its bounds.
        TypeError: An unknown keyword; the message suggests the nearest known one.
    """
    check_keywords(axes, AXES)
    return replace(ColorConfig(), **{**_LEVELS[color_level(level, scenario)], **axes})


def color_level(level: int = 0, scenario: str | None = None) -> int:
    """The number of a level that is given by number or by name.

    Raises:
        ValueError: A level or scenario that does not exist.
    """
    if scenario is not None:
        if scenario not in LEVEL_NAMES:
            raise ValueError(f"scenario must be one of {', '.join(LEVEL_NAMES)}, got {scenario!r}")
        return LEVEL_NAMES.index(scenario)
    return check_level(level, len(_LEVELS))
