"""Parameters of the world of serial arms, and its levels of difficulty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from servotrack.envs.arguments import Range, as_range, check_fields
from servotrack.envs.servo.levels import rung
from servotrack.envs.servo3d.arms import SerialArm, arm_of

CAMERAS = ("hand", "world")


@dataclass(frozen=True)
class Servo3DConfig:
    """Parameters of a world of serial arms. A range (low, high) is drawn uniformly, anew for every episode.

    Lengths of the scene scale with the arm's reach, so that the same level suits a toy arm and an industrial one.

    Raises:
        ValueError: A value outside its bounds; the message has the field, its value and the bounds.

    Attributes:
        arm: Name of `servotrack.envs.servo3d.arms.ARMS`, a `SerialArm`, or a mapping of its fields.
        camera: `hand`: on the tool, looking at a board in the world. `world`: fixed, looking at a board on the tool.
        points: Number of points of the board: 1, or a grid of at least 4.
        board: Side of the board, as a share of the reach.
        focal: Focal length, px.
        width: Width of the image, px.
        height: Height of the image, px.
        principal_offset: Largest offset of the principal point from the image's center along each axis, px.
        depth: Distance of the camera from the board at the goal, as a share of the reach.
        mounting: Largest rotation of the camera about its optical axis, either way, rad.
        mounting_tilt: Largest tilt of the camera (`hand`: against the tool; `world`: against the line to the board),
            rad.
        mounting_offset: Largest offset of the camera in the hand from the tool's axis, as a share of the reach.
        board_tilt: Largest tilt of the board against the optical axis at the goal, rad.
        shift: Largest offset of the board's middle between start and goal, along each image axis, as a share of the
            distance.
        lean: Largest tilt of the board between start and goal, rad.
        turn: Range of the turn about the optical axis between start and goal, to either side, rad.
        zoom: Range of the ratio of the larger to the smaller distance of start and goal.
        in_view: Least and largest number of points in the image at the start; None for all of them.
        singular: True starts at the most singular of several drawn postures.
        motion: Amplitude of the goal's motion, of each joint, rad; 0 for a goal at rest.
        motion_period: Period of this motion, s.
        pixel_noise: Standard deviation of the noise on features, px.
        dropout: Probability that a frame is lost.
        hiding: Mean time between two occlusions of single points, s; 0 for none. Two points always stay visible.
        hiding_time: Duration of an occlusion, s.
        encoder_steps: Steps of the encoders in a full turn; 0 for exact ones.
        homing: Largest constant error of each joint angle, rad.
        actuator_lag: Time constant of the joint rates, s.
        backlash: Play of each joint, rad.
        sag: Deflection of a joint under the largest gravity torque on the stretched arm, rad.
        latency: Age of frames at arrival, whole control periods.
        encoder_age: Age of joint angles at arrival, whole control periods.
        stamped: False stamps frames and joint angles with their arrival instead of their origin.
        max_joint_rate: Limit of each joint rate, rad/s.
        max_joint_acceleration: Limit of each joint's acceleration, rad/s^2.
        horizon: Length of an episode, steps of 50 ms.
    """

    arm: str | SerialArm | Mapping[str, Any] = "so101"
    camera: str = "hand"
    points: int = 4
    board: float = 0.2
    focal: Range = (600.0, 600.0)
    width: int = 640
    height: int = 480
    principal_offset: float = 0.0
    depth: Range = (0.4, 0.5)
    mounting: float = 0.0
    mounting_tilt: float = 0.0
    mounting_offset: float = 0.0
    board_tilt: float = 0.0
    shift: float = 0.15
    lean: float = 0.1
    turn: Range = (0.0, 0.2)
    zoom: Range = (1.0, 1.2)
    in_view: Range | None = None
    singular: bool = False
    motion: float = 0.0
    motion_period: Range = (6.0, 12.0)
    pixel_noise: float = 0.0
    dropout: float = 0.0
    hiding: float = 0.0
    hiding_time: Range = (1.0, 3.0)
    encoder_steps: int = 0
    homing: float = 0.0
    actuator_lag: Range = (0.0, 0.0)
    backlash: float = 0.0
    sag: float = 0.0
    latency: Range = (0, 0)
    encoder_age: Range = (0, 0)
    stamped: bool = True
    max_joint_rate: float = 1.0
    max_joint_acceleration: float = 10.0
    horizon: int = 800

    def __post_init__(self) -> None:
        """Check all fields; raises a ValueError with the field, its value and the valid values."""
        arm_of(self.arm)
        if self.camera not in CAMERAS:
            raise ValueError(f"camera must be one of {', '.join(CAMERAS)}, got {self.camera!r}")
        for name, low, high in _RANGES:
            if name == "in_view" and self.in_view is None:
                continue
            ends = as_range(name, getattr(self, name))
            if not low <= ends[0] <= ends[1] <= high:
                raise ValueError(f"{name} must lie in [{low:g}, {high:g}], got {getattr(self, name)!r}")
            object.__setattr__(self, name, ends)
        check_fields(self, _BOUNDS, _WHOLE)
        for name in ("latency", "encoder_age", "in_view"):
            if any(int(end) != end for end in getattr(self, name) or ()):
                raise ValueError(f"{name} must be whole numbers, got {getattr(self, name)!r}")
        if self.points != 1 and self.points < 4:
            raise ValueError(f"points must be 1 or at least 4 (fewer leave the goal's pose open), got {self.points!r}")
        if self.in_view is not None and self.in_view[1] > self.points:
            raise ValueError(f"in_view must be at most points = {self.points}, got {self.in_view!r}")
        for name in ("singular", "stamped"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")


_RANGES: tuple[tuple[str, float, float], ...] = (
    ("focal", 50.0, 5000.0),
    ("depth", 0.1, 5.0),
    ("turn", 0.0, math.pi),
    ("zoom", 1.0, 3.0),
    ("in_view", 1, 100),
    ("motion_period", 0.5, 1000.0),
    ("hiding_time", 0.05, 1000.0),
    ("actuator_lag", 0.0, 2.0),
    ("latency", 0, 4),
    ("encoder_age", 0, 4),
)
_WHOLE = ("points", "width", "height", "encoder_steps", "horizon")
_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("points", 1, 100),
    ("board", 0.01, 2.0),
    ("width", 32, 8192),
    ("height", 32, 8192),
    ("principal_offset", 0.0, 1000.0),
    ("mounting", 0.0, math.pi),
    ("mounting_tilt", 0.0, 1.0),
    ("mounting_offset", 0.0, 0.5),
    ("board_tilt", 0.0, 1.2),
    ("shift", 0.0, 2.0),
    ("lean", 0.0, 1.0),
    ("motion", 0.0, 1.0),
    ("pixel_noise", 0.0, 50.0),
    ("dropout", 0.0, 0.95),
    ("hiding", 0.0, 1000.0),
    ("encoder_steps", 0, 10_000_000),
    ("homing", 0.0, 0.5),
    ("backlash", 0.0, 0.2),
    ("sag", 0.0, 0.2),
    ("max_joint_rate", 0.01, 20.0),
    ("max_joint_acceleration", 0.1, 1000.0),
    ("horizon", 1, 100_000),
)

_LADDER: tuple[dict[str, Any], ...] = (
    {},
    {
        "pixel_noise": 0.5,
        "mounting": math.pi,
        "mounting_tilt": math.radians(15),
        "mounting_offset": 0.1,
        "board_tilt": math.radians(30),
        "principal_offset": 30.0,
        "focal": (450.0, 800.0),
        "shift": 0.25,
        "lean": 0.2,
        "turn": (0.0, 0.5),
        "zoom": (1.0, 1.3),
    },
    {"encoder_steps": 4096, "homing": math.radians(3), "actuator_lag": (0.05, 0.15)},
    {"backlash": math.radians(1), "sag": math.radians(1), "latency": (1, 1), "encoder_age": (0, 2)},
    {"in_view": (2, 3), "hiding": 4.0, "shift": 0.6},
    {
        "in_view": None,
        "turn": (1.5, 3.0),
        "zoom": (1.25, 2.0),
        "shift": 0.2,
        "singular": True,
        # Arms of five joints turn the board about the tool's axis only: the camera must look along it.
        "mounting_tilt": math.radians(5),
    },
    {"motion": 0.015, "latency": (0, 2), "stamped": False, "dropout": 0.05},
)

LEVEL_NAMES = ("plain", "noise", "hobby", "play", "hidden", "turns", "everything")
AXES = tuple(f.name for f in fields(Servo3DConfig))


def servo3d_config(level: int = 2, **axes: Any) -> Servo3DConfig:
    """Return the configuration of a level, with single fields overridden.

    Args:
        level: 0 `plain`, 1 `noise`, 2 `hobby`, 3 `play`, 4 `hidden`, 5 `turns`, 6 `everything`. Each adds to the levels
            before it, except that all points are in view again from level 5 on.
        **axes: Fields of `Servo3DConfig`. A single number for a range means a constant value.

    Raises:
        ValueError: A level outside 0 to 6, or a value outside its bounds.
        TypeError: An unknown axis; the message suggests the nearest known one.
    """
    return Servo3DConfig(**rung(_LADDER, level, axes, AXES, ("render_mode",)))
