"""Dynamics, sensors and scores of N servo arms, shared by the single and the vector environments."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.compiled_arms import LANES, CompiledArms
from servotrack.envs.servo.engine import ENGINES
from servotrack.envs.servo.episode import Episode, draw_episode, empty_tables
from servotrack.envs.servo.layout import draw_layouts, never_rejected, no_layout, ranges_of
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.noise import NEVER, draw_noises, noise_ranges_of
from servotrack.envs.servo.records import CONSTANTS, RING, SAMPLE, SETTINGS
from servotrack.envs.servo.sensing import EpisodeDraws, advance, advance_and_begin, begin, command, sense
from servotrack.envs.servo.targets import LEAD, PERIOD, START
from servotrack.envs.servo.threads import Threads
from servotrack.envs.state import State, entry, part, put, taken
from servotrack.estimators.camera import image_jacobian, zoomed_cameras
from servotrack.estimators.types import Array, Labels, Mask

LOST_SAMPLES = 20
"""An episode ends after this many consecutive samples with the target out of view."""
_LEAST_EPISODES = 4
"""Least number of episodes that a thread draws."""
_STEPS_PER_BEGINNING = 25.0
"""Time to draw and begin an episode, in steps of one arm."""
_HANDOVER = 70.0
"""Time to give work to another thread and to notice its end, in steps of one arm: some 65 us."""
_NO_ROWS = np.zeros(0, np.int64)
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
        self._tables = empty_tables(config, count)
        self.paths = self._tables.paths
        self.history = np.zeros((count, RING, 2))
        """True joint angles of the last samples, a ring buffer indexed by table index modulo RING, (N, RING, 2) rad."""
        self._all_rows = np.ones(count, np.bool_)
        first_sample = np.zeros(1, SAMPLE)
        first_sample["features"] = config.camera_size / 2.0
        first_sample["frame_time"] = -(LEAD + config.warmup) * PERIOD
        self._draws = EpisodeDraws(ranges_of(config), never_rejected(config), noise_ranges_of(config), first_sample)
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
        self._numbers = sample.view(np.float64).reshape(self.count, -1)

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy, without the views of the records."""
        records = self._constants, self._samples
        return {name: value for name, value in self.__dict__.items() if not any(_is_field(value, r) for r in records)}

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        """Take over the attributes of the copied world."""
        self.__dict__.update(attributes)
        self._name_fields()

    def newest(self, row: int = 0) -> Array:
        """Return a copy of a row's newest sample as numbers; `PLACES` has the place of each field.

        A single environment takes its observation from slices of it, in two thirds of the time of copies.
        """
        return self._numbers[row].copy()

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

    @property
    def _draws_compiled(self) -> bool:
        """True if compiled code draws whole episodes, path included."""
        return self._draws.ranges.kind >= 0

    def reset(self, rows: Sequence[int] | Labels, seeds: Sequence[int] | Labels) -> None:
        """Start new episodes in some rows. The other rows are not changed.

        Args:
            rows: Indices of the rows, 0 to N - 1.
            seeds: Episode seed of each of these rows, non-negative integers.
        """
        rows, seeds = np.asarray(rows, np.int64), np.asarray(seeds, np.int64)
        chosen = np.zeros(self.count, np.bool_)
        chosen[rows] = True
        if isinstance(self.arms, CompiledArms) and self._draws_compiled:
            self._threads.share(self._beginning(self.arms, rows, seeds), len(rows), _LEAST_EPISODES)
            self._note_begun(rows, seeds)
        else:
            self._begin(rows, seeds)
            self._note_begun(rows, seeds)
            self._before_sensing()
            self._sense(chosen)
        self._after_sensing(chosen)

    def _begin(self, rows: Labels, seeds: Labels) -> None:
        """Load new episodes into rows, without observing them."""
        self._draw(rows, seeds)
        self.arms.reset(rows, self.links[rows])
        self.history[rows] = START
        self._samples[rows] = self._draws.first_sample

    def _draw(self, rows: Labels, seeds: Labels) -> None:
        """Draw the episodes of rows into the tables."""
        config, draws, constants, tables = self.config, self._draws, self._constants, self._tables
        if not self._draws_compiled:
            for row, seed in zip(rows.tolist(), seeds.tolist(), strict=True):
                self._load(row, draw_episode(config, seed))
            return
        failed: list[int] = []

        def draw(first: int, last: int) -> None:
            some, own = rows[first:last], seeds[first:last]
            failed.append(draw_layouts(some, own, draws.ranges, draws.fixed, constants, tables.paths))
            draw_noises(some, own, draws.noise, constants, tables)

        self._threads.share(draw, len(rows), _LEAST_EPISODES)
        if max(failed) >= 0:
            raise no_layout(config)

    def _load(self, row: int, episode: Episode) -> None:
        """Write an episode into the tables."""
        for name in CONSTANTS.names or ():
            self._constants[name][row] = getattr(episode, name)
        self.paths[row] = episode.path
        for name, table in self._tables._asdict().items():
            if name != "paths" and table.shape[1]:
                table[row] = getattr(episode, name)

    def _note_begun(self, rows: Labels, seeds: Labels) -> None:
        self.seeds[rows] = seeds
        self.begun[rows] += 1

    def _beginning(self, arms: CompiledArms, rows: Labels, seeds: Labels) -> Callable[[int, int], None]:
        """Return the compiled reset of some of these rows, by their first index and the one after the last."""
        arms.note_started(rows)
        begun = (
            self._draws, arms.blocks, arms.solver, self._settings, self._constants, self._tables, self.joints,
            self.history, self._samples,
        )  # fmt: skip

        def work(first: int, last: int) -> None:
            if begin(rows[first:last], seeds[first:last], *begun) >= 0:
                raise no_layout(self.config)

        return work

    def step(
        self, actions: Array, rows: Mask | None = None, ended: Labels = _NO_ROWS, seeds: Labels = _NO_ROWS
    ) -> None:
        """Advance rows by one control period, and start new episodes in others.

        Args:
            actions: Fractions of `max_joint_rate`, clipped to [-1, 1] joint by joint as hardware does, (N, 2).
            rows: Mask of the rows whose episode is running, (N,) bool; None for all. The other arms move too, because
                they share the physics engine, but are not counted or observed until their reset.
            ended: Indices of the rows that begin a new episode, none of them in `rows`, ascending, (n,).
            seeds: Episode seed of each of these rows, (n,).
        """
        if rows is None:
            rows = self._all_rows
        arms = self.arms
        self._before_sensing()
        if isinstance(arms, CompiledArms):
            arms.check_started()
            step = (
                arms.blocks, arms.solver, rows, actions, self._settings, self._constants, self._tables, self.joints,
                self.history, self._samples,
            )  # fmt: skip
            if len(ended) and self._draws_compiled:
                arms.note_started(ended)

                # A thread restarts the arms of its own blocks.
                def work(first: int, last: int) -> None:
                    if advance_and_begin(ended, seeds, self._draws, step, first, last) >= 0:
                        raise no_layout(self.config)

                beginnings = np.bincount(ended // LANES, minlength=len(arms.blocks)).astype(np.float64)
                self._threads.share(
                    work, len(arms.blocks), costs=LANES + _STEPS_PER_BEGINNING * beginnings, handover=_HANDOVER
                )
                self._note_begun(ended, seeds)
                rows = rows.copy()
                rows[ended] = True
                ended = _NO_ROWS
            else:
                self._threads.share(
                    lambda first, last: advance(*step, first, last), len(arms.blocks), handover=_HANDOVER / LANES
                )
        else:
            command(rows, actions, self._settings, self._constants, self._tables, self.joints, self._samples)
            arms.step(self._samples["rates"])
            self._sense(rows)
        self._after_sensing(rows)
        if len(ended):
            self.reset(ended, seeds)

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
