"""Recorder of one row of a `Servo3DWorld` for its pictures: trails and errors so far."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.servo3d.kinematics import axes_now, compose
from servotrack.envs.servo3d.levels import LEVEL_NAMES, Servo3DConfig
from servotrack.envs.servo3d.render import ArmScene, draw
from servotrack.envs.servo3d.world import Servo3DWorld
from servotrack.estimators.types import Array, Image


class Recorder:
    """Records an episode for its pictures. Call `record` after every reset and step; `frame` draws the current state.

    Args:
        world: World to draw; it is not changed.
        row: Row of the arm.
        caption: Text in the picture: lower-case letters, digits and spaces.
    """

    def __init__(self, world: Servo3DWorld, row: int = 0, caption: str = "") -> None:
        self._world, self._row, self._caption = world, row, caption
        length, n, p = world.config.horizon + 1, world.arm.joints, world.config.points
        self._errors, self._features = np.zeros((length, 2)), np.zeros((length, 2 * p))
        self._tips = np.zeros((length, 3))
        self._lines = np.zeros((n, 6))
        self._first = 0
        self._center, self._extent = np.zeros(3), 1.0

    def record(self) -> None:
        """Store the world's newest sample. The first sample of an episode clears the old trails."""
        world, row = self._world, self._row
        step = int(world.steps[row])
        self._first = step if step == 0 else min(self._first, step)
        sample = world.sample
        self._errors[step] = 1e3 * sample.tip_error[row], math.degrees(sample.tip_angle[row])
        self._features[step] = sample.features[row]
        self._tips[step] = world.state.tool[row, :, 3]
        if step == self._first:
            self._fit()

    def frame(self) -> Image:
        """Draw the current state.

        Returns:
            A new RGB image, shape (540, 960, 3), uint8.
        """
        world, row = self._world, self._row
        tables, sample = world.tables, world.sample
        skeleton, eye, marks = self._scene(world.state.joints)
        past = slice(self._first, int(world.steps[row]) + 1)
        return draw(
            ArmScene(
                skeleton=skeleton,
                tool=world.state.tool[row].copy(),
                goal=world.state.goal_tool[row].copy(),
                eye=eye,
                marks=marks,
                optics=tables.optics[row],
                reach=world.arm.reach,
                center=self._center,
                extent=self._extent,
                features=sample.features[row].reshape(-1, 2),
                wanted=sample.goal[row].reshape(-1, 2),
                visible=sample.visible[row] > 0.5,
                feature_trail=self._features[past].reshape(-1, world.config.points, 2),
                tip_trail=self._tips[past],
                errors=self._errors[past],
                time=float(sample.time[row]),
                caption=self._caption,
            )
        )

    def _scene(self, joints: Array) -> tuple[Array, Array, Array]:
        """Return skeleton, pose of the camera and points of the board at joint angles of all rows."""
        world, row = self._world, self._row
        tables, chain, tool = world.tables, np.zeros((3, 4)), np.zeros((3, 4))
        arm = world.arm
        axes_now(arm.axes, arm.points, arm.tool, joints, row, chain, self._lines, tool)
        eye, placed = np.zeros((3, 4)), np.zeros((3, 4))
        if world.config.camera == "hand":
            compose(tool, tables.mount[row], eye)
            marks = world.state.target[row].copy()
        else:
            eye[:] = tables.mount[row]
            compose(tool, tables.board[row], placed)
            marks = tables.marks[row] @ placed[:, :3].T + placed[:, 3]
        return np.vstack([np.zeros(3), self._lines[:, 3:], tool[:, 3]]), eye, marks

    def _fit(self) -> None:
        """Choose the part of space that shows arm, board and camera at the start and at the goal."""
        state = self._world.state
        shown = []
        for joints in (state.joints, state.goal_joints):
            skeleton, eye, marks = self._scene(joints)
            shown += [skeleton, eye[:, 3][None], marks]
        points = np.vstack(shown)
        self._center = (points.min(axis=0) + points.max(axis=0)) / 2.0
        self._extent = 1.05 * float(np.linalg.norm(points - self._center, axis=1).max())


def level_caption(config: Servo3DConfig, level: int) -> str:
    """Arm, place of the camera, number and name of the level: the caption of pictures."""
    name = config.arm if isinstance(config.arm, str) else "arm"
    return f"{name}  camera in {'hand' if config.camera == 'hand' else 'world'}  level {level} {LEVEL_NAMES[level]}"
