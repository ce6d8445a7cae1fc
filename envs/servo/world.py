"""Dynamics, sensors and scores of N servo arms, shared by the single and the vector environments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.compiled_arms import CompiledArms
from servotrack.envs.servo.engine import ENGINES
from servotrack.envs.servo.episode import (
    NEVER,
    Episode,
    Noise,
    ServoStreams,
    draw_episode,
    draw_noise,
    knocked_camera,
    loses_frames,
    samples,
)
from servotrack.envs.servo.layout import draw_gains, draw_layouts, never_rejected, no_layout, ranges_of
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.records import CONSTANTS, RING, SAMPLE, SETTINGS, Tables
from servotrack.envs.servo.sensing import advance, command, sense
from servotrack.envs.servo.targets import LEAD, PERIOD, START
from servotrack.envs.servo.threads import Threads
from servotrack.envs.state import State, entry, part, put, taken
from servotrack.estimators.camera import image_jacobian, zoomed_cameras
from servotrack.estimators.types import Array, Labels, Mask

LOST_SAMPLES = 20
"""An episode ends after this many consecutive samples with the target out of view."""
_LEAST_EPISODES = 4
"""Least number of episodes that a thread draws."""
SUCCESS_DISTANCE = 0.010
"""Tracking errors below this count as success, m."""


def _is_field(value: Any, records: NDArray[np.void]) -> bool:
    return isinstance(value, np.ndarray) and value.base is records


class ServoWorld:
    """N arms with their cameras and targets, stepped together. Arrays have a leading axis of N.

    `reset` and `step` write the newest sample into the public arrays below and overwrite the old one: copy arrays that
    you keep.

    Args:
        config: Parameters of the world.
        count: Number of arms N.
        lost_after: Number of consecutive samples out of view that ends an episode.
        engine: Name of the engine that moves the arms, see `engine.ENGINES`.
        threads: Number of threads that share a step of the compiled engine.

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
        seeds: Seed of the episode, (N,) int.
        begun: Number of episodes that began in a row, (N,) int.
        captured: Index into the episode's tables of the newest frame that arrived with an image, (N,) int.
    """

    def __init__(
        self,
        config: ServoConfig,
        count: int,
        lost_after: int = LOST_SAMPLES,
        engine: str = "pymunk",
        threads: int = 1,
    ) -> None:
        self.config = config
        self.count = count
        self.engine = engine
        self._threads = Threads(threads)
        length = samples(config)
        self.arms = ENGINES[engine](config, count)
        self.joints = self.arms.angles
        self.seeds, self.begun = np.zeros(count, np.int64), np.zeros(count, np.int64)
        # The kernels write into these arrays. They are never replaced, so views and tuples of them are made once.
        self._constants, self._samples = np.zeros(count, CONSTANTS), np.zeros(count, SAMPLE)
        # Before the first reset, any camera and arm with a Jacobian.
        for name in ("links", "camera", "gain"):
            self._constants[name] = 1.0
        self._constants["knocked_at"] = NEVER
        self._name_fields()
        self.paths = np.zeros((count, length, 4))
        self._tables = Tables(
            paths=self.paths,
            feature_noise=np.zeros((count, length if config.pixel_noise or config.outlier_rate else 0, 2)),
            rate_noise=np.zeros((count, length if any(config.actuation_noise) else 0, 2)),
            encoder_noise=np.zeros((count, length if any(config.encoder_noise) else 0, 2)),
            dropped=np.zeros((count, length if loses_frames(config) else 0), np.bool_),
            focal_factor=np.ones((count, length if config.zoom else 0)),
        )
        self.history = np.zeros((count, RING, 2))
        """True joint angles of the last samples, a ring buffer indexed by table index modulo RING, (N, RING, 2) rad."""
        self._all_rows = np.ones(count, np.bool_)
        self._ranges, self._fixed = ranges_of(config), never_rejected(config)
        noisy_tables = any(table.shape[1] for table in self._tables[1:])
        drawn = config.latency[0] != config.latency[1] or config.encoder_age[0] != config.encoder_age[1]
        self._noisy = noisy_tables or drawn or config.knock > 0.0
        self._settings = np.zeros(1, SETTINGS)
        for name, value in {
            "max_joint_rate": config.max_joint_rate,
            "substep": PERIOD / config.substeps,
            "warmup": config.warmup,
            "horizon": config.horizon,
            "lost_after": lost_after,
            "camera_size": config.camera_size,
            "shutter": config.rolling_shutter,
            "stamped": config.stamped,
            "quantized": config.noise_kind == "quantized",
            "lag": math.exp(-PERIOD / config.actuator_lag) if config.actuator_lag else 0.0,
            "backlash": config.backlash,
        }.items():
            self._settings[name] = value

    def _name_fields(self) -> None:
        """Make the fields of the records attributes."""
        constants, sample = self._constants, self._samples
        self.links, self.cameras, self.goal = constants["links"], constants["camera"], constants["goal"]
        self.gain, self.noise_levels, self.latency = constants["gain"], constants["noise_levels"], constants["latency"]
        self.steps, self.captured, self.time = sample["steps"], sample["captured"], sample["time"]
        self.joint_angles, self.features = sample["joint_angles"], sample["features"]
        self.visible, self.frame_time = sample["visible"], sample["frame_time"]
        self.reward, self.terminated, self.truncated = sample["reward"], sample["terminated"], sample["truncated"]
        self.tracking_error, self.feature_error = sample["tracking_error"], sample["feature_error"]
        self.tool, self.target = sample["tool"], sample["target"]

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy, without the views of the records."""
        records = self._constants, self._samples
        return {name: value for name, value in self.__dict__.items() if not any(_is_field(value, r) for r in records)}

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        """Take over the attributes of the copied world."""
        self.__dict__.update(attributes)
        self._name_fields()

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, and what has happened since their resets."""
        state = taken(self, ("seeds", "history"))
        state |= {f"sample/{name}": self._samples[name].copy() for name in SAMPLE.names or ()}
        return state | {f"arms/{name}": value for name, value in self.arms.get_state().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Episodes of other seeds are drawn again.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        seeds = entry(state, "seeds", (self.count,), np.int64)
        sample = np.zeros(self.count, SAMPLE)
        for name in SAMPLE.names or ():
            field = sample[name]
            field[...] = entry(state, f"sample/{name}", field.shape, field.dtype)
        length = self.episode_steps
        if seeds.min() < 0 or sample["steps"].min() < 0 or sample["steps"].max() > length:
            raise ValueError(f"state's seeds must be at least 0 and its steps lie in 0 to {length}")
        if sample["captured"].min() < 0 or (sample["captured"] > sample["steps"] + LEAD).any():
            raise ValueError(f"state's frames 'captured' must lie in 0 to the present one, got {sample['captured']}")
        moved = part(state, "arms")
        self.arms.check_state(moved)
        others = np.flatnonzero((self.seeds != seeds) | (self.begun == 0))
        if len(others):
            self._draw(others, seeds[others])
        self.seeds[:] = seeds
        self.begun[others] += 1
        self._samples[:] = sample
        put(self, ("history",), state)
        self.arms.set_state(moved, self.links)

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows are not changed.

        Args:
            rows: Indices of the rows, 0 to N - 1.
            seeds: Episode seed of each of these rows, non-negative integers.
        """
        moved = np.zeros(self.count, np.bool_)
        moved[rows] = True
        self._begin(np.asarray(rows, np.int64), np.asarray(seeds, np.int64))
        self._before_sensing()
        self._sense(moved)
        self._after_sensing(moved)

    def _begin(self, rows: Labels, seeds: Labels) -> None:
        """Load new episodes into rows, without observing them."""
        self._draw(rows, seeds)
        self.seeds[rows] = seeds
        self.begun[rows] += 1
        self.arms.reset(rows, self.links[rows])
        self.history[rows] = START
        started = np.zeros((), SAMPLE)
        started["features"] = self.config.camera_size / 2.0
        started["frame_time"] = -(LEAD + self.config.warmup) * PERIOD
        self._samples[rows] = started

    def _draw(self, rows: Labels, seeds: Labels) -> None:
        """Draw the episodes of rows into the tables."""
        config = self.config
        if config.target == "waypoints":
            for row, seed in zip(rows.tolist(), seeds.tolist(), strict=True):
                self._load(row, draw_episode(config, seed))
            return
        failed: list[int] = []

        def draw(first: int, last: int) -> None:
            some = slice(first, last)
            failed.append(draw_layouts(rows[some], seeds[some], self._ranges, self._fixed, self._constants, self.paths))

        self._threads.share(draw, len(rows), _LEAST_EPISODES)
        if max(failed) >= 0:
            raise no_layout(config)
        draw_gains(rows, seeds, config.actuation_gain, self._constants)
        if self._noisy:
            for row, seed in zip(rows.tolist(), seeds.tolist(), strict=True):
                self._load_noise(row, draw_noise(config, ServoStreams(seed)))
        else:
            self.latency[rows] = config.latency[0]
            self._constants["encoder_age"][rows] = config.encoder_age[0]
            self._constants["knocked_at"][rows] = NEVER

    def _load(self, row: int, episode: Episode) -> None:
        """Write an episode into the tables."""
        for name in ("links", "camera", "goal", "gain"):
            self._constants[name][row] = getattr(episode, name)
        self.paths[row] = episode.path
        self._load_noise(row, episode)

    def _load_noise(self, row: int, noise: Noise | Episode) -> None:
        self.latency[row], self.noise_levels[row] = noise.latency, noise.noise_levels
        self._constants["encoder_age"][row], self._constants["knocked_at"][row] = noise.encoder_age, noise.knocked_at
        self._constants["knocked"][row] = knocked_camera(self.cameras[row], noise.knock)
        for name in ("feature_noise", "rate_noise", "encoder_noise", "dropped", "focal_factor"):
            table = getattr(self._tables, name)
            if table.shape[1]:
                table[row] = getattr(noise, name)

    def step(self, actions: Array, rows: Mask | None = None) -> None:
        """Advance rows by one control period.

        Args:
            actions: Fractions of `max_joint_rate`, clipped to [-1, 1] joint by joint as hardware does, (N, 2).
            rows: Mask of the rows whose episode is running, (N,) bool; None for all. The other arms move too, because
                they share the physics engine, but are not counted or observed until their reset.
        """
        if rows is None:
            rows = self._all_rows
        self._before_sensing()
        arms = self.arms
        if isinstance(arms, CompiledArms):
            arms.check_started()
            step = (
                arms.blocks, arms.solver, rows, actions, self._settings, self._constants, self._tables, self.joints,
                self.history, self._samples,
            )  # fmt: skip
            self._threads.share(lambda first, last: advance(*step, first, last), len(arms.blocks))
        else:
            command(rows, actions, self._settings, self._constants, self._tables, self.joints, self._samples)
            arms.step(self._samples["rates"])
            self._sense(rows)
        self._after_sensing(rows)

    def _sense(self, rows: Mask) -> None:
        sense(rows, self._settings, self._constants, self._tables, self.joints, self.history, self._samples)

    def _before_sensing(self) -> None:
        """Keep what `_after_sensing` needs of the old sample."""

    def _after_sensing(self, rows: Mask) -> None:
        """Complete the new sample of the chosen rows."""

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.warmup + self.config.horizon

    def privileged(self) -> dict[str, Array]:
        """Additional observations for agents that see the truth, arrays of N rows.

        Returns:
            `true_jacobian` (N, 2, 3) at the current time, px/rad and px/s, without the motion of a lens that zooms;
            `true_camera` (N, CAMERA_SIZE), packed as in `servotrack.estimators.camera.pack_camera`; `true_links` (N, 2)
            m; `true_latency` (N, 1) s, the age of a frame minus the age according to its stamp; `true_readout` (N, 1)
            s, duration of the rolling shutter; `true_noise` (N, 2), standard deviations of encoders (rad) and joint
            rates (rad/s); `true_gain` (N, 2), factors on the joint rates.
        """
        # An unstamped frame has its time of arrival, half a readout after its middle row was read.
        hidden = np.where(self.config.stamped, 0.0, self.latency * PERIOD + 0.5 * self.config.rolling_shutter)
        position, velocity = self.target[:, :2], self.target[:, 2:]
        cameras = self.present_cameras()
        return {
            "true_jacobian": image_jacobian(cameras, self.links, self.joints, position, velocity),
            "true_camera": cameras,
            "true_links": self.links.copy(),
            "true_latency": hidden[:, None] + 0.0,
            "true_readout": np.full((self.count, 1), self.config.rolling_shutter),
            "true_noise": self.noise_levels.copy(),
            "true_gain": self.gain.copy(),
        }

    def present_cameras(self) -> Array:
        """Return the packed cameras as they are now, knocked and zoomed. Shape (N, CAMERA_SIZE)."""
        now, factors = self.steps + LEAD, self._tables.focal_factor
        cameras = np.where((now >= self._constants["knocked_at"])[:, None], self._constants["knocked"], self.cameras)
        return zoomed_cameras(cameras, self.goal, factors[np.arange(self.count), now]) if factors.size else cameras

    def debug_view(self, row: int = 0) -> str:
        """State of one row as text, for debugging."""
        degrees = np.degrees(self.joints[row])
        return (
            f"t={self.time[row]:+.2f} s  joints=({degrees[0]:+.1f}, {degrees[1]:+.1f}) deg  "
            f"tool={self.tool[row].round(4)} m  target={self.target[row, :2].round(4)} m  "
            f"error={1e3 * self.tracking_error[row]:.2f} mm  features={self.features[row].round(2)} px  "
            f"goal={self.goal[row].round(2)} px  visible={bool(self.visible[row])}"
        )
