"""Images of the arm's camera over a crowd, and the picture of the person to follow that an agent gets at reset."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.follow.episode import FollowEpisode
from servotrack.envs.follow.exposure import expose_crowd
from servotrack.envs.follow.painting import CrowdTables
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.episode import samples
from servotrack.envs.servo.exposure import Arms, Floors, SensorNoise, trace_rays
from servotrack.envs.servo.floor import floor_texture
from servotrack.envs.servo.imaging import FloorCamera, floor_of, no_rays, noise_offsets, noise_tile
from servotrack.envs.servo.records import RING
from servotrack.envs.servo.targets import LEAD, START
from servotrack.envs.track.pedestrians.outfits import OUTFIT_NUMBERS
from servotrack.estimators.camera import project
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Mask

PATCH_SIZE = 32
"""Width and height of the picture of the person to follow, px."""
PATCH_SIDE = 0.8
"""Width and height of the part of the plane in that picture, m."""

_FLOOR_DOUBLED = 2  # times: the floor, like everything of the servo world, is four times larger here


class CrowdCamera(FloorCamera):
    """Images of the N cameras of a `FollowWorld`. `update` renders the newest frames.

    People are drawn flat on the plane, as seen from straight above, without the parallax of their height.

    Args:
        world: World to render; it is not changed.
        image_size: Width and height S of a delivered image, px. An image covers the camera's whole field of view.
        image_noise: Standard deviation of the noise on every pixel and channel, gray levels.

    Attributes:
        images: The newest images that arrived, (N, S, S, 3) uint8, RGB; overwritten by `update`.
        frame_time: Time stamps of these images, (N,) s.
        goal: Goal positions in the images, (N, 2) px.
    """

    _world: FollowWorld

    def __init__(self, world: FollowWorld, image_size: int, image_noise: float) -> None:
        super().__init__(world, image_size, image_noise)
        config = world.config
        self._crowds = _no_crowds(world.count, samples(config), config.people, config.lamps)

    def _begin(self, row: int) -> None:
        super()._begin(row)
        self._floor_pose[row], self._floor_color[row] = _floor(int(self._world.seeds[row]))
        _enlarge(self._rays.detail[row])
        episode = self._world.episode(row)
        _put(self._crowds, row, episode, episode.crowd.walk)

    def _expose(self, rows: Mask) -> None:
        world, config = self._world, self._world.config
        expose_crowd(
            rows, world.captured, float(config.rolling_shutter), 1.0 / self._scale, float(config.shadows), self._arms(),
            world.people, self._crowds, self._rays, Floors(floor_texture(), self._floor_pose, self._floor_color),
            self._noise, self.images,
        )  # fmt: skip


class CloseUp:
    """Noise-free view of one arm's camera at any size, rendered on request, for pictures of the world.

    Args:
        world: World to render; it is not changed.
        row: Row of the arm.
        image_size: Width and height S, px.
    """

    def __init__(self, world: FollowWorld, row: int, image_size: int) -> None:
        self._world, self._row, self._step = world, row, world.config.camera_size / image_size
        self._episode: FollowEpisode | None = None
        self._floor = np.zeros(4), np.zeros(3)
        self._rays, self._noise = no_rays(1, image_size), noise_tile(0.0, image_size)
        self._crowd = _no_crowds(1, samples(world.config), world.config.people, world.config.lamps)

    def picture(self, frame: int, history: Array) -> NDArray[np.uint8]:
        """Render a frame of the current episode.

        Args:
            frame: Index of the frame in the episode's tables.
            history: The world's ring buffer of joint angles at the time of the frame, (RING, 2) rad.

        Returns:
            A new RGB image, shape (S, S, 3).
        """
        world, config, one = self._world, self._world.config, slice(self._row, self._row + 1)
        episode = world.episode(self._row)
        if episode is not self._episode:
            self._episode, self._floor = episode, _floor(episode.streams.seed)
            trace_rays(episode.camera, self._step, *(table[0] for table in self._rays))
            _enlarge(self._rays.detail)
            _put(self._crowd, 0, episode, episode.crowd.walk)
        images = np.zeros((*self._rays.light.shape, 3), np.uint8)
        pose, color = self._floor
        expose_crowd(
            np.ones(1, np.bool_), np.full(1, frame), float(config.rolling_shutter), self._step, float(config.shadows),
            Arms(world.cameras[one], world.links[one], history[None]), world.people[one], self._crowd,
            self._rays, Floors(floor_texture(), pose[None], color[None]),
            SensorNoise(self._noise, np.zeros((1, samples(config), 2), np.int64)), images,
        )  # fmt: skip
        return images[0]


def _no_crowds(count: int, length: int, people: int, lamps: int) -> CrowdTables:
    """Empty tables of N crowds at a number of samples, with a leading axis of N."""
    return CrowdTables(
        walk=np.zeros((count, length, people, 3)),
        outfits=np.zeros((count, people, OUTFIT_NUMBERS)),
        umbrella=np.zeros((count, people)),
        umbrella_color=np.zeros((count, people, 3)),
        lamps=np.zeros((count, lamps, 3)),
    )


def _put(crowds: CrowdTables, row: int, episode: FollowEpisode, walk: Array) -> None:
    """Store an episode's crowd in a row of the tables; lampshades only as far as the table has rows."""
    outfits = episode.outfits
    crowds.walk[row] = walk
    crowds.outfits[row], crowds.lamps[row] = outfits.people, outfits.lamps[: crowds.lamps.shape[1]]
    crowds.umbrella[row], crowds.umbrella_color[row] = outfits.umbrella, outfits.umbrella_color


