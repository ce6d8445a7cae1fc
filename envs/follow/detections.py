"""What a detector of people would tell of the arm's camera: image points with sizes and colors, clutter and misses."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.episode import FollowEpisode
from servotrack.envs.follow.streams import FollowStream
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.episode import LEAD, samples
from servotrack.envs.servo.targets import PERIOD
from servotrack.envs.servo.world import capture
from servotrack.envs.streams import Streams
from servotrack.envs.track.levels import poisson_quantile
from servotrack.estimators.camera import project_ground

Array = NDArray[np.float64]

COLUMNS = 8
"""Existence; column and row of the middle, width, height (px); red, green, blue (gray levels)."""
LARGEST = 4.0
"""Largest width and height of a detection, image widths."""

_SIZE_NOISE = 0.08  # standard deviation of a size, as a fraction
_CLUTTER_SIZE = (0.3, 1.0)  # diameter of a false detection, m
_CLUTTER_COLOR = (15.0, 240.0)
_NUMBERS = COLUMNS - 1


def capacity(config: FollowConfig) -> int:
    """Rows of an observation: everybody, and what clutter exceeds once in 1e9 frames."""
    return config.people + poisson_quantile(config.clutter)


class DetectionSensor:
    """The detections in the newest frames of N cameras, kept up to date by `update`.

    Args:
        world: The world, which the sensor only reads.

    Attributes:
        detections: In the newest frames that arrived, (N, M, COLUMNS), rows in random order, unused ones zeros.
        truth: Where everybody really is in that frame, (N, P, COLUMNS), in the crowd's order: without noise, clutter,
            misses and merging; existence 0 for who is hidden, zeros for who is out of view.
        target_box: Left, top, width, height of the person to follow in the first frame of all, (N, 4) px.
        frame_time: Time stamps of these frames, (N,) s.
    """

    def __init__(self, world: FollowWorld) -> None:
        config = world.config
        count, length, rows = world.count, samples(config), capacity(config)
        self._world = world
        self.detections = np.zeros((count, rows, COLUMNS))
        self.truth = np.zeros((count, config.people, COLUMNS))
        self.target_box = np.zeros((count, 4))
        self.frame_time = np.zeros(count)
        self._episodes: list[FollowEpisode | None] = [None] * count
        self._captured = np.full(count, -1)
        self._sizes, self._colors = np.zeros((count, config.people)), np.zeros((count, config.people, 3))
        self._noise = np.zeros((count, length, config.people, _NUMBERS), np.float32)
        self._missed = np.zeros((count, length, config.people), np.bool_)
        self._false = np.zeros((count, length), np.int64)
        self._clutter = np.zeros((count, length, rows - config.people, _NUMBERS), np.float32)
        self._order = np.zeros((count, length, rows), np.int16)

    def update(self) -> list[int]:
        """Take the frames in that have arrived since the last call.

        Returns:
            The rows whose episode began since then.
        """
        world, config = self._world, self._world.config
        # An episode is frozen: another object is another episode.
        fresh = [row for row, (a, b) in enumerate(zip(self._episodes, world.episodes, strict=True)) if a is not b]
        for row in fresh:
            self._begin(row)
        arrived = self._captured != world.captured
        arrived[fresh] = True
        self._captured[:] = world.captured
        stamps = (world.captured - LEAD - config.warmup) * PERIOD - 0.5 * config.rolling_shutter
        np.copyto(self.frame_time, stamps if config.stamped else world.time, where=arrived)
        _detect(
            arrived, world.captured, float(config.camera_size), config.rolling_shutter, config.merge_distance,
            world.cameras, world.links, world.history, world.people, world.hidden, self._sizes, self._colors,
            self._noise, self._missed, self._false, self._clutter, self._order, self.truth, self.detections,
        )  # fmt: skip
        person = self.truth[fresh, 0, 1:5]
        self.target_box[fresh] = np.concatenate([person[:, :2] - 0.5 * person[:, 2:], person[:, 2:]], axis=1)
        return fresh

    def _begin(self, row: int) -> None:
        world, config = self._world, self._world.config
        episode = world.episode(row)
        self._episodes[row] = episode
        self._sizes[row], self._colors[row] = episode.looks.sizes, episode.looks.colors
        # From their beginnings, so that a second sensor on the same episode sees the same.
        streams, shape = Streams(episode.streams.seed), self._missed.shape[1:]
        noise = streams[FollowStream.DETECTION_NOISE].standard_normal((*shape, _NUMBERS), dtype=np.float32)
        scale = (*(config.pixel_noise,) * 2, *(_SIZE_NOISE if config.pixel_noise else 0.0,) * 2)
        self._noise[row] = noise * np.array((*scale, *(config.color_noise,) * 3), np.float32)
        self._missed[row] = streams[FollowStream.MISSES].random(shape) < config.misses
        if self._clutter.shape[2]:
            rng = streams[FollowStream.CLUTTER]
            self._false[row] = np.minimum(rng.poisson(config.clutter, shape[0]), self._clutter.shape[2])
            clutter = rng.random(self._clutter.shape[1:], dtype=np.float32)
            clutter[..., :2] *= config.camera_size
            low, high = (diameter * episode.camera[0] / episode.camera[4] for diameter in _CLUTTER_SIZE)
            clutter[..., 2:4] = low + (high - low) * clutter[..., 2:4]
            dark, bright = _CLUTTER_COLOR
            clutter[..., 4:] = dark + (bright - dark) * clutter[..., 4:]
            self._clutter[row] = clutter
        keys = streams[FollowStream.SHUFFLE].random((shape[0], self._order.shape[2]), dtype=np.float32)
        self._order[row] = np.argsort(keys, axis=1)


@njit(cache=True, nogil=True)
def _extent(camera, u, v, heading, tool, x, y, radius, out):  # type: ignore[no-untyped-def]
    """Width and height (px) of the smallest box around a disc on the plane that is seen at (u, v)."""
    c, s = heading
    width, height = 0.0, 0.0
    for k in range(8):
        angle = 0.25 * np.pi * k
        wx, wy = x + radius * np.cos(angle) - tool[0], y + radius * np.sin(angle) - tool[1]
        a, b, _ = project_ground(camera, c * wx + s * wy, s * wx - c * wy)
        width, height = max(width, abs(a - u)), max(height, abs(b - v))
    out[0], out[1] = 2.0 * width, 2.0 * height


@njit(cache=True, nogil=True)
def _detect(  # type: ignore[no-untyped-def]
    rows, frames, size, shutter, merge, cameras, links, history, people, hidden, sizes, colors, noise, missed, false,
    clutter, order, truth, detections,
):  # fmt: skip
    """Fill the tables of every chosen row from its newest frame."""
    count = people.shape[2]
    path = np.empty((people.shape[1], 4))
    heading, tool = np.empty(2), np.empty(2)
    group = np.empty(count, np.int64)
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        frame = frames[i]
        camera, joints = cameras[i], history[i, frame % history.shape[1]]
        phi = joints[0] + joints[1]
        heading[0] = np.cos(phi) * camera[5] - np.sin(phi) * camera[6]
        heading[1] = np.sin(phi) * camera[5] + np.cos(phi) * camera[6]
        tool[0] = links[i, 0] * np.cos(joints[0]) + links[i, 1] * np.cos(phi)
        tool[1] = links[i, 0] * np.sin(joints[0]) + links[i, 1] * np.sin(phi)
        for k in range(count):
            # Before the first sample of all, which a frame that was lost at once falls back on, nobody moved.
            path[frame - 1], path[frame] = people[i, max(frame - 1, 0), k], people[i, frame, k]
            u, v, seen = capture(camera, links[i], path, history[i], frame, size, shutter)
            here = truth[i, k]
            here[:] = 0.0
            if not seen:
                continue
            here[0], here[1], here[2] = 0.0 if hidden[i, frame, k] else 1.0, u, v
            _extent(camera, u, v, heading, tool, path[frame, 0], path[frame, 1], 0.5 * sizes[i, k], here[3:5])
            here[5:] = colors[i, k]
        # Who is found, and together with whom: the first of a group of people who touch speaks for all.
        for k in range(count):
            group[k] = -1
            if truth[i, k, 0] == 0.0 or missed[i, frame, k]:
                continue
            group[k] = k
            for j in range(k):
                dx = people[i, frame, k, 0] - people[i, frame, j, 0]
                dy = people[i, frame, k, 1] - people[i, frame, j, 1]
                if group[j] >= 0 and dx * dx + dy * dy < merge * merge:
                    group[k] = group[j]
                    break
        detections[i] = 0.0
        used = 0
        for k in range(count):
            if group[k] != k:
                continue
            out = detections[i, order[i, frame, used]]
            out[0] = 1.0
            members = 0
            left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
            for j in range(k, count):
                if group[j] != k:
                    continue
                there = truth[i, j]
                members += 1
                left, right = min(left, there[1] - 0.5 * there[3]), max(right, there[1] + 0.5 * there[3])
                top, bottom = min(top, there[2] - 0.5 * there[4]), max(bottom, there[2] + 0.5 * there[4])
                for channel in range(5, 8):
                    out[channel] += there[channel]
            rough = noise[i, frame, k]
            out[1] = min(max(0.5 * (left + right) + rough[0], 0.0), size)
            out[2] = min(max(0.5 * (top + bottom) + rough[1], 0.0), size)
            out[3] = min(max((right - left) * (1.0 + rough[2]), 1.0), LARGEST * size)
            out[4] = min(max((bottom - top) * (1.0 + rough[3]), 1.0), LARGEST * size)
            for channel in range(3):
                out[5 + channel] = min(max(out[5 + channel] / members + rough[4 + channel], 0.0), 255.0)
            used += 1
        for k in range(false[i, frame]):
            out = detections[i, order[i, frame, used]]
            out[0] = 1.0
            for column in range(1, 8):
                out[column] = clutter[i, frame, k, column - 1]
            used += 1
