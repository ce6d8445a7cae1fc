"""Kinematics of serial arms: tables of three real ones, and arms from tables of one's own."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servotrack.envs.servo3d.kinematics import ArmTables
from servotrack.estimators.elementary import sum_in_order
from servotrack.estimators.types import Array


@dataclass(frozen=True, eq=False)
class SerialArm:
    """Revolute joints in series, described by the lines of their axes at zero joint angles.

    The tool's z axis points away from the last link. The product of exponentials of the joints' screws times `tool` is
    the pose of the tool (Lynch and Park, Modern Robotics, 2017, section 4.1).

    Attributes:
        name: Name in results and pictures.
        axes: Direction of each joint's axis in the base frame, unit vectors. Shape (n, 3).
        points: A point of each axis in the base frame, m. Shape (n, 3).
        tool: Pose of the tool in the base frame. Shape (4, 4), m.
        low: Lower joint limits, rad. Shape (n,).
        high: Upper joint limits, rad. Shape (n,).
        masses: Mass of the link behind each joint, kg. Shape (n,). Each is taken in the middle between its joint and
            the next one; gravity pulls along -z of the base.
        ready: Joint angles of a usual working posture, rad. Shape (n,).
        source: Origin of the numbers.

    Raises:
        ValueError: A field of the wrong shape, not finite, an axis of length 0, or limits that exclude `ready`.
    """

    name: str
    axes: Array
    points: Array
    tool: Array
    low: Array
    high: Array
    masses: Array
    ready: Array
    source: str = ""

    def __post_init__(self) -> None:
        n = np.size(self.ready)
        shapes = {"axes": (n, 3), "points": (n, 3), "tool": (4, 4)} | {
            name: (n,) for name in ("low", "high", "masses", "ready")
        }
        for name, shape in shapes.items():
            try:
                value = np.array(getattr(self, name), np.float64)
            except (TypeError, ValueError) as error:
                raise ValueError(f"arm: {name} must be numbers of shape {shape}: {error}") from error
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"arm: {name} must be finite numbers of shape {shape}, got shape {value.shape}")
            object.__setattr__(self, name, value)
        if n < 2:
            raise ValueError(f"arm: ready must hold the angles of at least 2 joints, got {n}")
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"arm: name must be a text, got {self.name!r}")
        rotation = self.tool[:3, :3]
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0.0
        if not (rigid and np.array_equal(self.tool[3], (0.0, 0.0, 0.0, 1.0))):
            raise ValueError(
                f"arm: tool must be a pose (a rotation, a position, and 0 0 0 1), got {self.tool.tolist()}"
            )
        lengths = np.linalg.norm(self.axes, axis=1)
        if not (lengths > 1e-9).all():
            raise ValueError(f"arm: axes must be vectors of length > 0, got {self.axes.tolist()}")
        object.__setattr__(self, "axes", self.axes / lengths[:, None])
        outside = ~((self.low < self.high) & (self.low <= self.ready) & (self.ready <= self.high))
        if outside.any():
            j = int(np.flatnonzero(outside)[0])
            raise ValueError(
                f"arm: ready must lie within the joint limits; joint {j} has {self.ready[j]:g} and limits "
                f"{self.low[j]:g} to {self.high[j]:g}"
            )
        if not (self.masses >= 0.0).all():
            raise ValueError(f"arm: masses must be >= 0, got {self.masses.tolist()}")
        if not self.reach > 1e-3:
            raise ValueError(f"arm: points and tool must span more than 1 mm, got a chain of {self.reach:g} m")
        for name in shapes:
            getattr(self, name).setflags(write=False)

    @property
    def joints(self) -> int:
        """Number of joints n."""
        return len(self.ready)

    @functools.cached_property
    def reach(self) -> float:
        """Length of the chain from the second joint to the tool, m: the scale of cameras and targets."""
        points = [*self.points[1:], self.tool[:3, 3]]
        return sum_in_order([math.dist(a, b) for a, b in itertools.pairwise(points)])

    def tables(self, margin: float = 0.0) -> ArmTables:
        """Return the arm for the compiled kernels.

        Args:
            margin: Distance that is kept to the joint limits, rad.
        """
        return ArmTables(self.axes, self.points, self.tool, self.low + margin, self.high - margin, self.masses)

    @classmethod
    def from_transforms(cls, name: str, transforms: Sequence[ArrayLike], tool: ArrayLike, **fields: Any) -> SerialArm:
        """Return an arm from the fixed transforms between its joints, each of which turns about its own z axis.

        Args:
            name: Name of the arm.
            transforms: Pose of each joint's frame in the previous one (the base for the first). Shape (n, 4, 4), m.
            tool: Pose of the tool in the last joint's frame. Shape (4, 4), m.
            **fields: The other fields of `SerialArm`.
        """
        pose, axes, points = np.eye(4), [], []
        for step in transforms:
            pose = pose @ np.asarray(step, np.float64)
            axes.append(pose[:3, 2])
            points.append(pose[:3, 3])
        return cls(name, np.array(axes), np.array(points), pose @ np.asarray(tool, np.float64), **fields)


def _translated(x: float, y: float, z: float) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def _turned(axis: int, angle: float) -> Array:
    pose, c, s = np.eye(4), math.cos(angle), math.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    pose[j, j], pose[k, k], pose[j, k], pose[k, j] = c, c, -s, s
    return pose


def _frame(xyz: tuple[float, float, float], rpy: tuple[float, float, float]) -> Array:
    """Return the pose of URDF's fixed angles: roll about x, pitch about y, yaw about z."""
    roll, pitch, yaw = rpy
    return _translated(*xyz) @ _turned(2, yaw) @ _turned(1, pitch) @ _turned(0, roll)