def target_patches(world: FollowWorld, rows: Iterable[int], image_noise: float) -> NDArray[np.uint8]:
    """Pictures of the person to follow: a square of the plane around the person, upright in the image, at reset.

    They are taken through the episode's camera at the instant of the first frame and enlarged. They show shadows and
    people nearby, but no umbrellas and lampshades, so that the person is always visible.

    Args:
        world: World whose rows have been reset.
        rows: Rows to picture.
        image_noise: Standard deviation of the noise on every pixel and channel, gray levels.

    Returns:
        Shape (rows, PATCH_SIZE, PATCH_SIZE, 3), RGB.
    """
    chosen = list(rows)
    pictures = np.zeros((len(chosen), PATCH_SIZE, PATCH_SIZE, 3), np.uint8)
    rays, one = no_rays(1, PATCH_SIZE), np.ones(1, np.bool_)
    noise = noise_tile(image_noise, PATCH_SIZE)
    history = np.broadcast_to(START, (1, RING, 2)).copy()
    for picture, row in zip(pictures, chosen, strict=True):
        episode = world.episode(row)
        frame = LEAD - episode.latency
        camera, step = _close_up(episode, frame)
        pose, color = _floor(episode.streams.seed)
        trace_rays(camera, step, *(table[0] for table in rays))
        _enlarge(rays.detail)
        crowd = _no_crowds(1, 1, len(episode.outfits.people), 0)
        _put(crowd, 0, episode, episode.crowd.first_walk(LEAD + 1)[frame : frame + 1])
        crowd.umbrella[:] = 0.0
        offset = noise_offsets(episode.streams.seed, frame + 1)[None, frame:]
        expose_crowd(
            one, np.zeros(1, np.int64), 0.0, step, float(world.config.shadows),
            Arms(camera[None], episode.links[None], history), episode.crowd.paths[None, frame : frame + 1],
            crowd, rays, Floors(floor_texture(), pose[None], color[None]), SensorNoise(noise, offset),
            picture[None],
        )  # fmt: skip
    return pictures


def _close_up(episode: FollowEpisode, frame: int) -> tuple[Array, float]:
    """The camera shifted so that its image begins at the patch's corner, and its pixels per pixel of the patch."""
    camera = episode.camera.copy()
    return camera, _approach(camera, episode.links, episode.crowd.paths[frame, 0]) / PATCH_SIZE


@njit(cache=True, nogil=True)
def _approach(camera, links, person):  # type: ignore[no-untyped-def]
    """Shift a packed camera so that its image begins at a corner of a person's patch; returns the patch's side, px."""
    (theta1, theta2), half, side = START, 0.5 * PATCH_SIDE, 0.0
    u, v, _ = project(camera, links[0], links[1], theta1, theta2, person[0], person[1])
    for dx, dy in ((half, 0.0), (0.0, half), (-half, 0.0), (0.0, -half)):
        a, b, _ = project(camera, links[0], links[1], theta1, theta2, person[0] + dx, person[1] + dy)
        side += math.hypot(a - u, b - v)
    side = 2.0 * (side / 4.0)
    camera[2] -= u - 0.5 * side
    camera[3] -= v - 0.5 * side
    return side


def _floor(seed: int) -> tuple[Array, Array]:
    pose, color = floor_of(seed)
    pose[:2] /= 2.0**_FLOOR_DOUBLED
    return pose, color


def _enlarge(detail: NDArray[np.uint8]) -> None:
    """Convert the levels of detail of the servo's floor to those of this larger floor."""
    detail -= np.minimum(detail, np.uint8(_FLOOR_DOUBLED))
