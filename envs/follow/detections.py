"""Simulated person detector on the arm's camera: image points with sizes and colors, clutter, misses and merging."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.streams import FollowStream
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.arrivals import Arrivals
from servotrack.envs.servo.episode import samples
from servotrack.envs.servo.sensing import capture
from servotrack.envs.state import State, put, taken
from servotrack.envs.streams import Streams
from servotrack.envs.track.counts import poisson_quantile
from servotrack.estimators.camera import project_ground
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, FloatArray, Labels, Mask

COLUMNS = 8
"""Columns of a detection: existence; column and row of the center, width, height (px); red, green, blue."""
LARGEST_SIZE = 4.0
"""Largest width and height of a detection, image widths."""

_SIZE_NOISE = 0.08  # standard deviation of a size, as a fraction of it
_CLUTTER_SIZE = (0.3, 1.0)  # diameter of a false detection, m
_CLUTTER_COLOR = (15.0, 240.0)  # channels of a false detection's color, gray levels
_NUMBERS = COLUMNS - 1
_AROUND = np.array([(np.cos(angle), np.sin(angle)) for angle in 0.25 * np.pi * np.arange(8)])  # points of a circle


def capacity(config: FollowConfig) -> int:
    """Rows of an observation: all people, and the number of false detections exceeded once in 1e9 frames."""
    return config.people + poisson_quantile(config.clutter)


class DetectorTables(NamedTuple):
    """Tables of N crowds of P people over K samples that decide what the detector reports. Written at reset.

    Attributes:
        people: Positions and velocities, (N, K, P, 4) m, m/s.
        hidden: Mask of the people under a lampshade or another person's umbrella, (N, K, P).
        sizes: Diameters of the people without noise, (N, P) m.
        colors: Mean colors of the people without noise, (N, P, 3), gray levels.
        noise_scales: Standard deviations of column and row (px), width and height (fractions) and the color, (7,).
        noise: Standard normal noise, (N, K, P, 7).
        missed: Mask of the people that the detector misses, (N, K, P).
        first_false: Index of each frame's first false detection; the last entry is their number, (N, K + 1).
        clutter: Uniform numbers in [0, 1) for the false detections of all frames, one after the other, (N, C, 7).
        shuffle: Uniform numbers in [0, 1) for the order of the rows, (N, K, M).
    """

    people: Array
    hidden: Mask
    sizes: Array
    colors: Array
    noise_scales: Array
    noise: FloatArray
    missed: Mask
    first_false: Labels
    clutter: FloatArray
    shuffle: FloatArray


_SHOWN = ("detections", "truth", "target_box")


class DetectionSensor:
    """Detections in the newest frames of N cameras, kept up to date by `update`.

    Args:
        world: World to observe; it is not changed.

    Attributes:
        detections: Detections in the newest frames that arrived, (N, M, COLUMNS). Rows are in random order, unused rows
            are zeros.
        truth: True detections in that frame, (N, P, COLUMNS), in the crowd's order, without noise, clutter, misses and
            merging. Existence is 0 for hidden people; rows of people out of view are zeros.
        target_box: Left, top, width, height of the person to follow in the episode's first frame, (N, 4) px.
        frame_time: Time stamps of these frames, (N,) s.
    """

    def __init__(self, world: FollowWorld) -> None:
        config = world.config
        count, length, rows = world.count, samples(config), capacity(config)
        self._world = world
        self.detections = np.zeros((count, rows, COLUMNS))
        self.truth = np.zeros((count, config.people, COLUMNS))
        self.target_box = np.zeros((count, 4))
        self._arrivals = Arrivals(world)
        self._detector = float(config.camera_size), float(config.rolling_shutter), float(config.merge_distance)
        self.frame_time = self._arrivals.frame_time
        self._sizes, self._colors = np.zeros((count, config.people)), np.zeros((count, config.people, 3))
        size_noise = _SIZE_NOISE if config.pixel_noise else 0.0
        self._noise_scales = np.array([config.pixel_noise] * 2 + [size_noise] * 2 + [config.color_noise] * 3)
        self._noise = np.zeros((count, length, config.people, _NUMBERS), np.float32)
        self._missed = np.zeros((count, length, config.people), np.bool_)
        # False detections of all frames are stored one after the other; this is the first index of each frame.
        self._first_false = np.zeros((count, length + 1), np.int64)
        self._clutter = np.zeros((count, length * (rows - config.people), _NUMBERS), np.float32)
        self._shuffle = np.zeros((count, length, rows), np.float32)
        # These arrays are never replaced, so the record is built once.
        self._tables = DetectorTables(
            world.people, world.hidden, self._sizes, self._colors, self._noise_scales, self._noise, self._missed,
            self._first_false, self._clutter, self._shuffle,
        )  # fmt: skip

    def get_state(self) -> State:
        """Return what `set_state` needs: the newest detections and their times."""
        return taken(self, _SHOWN) | self._arrivals.get_state()

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state, after the world.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        for row in self._arrivals.set_state(state):
            self._begin(row)
        put(self, _SHOWN, state)

    def update(self) -> list[int]:
        """Process the frames that have arrived since the last call.

        Returns:
            Rows whose episode began since then.
        """
        world = self._world
        fresh = self._arrivals.update()
        for row in fresh:
            self._begin(row)
        _detect(
            self._arrivals.rows, world.captured, *self._detector, world.cameras, world.links, world.history,
            self._tables, self.truth, self.detections,
        )  # fmt: skip
        for row in fresh:
            middle, extent = self.truth[row, 0, 1:3], self.truth[row, 0, 3:5]
            self.target_box[row, :2], self.target_box[row, 2:] = middle - 0.5 * extent, extent
        return fresh

    def _begin(self, row: int) -> None:
        world, config = self._world, self._world.config
        episode = world.episode(row)
        self._sizes[row], self._colors[row] = episode.outfits.sizes, episode.outfits.colors
        # Fresh streams, so that a second sensor on the same episode reports the same detections.
        streams, (length, people) = Streams(episode.streams.seed), self._missed.shape[1:]
        streams[FollowStream.DETECTION_NOISE].standard_normal(out=self._noise[row], dtype=np.float32)
        self._missed[row] = streams[FollowStream.MISSES].random((length, people)) < config.misses
        rng = streams[FollowStream.CLUTTER]
        false = np.minimum(rng.poisson(config.clutter, length), self._shuffle.shape[2] - people)
        np.cumsum(false, out=self._first_false[row, 1:])
        rng.random(out=self._clutter[row, : self._first_false[row, -1]], dtype=np.float32)
        streams[FollowStream.SHUFFLE].random(out=self._shuffle[row], dtype=np.float32)


@njit(cache=True, nogil=True)
def _extent(camera, u, v, heading, tool, x, y, radius, out):  # type: ignore[no-untyped-def]
    """Fill `out` with width and height (px) of the smallest box around a disc on the plane that appears at (u, v)."""
    c, s = heading
    width, height = 0.0, 0.0
    for k in range(8):
        wx, wy = x + radius * _AROUND[k, 0] - tool[0], y + radius * _AROUND[k, 1] - tool[1]
        a, b, _ = project_ground(camera, c * wx + s * wy, s * wx - c * wy)
        width, height = max(width, abs(a - u)), max(height, abs(b - v))
    out[0], out[1] = 2.0 * width, 2.0 * height


@njit(cache=True, nogil=True)
def _deal(free, used, shares):  # type: ignore[no-untyped-def]
    """Return a free row, all equally likely: one exchange of the Fisher-Yates shuffle."""
    chosen = used + int(shares[used] * (len(free) - used))
    free[used], free[chosen] = free[chosen], free[used]
    return free[used]


@njit(cache=True, nogil=True)
def _between(bounds, share):  # type: ignore[no-untyped-def]
    """Interpolate between two bounds: share 0 is the lower one, 1 the upper one."""
    return bounds[0] + (bounds[1] - bounds[0]) * share


@njit(cache=True, nogil=True)
def _detect(  # type: ignore[no-untyped-def]
    rows, frames, size, shutter, merge, cameras, links, history, tables, truth, detections
):
    """Fill the outputs of every chosen row from its newest frame.

    Args:
        rows: Mask of the rows, (N,) bool.
        frames: Index of each row's newest frame in the episode's tables, (N,) int.
        size: Width and height of the camera's image, px.
        shutter: Duration of the rolling shutter's readout, s; 0 is a global shutter.
        merge: People closer than this are reported as one detection, m.
        cameras: Packed cameras, (N, CAMERA_SIZE).
        links: Link lengths, (N, 2) m.
        history: True joint angles of the last samples, a ring buffer, (N, RING, 2) rad.
        tables: People, noise, misses and clutter of all samples, `DetectorTables`.
        truth: True detections, overwritten, (N, P, COLUMNS).
        detections: Detections, overwritten, (N, M, COLUMNS).
    """
    people, hidden, missed, first_false = tables.people, tables.hidden, tables.missed, tables.first_false
    sizes, colors, noise_scales, noise = tables.sizes, tables.colors, tables.noise_scales, tables.noise
    clutter, shuffle = tables.clutter, tables.shuffle
    count = people.shape[2]
    heading, tool, rough = np.empty(2), np.empty(2), np.empty(_NUMBERS)
    group, free = np.empty(count, np.int64), np.empty(shuffle.shape[2], np.int64)
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
            # If the first frame is lost, the sample before it is used; people did not move before that sample.
            before, after = people[i, max(frame - 1, 0), k], people[i, frame, k]
            u, v, seen = capture(camera, links[i], before, after, history[i], frame, size, shutter)
            here = truth[i, k]
            here[:] = 0.0
            if not seen:
                continue
            here[0], here[1], here[2] = 0.0 if hidden[i, frame, k] else 1.0, u, v
            _extent(camera, u, v, heading, tool, after[0], after[1], 0.5 * sizes[i, k], here[3:5])
            here[5:] = colors[i, k]
        # Detected people and their merged groups: the first member of a group stands for all of them.
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
        for row in range(len(free)):
            free[row] = row
        for k in range(count):
            if group[k] != k:
                continue
            out = detections[i, _deal(free, used, shuffle[i, frame])]
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
            for number in range(_NUMBERS):
                rough[number] = noise_scales[number] * noise[i, frame, k, number]
            out[1] = min(max(0.5 * (left + right) + rough[0], 0.0), size)
            out[2] = min(max(0.5 * (top + bottom) + rough[1], 0.0), size)
            out[3] = min(max((right - left) * (1.0 + rough[2]), 1.0), LARGEST_SIZE * size)
            out[4] = min(max((bottom - top) * (1.0 + rough[3]), 1.0), LARGEST_SIZE * size)
            for channel in range(3):
                out[5 + channel] = min(max(out[5 + channel] / members + rough[4 + channel], 0.0), 255.0)
            used += 1
        meter = camera[0] / camera[4]
        for k in range(first_false[i, frame], first_false[i, frame + 1]):
            out = detections[i, _deal(free, used, shuffle[i, frame])]
            out[0] = 1.0
            for axis in range(2):
                out[1 + axis] = size * clutter[i, k, axis]
                out[3 + axis] = meter * _between(_CLUTTER_SIZE, clutter[i, k, 2 + axis])
            for channel in range(3):
                out[5 + channel] = _between(_CLUTTER_COLOR, clutter[i, k, 4 + channel])
            used += 1