_RIGHT = math.pi / 2.0


def _ur5e() -> SerialArm:
    # Standard Denavit-Hartenberg parameters: the joint turns before the link's transform.
    links = (
        (0.0, 0.1625, _RIGHT),
        (-0.425, 0.0, 0.0),
        (-0.3922, 0.0, 0.0),
        (0.0, 0.1333, _RIGHT),
        (0.0, 0.0997, -_RIGHT),
        (0.0, 0.0996, 0.0),
    )
    steps = [_translated(a, 0.0, d) @ _turned(0, alpha) for a, d, alpha in links]
    return SerialArm.from_transforms(
        "ur5e",
        [np.eye(4), *steps[:-1]],
        steps[-1],
        low=np.full(6, -2.0 * math.pi),
        high=np.full(6, 2.0 * math.pi),
        masses=(3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
        ready=(0.0, -_RIGHT, _RIGHT, -_RIGHT, -_RIGHT, 0.0),
        source="Universal Robots, DH parameters for calculations of kinematics and dynamics",
    )


def _panda() -> SerialArm:
    # Modified Denavit-Hartenberg parameters (Craig): the link's transform comes before the joint.
    links = (
        (0.0, 0.333, 0.0),
        (0.0, 0.0, -_RIGHT),
        (0.0, 0.316, _RIGHT),
        (0.0825, 0.0, _RIGHT),
        (-0.0825, 0.384, -_RIGHT),
        (0.0, 0.0, _RIGHT),
        (0.088, 0.0, _RIGHT),
    )
    return SerialArm.from_transforms(
        "panda",
        [_turned(0, alpha) @ _translated(a, 0.0, d) for a, d, alpha in links],
        _translated(0.0, 0.0, 0.107),
        low=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
        high=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
        masses=(4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522),
        ready=(0.0, -math.pi / 4.0, 0.0, -3.0 * math.pi / 4.0, 0.0, _RIGHT, math.pi / 4.0),
        source="Franka Emika, FCI documentation (kinematics, limits); masses of Gaz et al. 2019",
    )


def _so101() -> SerialArm:
    frames = (
        ((0.0388353, 0.0, 0.0624), (math.pi, 0.0, -math.pi)),
        ((-0.0303992, -0.0182778, -0.0542), (-_RIGHT, -_RIGHT, 0.0)),
        ((-0.11257, -0.028, 0.0), (0.0, 0.0, _RIGHT)),
        ((-0.1349, 0.0052, 0.0), (0.0, 0.0, -_RIGHT)),
        ((0.0, -0.0611, 0.0181), (_RIGHT, 0.0486795, math.pi)),
    )
    return SerialArm.from_transforms(
        "so101",
        [_frame(*frame) for frame in frames],
        # The gripper points along -z of the last joint's frame.
        _translated(-0.0079, -0.000218121, -0.0981274) @ _turned(0, math.pi),
        low=(-1.91986, -1.74533, -1.69, -1.65806, -2.74385),
        high=(1.91986, 1.74533, 1.69, 1.65806, 2.84121),
        masses=(0.1, 0.103, 0.104, 0.079, 0.099),
        ready=(0.0, -0.6, 0.6, 1.2, 0.0),
        source="TheRobotStudio, SO-ARM100 repository, Simulation/SO101/so101_new_calib.urdf",
    )


ARMS: Mapping[str, SerialArm] = {arm.name: arm for arm in (_ur5e(), _panda(), _so101())}
"""Arms by name: Universal Robots UR5e, Franka Emika Panda and the SO-101 of TheRobotStudio (without its gripper)."""


def arm_of(arm: str | SerialArm | Mapping[str, Any]) -> SerialArm:
    """Return an arm by name, by its fields, or as it is.

    Args:
        arm: A name of `ARMS`, a `SerialArm`, or a mapping of its fields (lists of numbers).

    Raises:
        ValueError: An unknown name, or fields that are missing, unknown or invalid.
    """
    if isinstance(arm, SerialArm):
        return arm
    if isinstance(arm, str):
        if arm not in ARMS:
            raise ValueError(f"arm must be one of {', '.join(ARMS)}, a SerialArm, or its fields, got {arm!r}")
        return ARMS[arm]
    try:
        return SerialArm(**arm)
    except TypeError as error:
        raise ValueError(
            f"arm: fields must be those of SerialArm ({', '.join(SerialArm.__dataclass_fields__)}): {error}"
        ) from error
