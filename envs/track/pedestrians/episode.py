"""Movement of all people of an episode, in one form for every script."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.files.recorded import RecordedTracks
from servotrack.envs.track.pedestrians.config import POPULATED, PedestrianConfig
from servotrack.envs.track.pedestrians.floor import Camera, lobby_camera
from servotrack.envs.track.pedestrians.movement import ImagePath, Movement, assemble, gait
from servotrack.envs.track.pedestrians.replay import replay
from servotrack.envs.track.pedestrians.scene import Walk, walk
from servotrack.envs.track.pedestrians.scripts import draw_parties


def draw_movement(
    config: PedestrianConfig,
    seed: int,
    recorded: RecordedTracks | None = None,
    obstacles: tuple[tuple[float, float, float], ...] = (),
) -> Movement:
    """Draw the movement of an episode with horizon + 1 frames.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, a non-negative integer.
        recorded: Recording for the script `replay`.
        obstacles: x, z and radius of each obstacle, m.

    Raises:
        ValueError: If the recording has more people at a time than `max_people`.
    """
    camera = lobby_camera(config.width, config.height)
    if recorded is not None:
        paths = replay(recorded, config, camera, Streams(seed))
    else:
        parties, frames = draw_parties(config, camera, seed)
        dt = 1.0 / config.frame_rate
        paths = [_seen(done, camera, dt) for done in walk(parties, frames, dt, config.max_people, obstacles)]
    # People who are present at the end of the empty frames appear together.
    shown_from = config.empty_frames if config.script in POPULATED else 0
    return assemble(paths, config.horizon + 1, config.max_people, float(config.width), shown_from)


def _seen(done: Walk, camera: Camera, dt: float) -> ImagePath:
    """Return the path of a walk in the image."""
    stature = done.plan.stature
    steps = np.diff(done.positions, axis=0, prepend=done.positions[:1]) / stature
    if len(steps) > 1:
        steps[0] = steps[1]
    walked = gait(steps, done.facing, math.nan, done.plan.wander[2], dt)
    return ImagePath(
        done.first,
        camera.project(done.positions),
        camera.scale(done.positions[:, 1]) * stature,
        walked[:, 0],
        walked[:, 1],
        walked[:, 2],
        done.plan.outfit_seed,
    )
