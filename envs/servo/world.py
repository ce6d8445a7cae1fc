"""Dynamics, sensors and scores of N servo arms, shared by the single and the vector environments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servotrack.envs.servo.arm import ArmSpace
from servotrack.envs.servo.episode import LEAD, Episode, draw_episode, samples
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW, PERIOD, START
from servotrack.estimators.camera import CAMERA_SIZE, image_jacobian, project
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels, Mask

LOST_SAMPLES = 20
"""An episode ends after this many consecutive samples with the target out of view."""
SUCCESS_DISTANCE = 0.010
"""Tracking errors below this count as success, m."""
_REWARD_SCALE = 0.002  # tracking error at which the reward's slope becomes logarithmic, m
_REWARD_RANGE = 2.0  # tracking error from which on the reward is 0, m
RING = 8
"""Number of past joint angles that a world stores, for frames that arrive late."""


@njit(cache=True, nogil=True)
def tracking_reward(distance):  # type: ignore[no-untyped-def]
    """Reward for a distance (m) between tool and target: 1 at 0, 0 from 2 m on, logarithmic in between."""
    near = 1.0 - math.log1p(distance / _REWARD_SCALE) / math.log1p(_REWARD_RANGE / _REWARD_SCALE)
    return min(max(near, 0.0), 1.0)


class SenseSettings(NamedTuple):
    """Parameters of a world that its sensors and scores depend on.

    Attributes:
        warmup: Number of unscored steps at the start of an episode.
        horizon: Number of scored steps; the episode is truncated after them.
        lost_after: Number of consecutive samples out of view that ends an episode.
        camera_size: Width and height of the camera's image, px.
        shutter: Duration of the rolling shutter's readout, s; 0 is a global shutter.
        stamped: True if frames carry the time when they were taken, False if they carry the time of their arrival.
        quantized: True if features are rounded to the centers of pixels.
    """

    warmup: int
    horizon: int
    lost_after: int
    camera_size: float
    shutter: float
    stamped: bool
    quantized: bool


class EpisodeTables(NamedTuple):
    """Draws of the episodes of N arms, with K samples each. Written at reset. A table with 0 samples is unused.

    Attributes:
        links: Link lengths, (N, 2) m.
        cameras: Packed cameras, (N, CAMERA_SIZE).
        goal: Goal features, (N, 2) px.
        latency: Age of a frame when it arrives, (N,) samples, int.
        paths: The target's positions and velocities, (N, K, 4) m, m/s.
        feature_noise: Noise of the features, (N, K or 0, 2) px.
        encoder_noise: Noise of the encoders, (N, K or 0, 2) rad.
        dropped: Mask of the lost frames, (N, K or 0).
    """

    links: Array
    cameras: Array
    goal: Array
    latency: Labels
    paths: Array
    feature_noise: Array
    encoder_noise: Array
    dropped: Mask


class Sample(NamedTuple):
    """Newest sample of N arms: truth, scores and sensor readings. Written at every step.

    Attributes:
        time: Current time, (N,) s; scoring starts at 0.
        tool: True tool position, (N, 2) m.
        target: True target position and velocity, (N, 4) m, m/s.
        tracking_error: Distance between tool and target in the plane, (N,) m.
        feature_error: Distance between the true current features and the goal, (N,) px.
        out_of_view: Number of samples since the target was last in view, (N,) int.
        reward: Reward, (N,).
        terminated: The target was out of view for `lost_after` samples, (N,) bool.
        truncated: The horizon was reached, (N,) bool.
        joint_angles: Encoder readings, (N, 2) rad.
        captured: Index into the episode's tables of the newest frame that arrived with an image, (N,) int.
        features: Features of the newest frame, (N, 2) px.
        visible: 1.0 if a new frame that shows the target arrived, else 0.0, (N,).
        frame_time: Time stamp of that frame, (N,) s.
    """

    time: Array
    tool: Array
    target: Array
    tracking_error: Array
    feature_error: Array
    out_of_view: Labels
    reward: Array
    terminated: Mask
    truncated: Mask
    joint_angles: Array
    captured: Labels
    features: Array
    visible: Array
    frame_time: Array


class ServoWorld:
    """N arms with their cameras and targets, stepped together. Arrays have a leading axis of N.

    `reset` and `step` write the newest sample into the public arrays below and overwrite the old one: copy arrays that
    you keep.

    Args:
        config: Parameters of the world.
        count: Number of arms N.
        lost_after: Number of consecutive samples out of view that ends an episode.

    Attributes:
        joint_angles: Encoder readings, (N, 2) rad.
        features: Features of the newest frame, (N, 2) px.
        visible: 1.0 if a new frame that shows the target arrived, else 0.0, (N,).
        frame_time: Time stamp of that frame, (N,) s.
        time: Current time, (N,) s; scoring starts at 0.
        goal: Goal features, (N, 2) px.
        reward: Reward of the newest sample, (N,).
        terminated: The target was out of view for `lost_after` samples, (N,) bool.
        truncated: The horizon was reached, (N,) bool.
        tracking_error: Distance between tool and target in the plane, (N,) m.
        feature_error: Distance between the true current features and the goal, (N,) px.
        joints: True joint angles, (N, 2) rad.
        tool: True tool position, (N, 2) m.
        target: True target position and velocity, (N, 4) m, m/s.
        paths: The target's positions and velocities at all samples, (N, K, 4) m, m/s.
        captured: Index into the episode's tables of the newest frame that arrived with an image, (N,) int.
    """

    def __init__(self, config: ServoConfig, count: int, lost_after: int = LOST_SAMPLES) -> None:
        self.config = config
        self.count = count
        length = samples(config)
        self.arms = ArmSpace(config, count)
        self.joints = self.arms.angles
        self.episodes: list[Episode | None] = [None] * count
        self.links, self.cameras = np.ones((count, 2)), np.ones((count, CAMERA_SIZE))
        self.goal, self.gain, self.noise_levels = np.zeros((count, 2)), np.ones((count, 2)), np.zeros((count, 2))
        self.latency, self.steps = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.paths = np.zeros((count, length, 4))
        self._feature_noise = np.zeros((count, length if config.pixel_noise or config.outlier_rate else 0, 2))
        self._rate_noise = np.zeros((count, length if any(config.actuation_noise) else 0, 2))
        self._encoder_noise = np.zeros((count, length if any(config.encoder_noise) else 0, 2))
        self._dropped = np.zeros((count, length if config.dropout else 0), np.bool_)
        self.history = np.zeros((count, RING, 2))
        """True joint angles of the last samples, a ring buffer indexed by table index modulo RING, (N, RING, 2) rad."""
        self._out_of_view = np.zeros(count, np.int64)
        self.joint_angles, self.features = np.zeros((count, 2)), np.zeros((count, 2))
        self.visible, self.frame_time, self.time = np.zeros(count), np.zeros(count), np.zeros(count)
        self.reward = np.zeros(count)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.tracking_error, self.feature_error = np.zeros(count), np.zeros(count)
        self.tool, self.target = np.zeros((count, 2)), np.zeros((count, 4))
        self.captured = np.zeros(count, np.int64)
        self._rates = np.zeros((count, 2))
        self._all_rows = np.ones(count, np.bool_)
        # The kernels write into these arrays. They are never replaced, so the records are built once.
        self._sense_settings = SenseSettings(
            config.warmup, config.horizon, lost_after, float(config.camera_size), float(config.rolling_shutter),
            bool(config.stamped), config.noise_kind == "quantized",
        )  # fmt: skip
        self._episode_tables = EpisodeTables(
            self.links, self.cameras, self.goal, self.latency, self.paths, self._feature_noise, self._encoder_noise,
            self._dropped,
        )  # fmt: skip
        self._sample = Sample(
            self.time, self.tool, self.target, self.tracking_error, self.feature_error, self._out_of_view, self.reward,
            self.terminated, self.truncated, self.joint_angles, self.captured, self.features, self.visible,
            self.frame_time,
        )  # fmt: skip

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows are not changed.

        Args:
            rows: Indices of the rows, 0 to N - 1.
            seeds: Episode seed of each of these rows, non-negative integers.
        """
        moved = np.zeros(self.count, np.bool_)
        for row, seed in zip(rows, seeds, strict=True):
            self._begin(row, seed)
            moved[row] = True
        self._observe(moved)

    def _draw(self, seed: int) -> Episode:
        return draw_episode(self.config, seed)

    def _begin(self, row: int, seed: int) -> None:
        """Load a new episode into a row, without observing it."""
        episode = self._draw(seed)
        self.episodes[row] = episode
        self.arms.reset(row, episode.links)
        self.links[row], self.cameras[row], self.goal[row] = episode.links, episode.camera, episode.goal
        self.gain[row], self.latency[row] = episode.gain, episode.latency
        self.noise_levels[row], self.paths[row] = episode.noise_levels, episode.path
        for table, values in (
            (self._feature_noise, episode.feature_noise),
            (self._rate_noise, episode.rate_noise),
            (self._encoder_noise, episode.encoder_noise),
            (self._dropped, episode.dropped),
        ):
            if table.shape[1]:
                table[row] = values
        self.steps[row] = 0
        self._rates[row] = 0.0
        self.history[row] = START
        self._out_of_view[row] = 0
        self.features[row] = self.config.camera_size / 2.0
        self.frame_time[row] = -(LEAD + self.config.warmup) * PERIOD
        self.captured[row] = 0

    def step(self, actions: Array, rows: Mask | None = None) -> None:
        """Advance rows by one control period.

        Args:
            actions: Fractions of `max_joint_rate`, clipped to [-1, 1] joint by joint as hardware does, (N, 2).
            rows: Mask of the rows whose episode is running, (N,) bool; None for all. The other arms move too, because
                they share the physics engine, but are not counted or observed until their reset.
        """
        if rows is None:
            rows = self._all_rows
        _command(
            rows, actions, self.steps, self.joints, self.config.max_joint_rate, PERIOD / self.config.substeps,
            self.gain, self._rate_noise, self._rates,
        )  # fmt: skip
        self.arms.step(self._rates)
        self._observe(rows)

    def _observe(self, rows: Mask) -> None:
        _sense(
            rows, self.steps, self.joints, self.history, self._sense_settings, self._episode_tables, self._sample
        )  # fmt: skip

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.warmup + self.config.horizon

    def privileged(self) -> dict[str, Array]:
        """Additional observations for oracles and the informed bound, arrays of N rows.

        Returns:
            `true_jacobian` (N, 2, 3) at the current time, px/rad and px/s; `true_camera` (N, CAMERA_SIZE), packed as in
            `servotrack.estimators.camera.pack_camera`; `true_links` (N, 2) m; `true_latency` (N, 1) s, the age of a
            frame minus the age according to its stamp; `true_readout` (N, 1) s, duration of the rolling shutter;
            `true_noise` (N, 2), standard deviations of encoders (rad) and joint rates (rad/s); `true_gain` (N, 2),
            factors on the joint rates.
        """
        # An unstamped frame has its time of arrival, half a readout after its middle row was read.
        hidden = np.where(self.config.stamped, 0.0, self.latency * PERIOD + 0.5 * self.config.rolling_shutter)
        position, velocity = self.target[:, :2], self.target[:, 2:]
        return {
            "true_jacobian": image_jacobian(self.cameras, self.links, self.joints, position, velocity),
            "true_camera": self.cameras.copy(),
            "true_links": self.links.copy(),
            "true_latency": hidden[:, None] + 0.0,
            "true_readout": np.full((self.count, 1), self.config.rolling_shutter),
            "true_noise": self.noise_levels.copy(),
            "true_gain": self.gain.copy(),
        }

    def debug_view(self, row: int = 0) -> str:
        """State of one row as text, for debugging."""
        degrees = np.degrees(self.joints[row])
        return (
            f"t={self.time[row]:+.2f} s  joints=({degrees[0]:+.1f}, {degrees[1]:+.1f}) deg  "
            f"tool={self.tool[row].round(4)} m  target={self.target[row, :2].round(4)} m  "
            f"error={1e3 * self.tracking_error[row]:.2f} mm  features={self.features[row].round(2)} px  "
            f"goal={self.goal[row].round(2)} px  visible={bool(self.visible[row])}"
        )


