"""Parameters of the servo world, and its levels of difficulty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from servotrack.envs.arguments import Range, as_range, check_keywords, check_level, is_number

TARGETS = ("paper", "paper_point", "point", "ellipse", "two_sine", "waypoints")
NOISE_KINDS = ("gaussian", "uniform", "laplace", "quantized")


@dataclass(frozen=True)
class ServoConfig:
    """Parameters of a servo world. A range (low, high) is drawn uniformly, anew for every episode.

    Attributes:
        target: Motion of the target: `paper` (Zhang 2011, eq. 32, scaled with the arm), `paper_point` (its section
            3.2, at rest), `point` (at rest anywhere in reach), `ellipse`, `two_sine` (two sines along each axis),
            `waypoints` (straight runs between random points).
        links: Length of each link, drawn separately, m.
        focal: Focal length over pixel pitch, px.
        depth: Height of the camera over the plane, m.
        mounting: Largest rotation of the camera about its axis, either way, rad.
        principal_offset: Largest offset of the principal point from the image's center along each axis, px.
        distortion: Radial distortion k1, at one half width from the principal point.
        tilt: Largest tilt of the optical axis about each image axis, rad.
        aspect: Largest relative difference between vertical and horizontal focal length.
        pixel_noise: Standard deviation of the noise on features, px.
        noise_kind: Distribution of this noise: `gaussian`, `uniform`, `laplace`, or `quantized` (gaussian, then rounded
            to whole pixels).
        outlier_rate: Probability that a frame's features are outliers.
        outlier_size: Standard deviation of an outlier along each axis, px.
        dropout: Probability that a frame is lost.
        latency: Age of a frame when it arrives, whole control periods, (lowest, highest).
        stamped: True: `frame_time` is the time when the frame was taken. False: the time of its arrival.
        rolling_shutter: Time from the first to the last image row, s.
        actuation_noise: Standard deviation of the noise on joint rates, rad/s.
        actuation_gain: Largest relative error of each joint's rate, constant during an episode.
        encoder_noise: Standard deviation of the noise on observed joint angles, rad.
        encoder_age: Age of the observed joint angles, whole control periods, (lowest, highest). They have no stamp.
        actuator_lag: Time constant with which the joints follow a new rate, s.
        backlash: Play of each joint's gear: angle that a motor turns after a reversal before its joint moves, rad.
        occlusion: Expected number of occlusions of the target that begin in a second of free view, 1/s.
        occlusion_length: Duration of an occlusion, s. The target moves on while it is hidden.
        knock: Largest rotation of the camera about its axis, either way, at an instant in the middle half of the
            episode, as if something had struck it, rad.
        zoom: Largest relative change of the focal length during the episode, in and out in turn, from the drawn one.
            The image grows about the goal, which stays where it is. Raising it makes Jacobians outdated sooner.
        zoom_period: Time in which the lens zooms in, out and back, s.
        warmup: Unscored steps before time 0, with the target at rest.
        horizon: Scored steps of an episode.
        max_joint_rate: Joint rate at action 1, rad/s.
        max_motor_torque: Torque limit of the joint motors, N m. Values of 2 to 10 make the arm sluggish.
        substeps: Physics steps per control period.
        solver_iterations: Iterations of the constraint solver per physics step.
        camera_size: Width and height of the camera's image, px.
    """

    TARGETS: ClassVar[tuple[str, ...]] = TARGETS

    target: str = "paper"
    links: Range = (0.5, 0.5)
    focal: Range = (160.0, 160.0)
    depth: Range = (0.35, 0.35)
    mounting: float = 0.0
    principal_offset: float = 0.0
    distortion: Range = (0.0, 0.0)
    tilt: float = 0.0
    aspect: float = 0.0
    pixel_noise: float = 0.0
    noise_kind: str = "gaussian"
    outlier_rate: float = 0.0
    outlier_size: float = 30.0
    dropout: float = 0.0
    latency: Range = (0, 0)
    stamped: bool = True
    rolling_shutter: float = 0.0
    actuation_noise: Range = (0.0, 0.0)
    actuation_gain: float = 0.0
    encoder_noise: Range = (0.0, 0.0)
    encoder_age: Range = (0, 0)
    actuator_lag: float = 0.0
    backlash: float = 0.0
    occlusion: float = 0.0
    occlusion_length: Range = (0.2, 0.5)
    knock: float = 0.0
    zoom: float = 0.0
    zoom_period: Range = (3.0, 8.0)
    warmup: int = 8
    horizon: int = 252
    max_joint_rate: float = 2.0
    max_motor_torque: float = 60.0
    substeps: int = 5
    solver_iterations: int = 20
    camera_size: int = 480

    def __post_init__(self) -> None:
        """Check all fields; raises a ValueError with the argument, its value and the valid values."""
        for name in _RANGES:
            object.__setattr__(self, name, as_range(name, getattr(self, name)))
        for name, options in (("target", self.TARGETS), ("noise_kind", NOISE_KINDS)):
            if getattr(self, name) not in options:
                raise ValueError(f"{name} must be one of {', '.join(options)}, got {getattr(self, name)!r}")
        for name, low, high in _BOUNDS:
            value = getattr(self, name)
            if name not in _RANGES and not is_number(value):
                raise ValueError(f"{name} must be one number in [{low}, {high}], got {value!r}")
            if not all(low <= end <= high for end in (value if name in _RANGES else (value,))):
                raise ValueError(f"{name} must lie in [{low}, {high}], got {value!r}")
            if name in _WHOLE:
                if int(value) != value:
                    raise ValueError(f"{name} must be a whole number, got {value!r}")
                object.__setattr__(self, name, int(value))
            elif name not in _RANGES:
                object.__setattr__(self, name, float(value))
        for name in ("latency", "encoder_age"):
            if any(int(end) != end for end in getattr(self, name)):
                raise ValueError(f"{name} must be a whole number of control periods, got {getattr(self, name)!r}")
        if self.outlier_rate > 0 and self.outlier_size == 0:
            raise ValueError("outlier_rate > 0 contradicts outlier_size = 0; give outlier_size in px")
        if not isinstance(self.stamped, bool):
            raise ValueError(f"stamped must be True or False, got {self.stamped!r}")
        if not self.stamped and self.latency == (0, 0):
            raise ValueError("stamped=False with latency 0 hides nothing; give latency=(low, high) or stamped=True")


_RANGES = (
    "links", "focal", "depth", "distortion", "actuation_noise", "encoder_noise", "latency", "encoder_age",
    "occlusion_length", "zoom_period",
)  # fmt: skip
_WHOLE = ("warmup", "horizon", "substeps", "solver_iterations", "camera_size")
_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("links", 0.1, 4.0),
    ("focal", 10.0, 2000.0),
    ("depth", 0.05, 20.0),
    ("mounting", 0.0, math.pi),
    ("principal_offset", 0.0, 200.0),
    ("distortion", -0.33, 0.33),
    ("tilt", 0.0, 0.6),
    ("aspect", 0.0, 0.5),
    ("pixel_noise", 0.0, 50.0),
    ("outlier_rate", 0.0, 1.0),
    ("outlier_size", 0.0, 500.0),
    ("dropout", 0.0, 0.95),
    ("latency", 0, 4),
    ("rolling_shutter", 0.0, 0.05),
    ("actuation_noise", 0.0, 1.0),
    ("actuation_gain", 0.0, 0.5),
    ("encoder_noise", 0.0, 0.1),
    ("encoder_age", 0, 4),
    ("actuator_lag", 0.0, 0.5),
    ("backlash", 0.0, 0.1),
    ("occlusion", 0.0, 2.0),
    ("occlusion_length", 0.05, 5.0),
    ("knock", 0.0, math.pi),
    ("zoom", 0.0, 1.0),
    ("zoom_period", 0.5, 100.0),
    ("warmup", 0, 1000),
    ("horizon", 1, 100_000),
    ("max_joint_rate", 0.1, 20.0),
    ("max_motor_torque", 0.1, 1000.0),
    ("substeps", 1, 50),
    ("solver_iterations", 1, 100),
    ("camera_size", 32, 4096),
)

_LADDER: tuple[dict[str, Any], ...] = (
    {},
    {"pixel_noise": 0.5, "target": "ellipse"},
    {
        "links": (0.35, 0.65),
        "focal": (120.0, 240.0),
        "depth": (0.25, 0.60),
        "mounting": math.radians(30),
        "pixel_noise": 1.0,
        "warmup": 0,
    },
    {
        "mounting": math.pi,
        "principal_offset": 40.0,
        "distortion": (-0.25, 0.1),
        "tilt": math.radians(15),
        "aspect": 0.1,
    },
    {
        "target": "two_sine",
        "actuation_noise": (0.03, 0.05),
        "actuation_gain": 0.1,
        "encoder_noise": (0.0005, 0.003),
        "dropout": 0.05,
    },
    {"latency": (1, 1), "rolling_shutter": 0.020},
    {
        "target": "waypoints",
        "outlier_rate": 0.05,
        "outlier_size": 30.0,
        "dropout": 0.10,
        "latency": (0, 2),
        "stamped": False,
    },
)

LEVEL_NAMES = ("paper", "noise", "geometry", "optics", "dynamics", "timing", "heavy")
AXES = tuple(f.name for f in fields(ServoConfig))


def servo_config(level: int = 3, **axes: Any) -> ServoConfig:
    """Return the configuration of a level, with single fields overridden.

    Args:
        level: 0 `paper`, 1 `noise`, 2 `geometry`, 3 `optics`, 4 `dynamics`, 5 `timing`, 6 `heavy`. Each adds to the
            levels before it.
        **axes: Fields of `ServoConfig`. A single number for a range means a constant value.

    Raises:
        ValueError: A level outside 0 to 6, or a value outside its bounds.
        TypeError: An unknown axis; the message suggests the nearest known one.
    """
    return ServoConfig(**rung(_LADDER, level, axes, AXES, ("render_mode",)))


def refuse_changing_camera(config: ServoConfig) -> None:
    """Raise a ValueError for a camera that changes in a world with images, whose rays are traced once per episode."""
    for name in ("knock", "zoom"):
        if value := getattr(config, name):
            raise ValueError(f"{name} must be 0 where images or people are rendered, got {value}; use UncalibServo-v0")


def rung(
    ladder: Sequence[Mapping[str, Any]],
    level: int,
    axes: Mapping[str, Any],
    known: Sequence[str],
    beside: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the settings of a level, with single axes overridden. Each level adds to the levels before it.

    Args:
        ladder: Settings that each level adds.
        level: Number of the level, from 0.
        axes: Keywords that override the level's values.
        known: Valid names of axes.
        beside: Further keywords of the environment, besides `level`.

    Raises:
        ValueError: An unknown level.
        TypeError: An unknown axis; the message suggests the nearest known one.
    """
    level = check_level(level, len(ladder))
    check_keywords(axes, known, ("level", *beside))
    settings: dict[str, Any] = {}
    for step in ladder[: level + 1]:
        settings.update(step)
    return {**settings, **axes}


def reach_config(level: int = 3, **axes: Any) -> ServoConfig:
    """Return the configuration of the positioning task: `servo_config` with a target at rest and a horizon of 5 s.

    Level 0 has the paper's point (0.6, 0.6) m (Zhang 2011, section 3.2). Higher levels draw a point within reach.
    """
    target = "paper_point" if level == 0 else "point"
    return servo_config(level, **({"target": target, "horizon": 100} | axes))
