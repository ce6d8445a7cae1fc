"""Parameters of PedestrianServo, and its levels of difficulty."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from servotrack.envs.arguments import Range, as_range, check_fields
from servotrack.envs.servo.levels import ServoConfig, refuse_changing_camera, rung

SCRIPTS = ("plaza", "crossings")
"""Behavior of the other people: stroll and sometimes cross the person's path, or always cross it."""
MOST_PEOPLE = 16
"""Largest number of people."""


@dataclass(frozen=True)
class FollowConfig(ServoConfig):
    """Parameters of the servo at four times its scale, and of the crowd. A range is drawn anew for every episode.

    The servo's outliers and kinds of noise act only on the features of `observation="identity"`.

    Attributes:
        target: Always `person`.
        people: Number of people, including the one to follow.
        script: `plaza` (people stroll between places and sometimes cross the person's path) or `crossings` (the others
            cross it all the time).
        companions: Number of people who walk together with the person to follow.
        pace: Preferred walking speed, m/s.
        look_alikes: Probability that another person wears the same clothes as the person to follow.
        clutter: Expected false detections per frame.
        misses: Probability that a person in view is not detected in a frame.
        merge_distance: People closer to each other than this give one common detection, m. 0: never.
        color_noise: Standard deviation of the noise on each channel of a detection's color, gray levels.
        lamps: Number of lampshades, which occlude the people under them.
        umbrellas: Number of other people with an umbrella. An umbrella occludes other people under it; its carrier is
            detected in the umbrella's color.
        shadows: Darkness of shadows in images, 0 to 1.
    """

    TARGETS: ClassVar[tuple[str, ...]] = ("person",)

    target: str = "person"
    links: Range = (2.0, 2.0)
    focal: Range = (320.0, 320.0)
    depth: Range = (4.0, 4.0)
    # Moments of inertia grow with the square of the links' lengths.
    max_motor_torque: float = 960.0
    warmup: int = 0
    horizon: int = 400
    people: int = 6
    script: str = "plaza"
    companions: int = 0
    pace: Range = (0.5, 1.5)
    look_alikes: float = 0.0
    clutter: float = 0.0
    misses: float = 0.0
    merge_distance: float = 0.0
    color_noise: float = 0.0
    lamps: int = 0
    umbrellas: int = 0
    shadows: float = 0.5

    def __post_init__(self) -> None:
        """Check all fields; raises a ValueError with the argument, its value and the valid values."""
        super().__post_init__()
        refuse_changing_camera(self)
        object.__setattr__(self, "pace", as_range("pace", self.pace))
        if not 0.1 <= self.pace[0] <= self.pace[1] <= 2.0:
            raise ValueError(f"pace must lie in [0.1, 2] m/s, got {self.pace!r}")
        if self.script not in SCRIPTS:
            raise ValueError(f"script must be one of {', '.join(SCRIPTS)}, got {self.script!r}")
        check_fields(self, _BOUNDS, ("people", "companions", "lamps", "umbrellas"))
        for name in ("companions", "umbrellas"):
            if getattr(self, name) > self.people - 1:
                raise ValueError(
                    f"{name} must be at most people - 1 = {self.people - 1}, got {getattr(self, name)}; raise `people`"
                )


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("people", 1, MOST_PEOPLE),
    ("companions", 0, MOST_PEOPLE),
    ("look_alikes", 0.0, 1.0),
    ("clutter", 0.0, 50.0),
    ("misses", 0.0, 0.95),
    ("merge_distance", 0.0, 2.0),
    ("color_noise", 0.0, 100.0),
    ("lamps", 0, 20),
    ("umbrellas", 0, MOST_PEOPLE),
    ("shadows", 0.0, 1.0),
)

_LADDER: tuple[dict[str, Any], ...] = (
    {},
    {"pixel_noise": 2.0, "color_noise": 8.0, "clutter": 1.0, "misses": 0.05, "merge_distance": 0.4},
    {
        "links": (1.6, 2.4),
        "focal": (260.0, 400.0),
        "depth": (3.2, 5.0),
        "mounting": math.radians(30),
        "pixel_noise": 3.0,
    },
    {
        "mounting": math.pi,
        "principal_offset": 40.0,
        "distortion": (-0.25, 0.1),
        "tilt": math.radians(15),
        "aspect": 0.1,
        "look_alikes": 0.2,
    },
    {
        "actuation_noise": (0.03, 0.05),
        "actuation_gain": 0.1,
        "encoder_noise": (0.0005, 0.003),
        "dropout": 0.05,
        "misses": 0.1,
        "lamps": 3,
        "umbrellas": 1,
    },
    {"latency": (1, 1), "rolling_shutter": 0.020, "companions": 1, "clutter": 2.0},
    {
        "people": 12,
        "look_alikes": 0.5,
        "dropout": 0.10,
        "misses": 0.15,
        "clutter": 4.0,
        "umbrellas": 2,
        "outlier_rate": 0.05,
        "latency": (0, 2),
        "stamped": False,
    },
)

LEVEL_NAMES = ("plain", "noise", "geometry", "optics", "dynamics", "timing", "heavy")
AXES = tuple(f.name for f in fields(FollowConfig))


def follow_config(level: int = 2, **axes: Any) -> FollowConfig:
    """Return the configuration of a level, with single fields overridden.

    Args:
        level: 0 `plain`, 1 `noise`, 2 `geometry`, 3 `optics`, 4 `dynamics`, 5 `timing`, 6 `heavy`. Each adds to the
            levels before it.
        **axes: Fields of `FollowConfig`. A single number for a range means a constant value.

    Raises:
        ValueError: A level outside 0 to 6, or a value outside its bounds.
        TypeError: An unknown axis; the message suggests the nearest known one.
    """
    return FollowConfig(**rung(_LADDER, level, axes, AXES, ("observation", "image_size", "image_noise", "render_mode")))
