"""Recorder of one row of a `ServoWorld` for its pictures: trails and errors so far."""

from __future__ import annotations

import numpy as np

from servotrack.envs.servo.episode import samples
from servotrack.envs.servo.footprint import camera_footprint, floor_lines
from servotrack.envs.servo.levels import LEVEL_NAMES
from servotrack.envs.servo.render import ServoScene, draw
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import Array, Image


class Recorder:
    """Records an episode for its pictures. Call `record` after every reset and step; `frame` draws the current state.

    Args:
        world: World to draw; it is not changed.
        row: Row of the arm.
        caption: Text in the picture: lower-case letters, digits and spaces.
    """

    def __init__(self, world: ServoWorld, row: int = 0, caption: str = "") -> None:
        self._world = world
        self._row = row
        self._caption = caption
        length = samples(world.config) - LEAD
        self._tool, self._features = np.zeros((length, 2)), np.zeros((length, 2))
        self._error = np.zeros(length)
        self._first = 0

    def record(self) -> None:
        """Store the world's newest sample. The first sample of an episode clears the old trails."""
        world, row = self._world, self._row
        step = int(world.steps[row])
        self._first = step if step == 0 else min(self._first, step)
        self._tool[step], self._features[step] = world.tool[row], world.features[row]
        self._error[step] = world.tracking_error[row]

    def frame(self, camera_image: Image | None = None, distractor: Array | None = None) -> Image:
        """Draw the current state.

        Args:
            camera_image: Newest camera image, RGB, square. None: the grid of the floor is drawn instead.
            distractor: Position of the distractor, if there is one, (2,) m.

        Returns:
            A new RGB image, shape (416, 720, 3), uint8.
        """
        world, row = self._world, self._row
        size = world.config.camera_size
        view = (world.present_cameras()[row], world.links[row], world.joints[row], size)
        past = slice(self._first, int(world.steps[row]) + 1)
        return draw(
            ServoScene(
                links=world.links[row],
                joint_angles=world.joints[row],
                target=world.target[row, :2],
                feature=world.features[row],
                goal=world.goal[row],
                camera_size=size,
                visible=bool(world.visible[row]),
                tracking_error=float(world.tracking_error[row]),
                time=float(world.time[row]),
                tool_trail=self._tool[past],
                target_trail=world.paths[row, LEAD + past.start : LEAD + past.stop, :2],
                feature_trail=self._features[past],
                error_history=self._error[past],
                footprint=camera_footprint(*view),
                floor_lines=floor_lines(*view) if camera_image is None else (),
                camera_image=camera_image,
                distractor=distractor,
                caption=self._caption,
            )
        )


def level_caption(level: int) -> str:
    """Number and name of a level, the caption of pictures."""
    return f"level {level} {LEVEL_NAMES[level]}"
