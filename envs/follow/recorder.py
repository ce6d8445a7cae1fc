"""Recorder of one row of a `FollowWorld` for its pictures: trails and distances so far."""

from __future__ import annotations

import numpy as np

from servotrack.envs.follow.imaging import CloseUp
from servotrack.envs.follow.render import FollowScene, draw
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.backdrop import CAMERA_PANEL
from servotrack.envs.servo.episode import samples
from servotrack.envs.servo.footprint import camera_footprint
from servotrack.envs.servo.records import RING
from servotrack.envs.servo.targets import LEAD
from servotrack.estimators.camera import CAMERA_SIZE, project_points
from servotrack.estimators.types import Array, Image

RECENT = 30
"""Number of past samples of the person's path in the camera's view."""


class Recorder:
    """Records an episode for its pictures. Call `record` after every reset and step; `frame` draws the current state.

    Args:
        world: World to draw; it is not changed.
        row: Row of the arm.
        caption: Text in the picture: lower-case letters, digits and spaces.
    """

    def __init__(self, world: FollowWorld, row: int = 0, caption: str = "") -> None:
        self._world, self._row, self._caption = world, row, caption
        length = samples(world.config) - LEAD
        self._tool, self._distance = np.zeros((length, 2)), np.zeros(length)
        self._wrong, self._lost = np.zeros(length, np.bool_), np.zeros(length, np.bool_)
        self._first, self._captured, self._history = 0, -1, np.zeros((RING, 2))
        self._close_up = CloseUp(world, row, CAMERA_PANEL.width)

    def record(self) -> None:
        """Store the world's newest sample. The first sample of an episode clears the old trails."""
        world, row = self._world, self._row
        step = int(world.steps[row])
        self._first = step if step == 0 else min(self._first, step)
        self._tool[step], self._distance[step] = world.tool[row], world.tracking_error[row]
        self._wrong[step], self._lost[step] = world.identity_error[row], world.lost[row]
        # While frames are lost, the world's ring buffer overwrites the joint angles of the newest frame.
        if step == 0 or world.captured[row] != self._captured:
            self._captured, self._history = int(world.captured[row]), world.history[row].copy()

    def frame(
        self, camera_image: Image | None = None, detections: Array | None = None, belief: Array | None = None
    ) -> Image:
        """Draw the current state.

        Args:
            camera_image: Newest image that the agent gets, RGB, square. None: an image is rendered.
            detections: Detections in the newest frame: existence, u, v, width, height (px), red, green, blue. (M, 8).
            belief: Position of the person in the newest frame as estimated by an agent, (2,) px.

        Returns:
            A new RGB image, shape (416, 720, 3), uint8.
        """
        world, row = self._world, self._row
        episode, size = world.episode(row), world.config.camera_size
        now = int(world.steps[row]) + LEAD
        past = slice(self._first, int(world.steps[row]) + 1)
        if camera_image is None:
            camera_image = self._close_up.picture(self._captured, self._history)
        crowd = episode.crowd
        return draw(
            FollowScene(
                links=world.links[row],
                joint_angles=world.joints[row],
                people=crowd.paths[now, :, :2],
                walk=crowd.walk[now],
                outfits=episode.outfits,
                goal=world.goal[row],
                camera_size=size,
                camera_image=camera_image,
                visible=bool(world.visible[row]),
                distance=float(world.tracking_error[row]),
                time=float(world.time[row]),
                footprint=camera_footprint(world.cameras[row], world.links[row], world.joints[row], size),
                tool_trail=self._tool[past],
                person_trail=world.paths[row, LEAD + past.start : LEAD + past.stop, :2],
                image_trail=self._recent_way(),
                distances=self._distance[past],
                wrong=self._wrong[past],
                lost=self._lost[past],
                span=len(self._distance),
                detections=detections,
                belief=belief,
                caption=self._caption,
            )
        )

    def _recent_way(self) -> Array:
        """The person's past positions on the plane, projected into the newest image, (k, 2) px."""
        world, row = self._world, self._row
        places = world.paths[row, max(self._captured - RECENT, 0) : self._captured + 1, :2]
        camera = np.broadcast_to(world.cameras[row], (len(places), CAMERA_SIZE))
        links = np.broadcast_to(world.links[row], places.shape)
        joints = np.broadcast_to(self._history[self._captured % RING], places.shape)
        pixels, seen = project_points(camera, links, joints, places)
        return pixels[seen]