@njit(cache=True, nogil=True)
def _command(  # type: ignore[no-untyped-def]
    rows, actions, steps, joints, max_joint_rate, substep, gain, rate_noise, rates
):
    """Compute the motors' joint rates: clipped, with gain error and noise, limited so that joints stop at their stops.

    `rates` holds the last period's rates and is overwritten. The steps of the chosen rows are counted.
    """
    for i in range(actions.shape[0]):
        for j in range(2):
            rate = min(max(actions[i, j], -1.0), 1.0) * max_joint_rate * gain[i, j]
            if rate_noise.shape[1] > 0:
                rate += rate_noise[i, steps[i] + LEAD, j]
            # With the stops alone a joint overshoots by more than a degree. A motor reacts one substep late, so the
            # angle that the joint coasts until then is subtracted from the angle that is left.
            coasted = joints[i, j] + substep * rates[i, j]
            rates[i, j] = min(max(rate, (JOINT_LOW[j] - coasted) / PERIOD), (JOINT_HIGH[j] - coasted) / PERIOD)
        if rows[i]:
            steps[i] += 1


@njit(cache=True, nogil=True)
def interpolate_path(before, after, fraction):  # type: ignore[no-untyped-def]
    """Position a `fraction` of a period after `before`, by cubic Hermite interpolation between two rows of a path."""
    f, g = fraction, 1.0 - fraction
    hermite = np.empty(2)
    for j in range(2):
        hermite[j] = (
            g * g * (1.0 + 2.0 * f) * before[j] + f * f * (3.0 - 2.0 * f) * after[j]
            + PERIOD * f * g * (g * before[2 + j] - f * after[2 + j])
        )  # fmt: skip
    return hermite[0], hermite[1]


