"""Images of the arm's camera through the full camera model: textured floor, target marker and distractor.

Height, tilt and lens are constant during an episode, so each pixel's floor point is constant in the camera's frame. The
rays are traced once per episode; a frame only rotates and shifts them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.arrivals import Arrivals
from servotrack.envs.servo.episode import sample_times, samples
from servotrack.envs.servo.exposure import NOISE_SIDE, Arms, Floors, Rays, SensorNoise, expose, trace_rays
from servotrack.envs.servo.floor import floor_texture
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.servo.world import ServoWorld
from servotrack.envs.state import State, put, taken
from servotrack.envs.streams import Streams, draw_share, draw_uniform, start_stream
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, FloatArray, Labels, Mask


class FloorCamera:
    """Base class of cameras over a floor: arrival of frames, rays, floor and noise.

    Args:
        world: World to render; it is not changed.
        image_size: Width and height S of a delivered image, px. An image covers the camera's whole field of view.
        image_noise: Standard deviation of the noise on every pixel and channel, gray levels.

    Attributes:
        images: The newest images that arrived, (N, S, S, 3) uint8, RGB; overwritten by `update`.
        frame_time: Time stamps of these images, (N,) s.
        goal: Goal positions in the images, (N, 2) px.
    """

    def __init__(self, world: ServoWorld, image_size: int, image_noise: float) -> None:
        self._world = world
        self._scale = image_size / world.config.camera_size
        count = world.count
        self.images = np.zeros((count, image_size, image_size, 3), np.uint8)
        self._arrivals = Arrivals(world)
        self.frame_time, self.goal = self._arrivals.frame_time, np.zeros((count, 2))
        self._rays = no_rays(count, image_size)
        self._floor_pose, self._floor_color = np.zeros((count, 4)), np.zeros((count, 3))
        self._noise = SensorNoise(
            noise_tile(image_noise, image_size), np.zeros((count, samples(world.config), 2), np.int64)
        )

    def update(self) -> None:
        """Render the frames that have arrived since the last call."""
        for row in self._arrivals.update():
            self._begin(row)
        self._expose(self._arrivals.rows)

    def get_state(self) -> State:
        """Return what `set_state` needs: the newest images and their times."""
        return taken(self, ("images",)) | self._arrivals.get_state()

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state, after the world.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        for row in self._arrivals.set_state(state):
            self._begin(row)
        put(self, ("images",), state)

    def _begin(self, row: int) -> None:
        """Load a row's new episode."""
        world, seed = self._world, int(self._world.seeds[row])
        self.goal[row] = world.goal[row] * self._scale
        self._noise.offset[row] = noise_offsets(seed, self._noise.offset.shape[1])
        self._floor_pose[row], self._floor_color[row] = floor_of(seed)
        trace_rays(world.cameras[row], 1.0 / self._scale, *(table[row] for table in self._rays))

    def _arms(self) -> Arms:
        world = self._world
        return Arms(world.cameras, world.links, world.history)

    def _expose(self, rows: Mask) -> None:
        """Render the frames that arrived in these rows."""
        raise NotImplementedError


class ImageSensor(FloorCamera):
    """Images of a servo world's N cameras, kept up to date by `update`. Arguments and attributes: see `FloorCamera`."""

    def __init__(self, world: ServoWorld, image_size: int, image_noise: float) -> None:
        super().__init__(world, image_size, image_noise)
        self._distractors = np.zeros((world.count, samples(world.config), 4))

    def distractor(self, row: int) -> Array:
        """True current position of one row's distractor, (2,) m."""
        return self._distractors[row, self._world.steps[row] + LEAD, :2]

    def _begin(self, row: int) -> None:
        super()._begin(row)
        world = self._world
        self._distractors[row] = _distractor_path(int(world.seeds[row]), world.paths[row], sample_times(world.config))

    def _expose(self, rows: Mask) -> None:
        world = self._world
        expose(
            rows, world.captured, world.config.rolling_shutter, 1.0 / self._scale, self._arms(), world.paths,
            self._distractors, self._rays, Floors(floor_texture(), self._floor_pose, self._floor_color), self._noise,
            self.images,
        )  # fmt: skip


def no_rays(count: int, image_size: int) -> Rays:
    """Empty ray tables of N images of S x S pixels."""
    table = count, image_size, image_size
    return Rays(
        ground=np.zeros((*table, 2), np.float32),
        light=np.zeros(table, np.float32),
        spread=np.zeros(table, np.float32),
        detail=np.zeros(table, np.uint8),
    )


def floor_of(seed: int) -> tuple[Array, Array]:
    """Pose of the floor of a seed (cos, sin, shift in tiles; (4,)) and its color at brightness 1 (3,)."""
    pose, color = np.empty(4), np.empty(3)
    _draw_floor(seed, pose, color)
    return pose, color


@njit(cache=True, nogil=True)
def _draw_floor(seed, pose, color):  # type: ignore[no-untyped-def]
    state = np.empty(4, np.uint64)
    start_stream(seed, Stream.FLOOR.value, state)
    angle = draw_uniform(state, 0.0, 2.0 * math.pi)
    brightness, warmth = draw_uniform(state, 105.0, 165.0), draw_uniform(state, -0.06, 0.08)
    pose[0], pose[1] = math.cos(angle), math.sin(angle)
    pose[2], pose[3] = draw_share(state), draw_share(state)
    for channel, share in enumerate((1.0, 0.4, -1.0)):
        color[channel] = brightness * (1.0 + warmth * share)


def noise_offsets(seed: int, length: int) -> Labels:
    """First row and column in the noise tile of each frame in the episode of a seed, (length, 2)."""
    return Streams(seed)[Stream.IMAGE_NOISE].integers(0, NOISE_SIDE, (length, 2))


@lru_cache(maxsize=16)
def noise_tile(level: float, image_size: int) -> FloatArray:
    """Sensor noise that frames read at random offsets, see `SensorNoise.tile`; columns repeat after 256."""
    tile = np.random.default_rng(0).standard_normal((NOISE_SIDE, NOISE_SIDE, 3))
    columns = np.arange(NOISE_SIDE + image_size) % NOISE_SIDE
    return (level * tile[:, columns]).astype(np.float32).reshape(NOISE_SIDE, -1)


def _distractor_path(seed: int, path: Array, times: Array) -> Array:
    """Draw positions and velocities of the distractor, (K, 4). It circles slowly near the target's path, or rests."""
    rng = Streams(seed)[Stream.DISTRACTOR]
    low, high = path[:, :2].min(axis=0) - 0.1, path[:, :2].max(axis=0) + 0.1
    center = rng.uniform(low, high)
    radii = rng.uniform(0.02, 0.15, 2) * (rng.random() < 0.7)
    rate, phases = rng.uniform(0.1, 0.6), rng.uniform(0.0, 2.0 * math.pi, 2)
    angles = rate * times[:, None] + phases
    return np.concatenate([center + radii * np.sin(angles), radii * rate * np.cos(angles)], axis=1)