@njit(cache=True, nogil=True)
def capture(camera, links, before, after, history, frame, size, shutter):  # type: ignore[no-untyped-def]
    """Noise-free features in the frame whose readout ends at sample `frame`; each image row has its own instant.

    The target moves from `before`, its position and velocity one sample earlier, to `after`.
    """
    now = history[frame % RING]
    u, v, seen = project(camera, links[0], links[1], now[0], now[1], after[0], after[1])
    if shutter > 0.0:
        old = history[(frame - 1) % RING]
        for _ in range(3):
            f = 1.0 - shutter * (1.0 - min(max(v / size, 0.0), 1.0)) / PERIOD
            theta1 = old[0] + f * (now[0] - old[0])
            theta2 = old[1] + f * (now[1] - old[1])
            x, y = interpolate_path(before, after, f)
            u, v, seen = project(camera, links[0], links[1], theta1, theta2, x, y)
    return u, v, seen and 0.0 <= u < size and 0.0 <= v < size


@njit(cache=True, nogil=True)
def _sense(rows, steps, joints, history, settings, episodes, sample):  # type: ignore[no-untyped-def]
    """Compute the newest sample of every chosen row: truth, score and sensor readings.

    Args:
        rows: Mask of the rows, (N,) bool.
        steps: Number of steps since reset, (N,) int.
        joints: True joint angles, (N, 2) rad.
        history: Ring buffer of the last joint angles; the present ones are written into it, (N, RING, 2) rad.
        settings: Parameters of the world, `SenseSettings`.
        episodes: Draws of the episodes, `EpisodeTables`.
        sample: Newest sample, overwritten, `Sample`.
    """
    warmup, horizon, lost_after, size, shutter, stamped, quantized = settings
    links, cameras, goal, latency, path, feature_noise, encoder_noise, dropped = episodes
    time, tool, target, out_of_view = sample.time, sample.tool, sample.target, sample.out_of_view
    tracking_error, feature_error, reward = sample.tracking_error, sample.feature_error, sample.reward
    terminated, truncated, joint_angles = sample.terminated, sample.truncated, sample.joint_angles
    captured, features, visible, frame_time = sample.captured, sample.features, sample.visible, sample.frame_time
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        now = steps[i] + LEAD
        theta1, theta2 = joints[i, 0], joints[i, 1]
        history[i, now % RING, 0] = theta1
        history[i, now % RING, 1] = theta2
        time[i] = (steps[i] - warmup) * PERIOD
        for j in range(4):
            target[i, j] = path[i, now, j]

        tool[i, 0] = links[i, 0] * math.cos(theta1) + links[i, 1] * math.cos(theta1 + theta2)
        tool[i, 1] = links[i, 0] * math.sin(theta1) + links[i, 1] * math.sin(theta1 + theta2)
        distance = math.hypot(tool[i, 0] - target[i, 0], tool[i, 1] - target[i, 1])
        tracking_error[i] = distance
        u, v, seen = project(cameras[i], links[i, 0], links[i, 1], theta1, theta2, target[i, 0], target[i, 1])
        feature_error[i] = math.hypot(u - goal[i, 0], v - goal[i, 1])
        in_view = seen and 0.0 <= u < size and 0.0 <= v < size
        out_of_view[i] = 0 if in_view else out_of_view[i] + 1
        terminated[i] = out_of_view[i] >= lost_after
        truncated[i] = steps[i] >= warmup + horizon
        scored = steps[i] > warmup and not terminated[i]
        reward[i] = tracking_reward(distance) if scored else 0.0

        for j in range(2):
            joint_angles[i, j] = joints[i, j]
            if encoder_noise.shape[1] > 0:
                joint_angles[i, j] += encoder_noise[i, now, j]

        frame = now - latency[i]
        visible[i] = 0.0
        if dropped.shape[1] > 0 and dropped[i, frame]:
            continue
        captured[i] = frame
        u, v, in_view = capture(
            cameras[i], links[i], path[i, frame - 1], path[i, frame], history[i], frame, size, shutter
        )
        if not in_view:
            continue
        if feature_noise.shape[1] > 0:
            u += feature_noise[i, frame, 0]
            v += feature_noise[i, frame, 1]
        if quantized:
            u, v = math.floor(u) + 0.5, math.floor(v) + 0.5
        features[i, 0] = min(max(u, 0.0), size)
        features[i, 1] = min(max(v, 0.0), size)
        visible[i] = 1.0
        # A rolling shutter's frame is stamped with the instant of its middle row.
        frame_time[i] = (frame - LEAD - warmup) * PERIOD - 0.5 * shutter if stamped else time[i]
