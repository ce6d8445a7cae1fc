"""N arm servos in one pymunk Space as a Gymnasium vector environment, bit for bit the single one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from servotrack.envs.servo.env import (
    METADATA,
    Observation,
    action_space,
    check_options,
    check_render_mode,
    check_seed,
    feature_observations,
    feature_space,
)
from servotrack.envs.servo.levels import ServoConfig, reach_config, servo_config
from servotrack.envs.servo.world import SUCCESS_DISTANCE, ServoWorld, check_actions, episode_seed

if TYPE_CHECKING:
    from servotrack.envs.servo.recorder import Recorder

Mask = NDArray[np.bool_]


class UncalibServoVectorEnv(gym.vector.VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """`UncalibServo-v0`, N at a time: what `gym.make_vec("UncalibServo-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of arms N.
        level: As in `UncalibServoEnv`.
        render_mode: None or `rgb_array`; frames of all N come as a tuple.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Shortens the horizon, as `gym.make`'s argument of that name does.
        **axes: As in `UncalibServoEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 3,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **axes: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise ValueError(f"num_envs must be a whole number of at least 1, got {num_envs!r}")
        self.config = self._configure(level, axes)
        self.level = level
        self.num_envs = int(num_envs)
        self.render_mode = check_render_mode(render_mode)
        if render_mode == "human":
            raise ValueError("render_mode='human' shows one arm; use gym.make, or render_mode='rgb_array' here")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = METADATA | {"autoreset_mode": self.autoreset_mode}  # type: ignore[misc]
        self._step_limit = _step_limit(max_episode_steps)
        self.world = ServoWorld(self.config, self.num_envs)
        self.single_action_space = action_space()
        self.single_observation_space = self._single_observation_space()
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.max_joint_rate = self.config.max_joint_rate
        self._generators: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._over = np.ones(self.num_envs, np.bool_)
        self._started = False
        self._recorders = self._record_rows() if self.render_mode is not None else []

    def _configure(self, level: int, axes: dict[str, Any]) -> ServoConfig:
        return servo_config(level, **axes)

    def _single_observation_space(self) -> gym.spaces.Dict:
        return feature_space(self.config)

    def _observe(self) -> Observation:
        return feature_observations(self.world)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """One generator for each sub-environment."""
        self._generate([None] * self.num_envs)
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each sub-environment's generator."""
        self._generate([None] * self.num_envs)
        return tuple(self._seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes, in all sub-environments or in those of a mask.

        Args:
            seed: An int s seeds the i-th with s + i; a sequence gives one seed each, None keeping that generator.
            options: `reset_mask`, shape (N,) bool: which sub-environments to reset. Not mutated.

        Returns:
            Observations of all sub-environments, and infos of those that were reset.

        Raises:
            ValueError: A seed list or mask of another length, an empty mask, or unknown options.
            TypeError: A mask that is not a boolean array.
        """
        seeds = self._seed_list(seed)
        chosen = self._reset_mask(options)
        if not self._started and not chosen.all():
            raise ResetNeeded("the first reset has to start all sub-environments: leave out options['reset_mask']")
        self._generate([s if m else None for s, m in zip(seeds, chosen.tolist(), strict=True)])
        self._restart(chosen)
        self._started = True
        observations = self._observe()
        self._record()
        return observations, self._infos(chosen)

    def step(self, actions: Any) -> tuple[Observation, NDArray[np.float64], Mask, Mask, dict[str, Any]]:
        """Command joint rates of all arms for one control period.

        Args:
            actions: Shape (N, 2), fractions of `max_joint_rate`.

        Returns:
            Observations, rewards, terminations, truncations, infos. What happens at an episode's end is the autoreset
            mode's.

        Raises:
            ValueError: Actions of another shape, or not finite.
            gymnasium.error.ResetNeeded: Before the first reset; in mode DISABLED also while an ended episode waits
            for its reset.
        """
        values = check_actions(actions, (self.num_envs, 2))
        if not self._started:
            raise ResetNeeded("call reset() before the first step")
        waiting = self._over
        if self.autoreset_mode == AutoresetMode.DISABLED and waiting.any():
            raise ResetNeeded(
                f"sub-environments {np.flatnonzero(waiting).tolist()} have ended: reset them with "
                "options={'reset_mask': mask}, or use another autoreset_mode"
            )
        world = self.world
        world.step(values, ~waiting)
        terminated, truncated = world.terminated.copy(), world.truncated.copy()
        if self._step_limit is not None:
            truncated |= world.steps >= self._step_limit
        rewards = world.reward.copy()
        everyone = np.ones(self.num_envs, np.bool_)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and waiting.any():
            self._restart(waiting)
            rewards[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
        ended = terminated | truncated
        self._over = ended
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            final_observations, final_infos = self._observe(), self._infos(ended)
            self._restart(ended)
            infos = self._infos(everyone)
            infos |= self._final(ended, final_observations, final_infos)
        else:
            infos = self._infos(everyone)
        observations = self._observe()
        self._record()
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """Draw all sub-environments: N new RGB frames, each (416, 720, 3) uint8, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn('render() draws nothing without a render mode; try render_mode="rgb_array"')
            return None
        if not self._started:
            raise ResetNeeded("there is nothing to draw yet: call reset() before render()")
        return tuple(recorder.frame(**self._pictured(row)) for row, recorder in enumerate(self._recorders))

    def _pictured(self, row: int) -> dict[str, Any]:
        """What `Recorder.frame` should show of a row besides the world itself."""
        return {}

    def _record_rows(self) -> list[Recorder]:
        from servotrack.envs.servo.recorder import Recorder, level_caption

        return [Recorder(self.world, row, level_caption(self.level)) for row in range(self.num_envs)]

    def _record(self) -> None:
        for recorder in self._recorders:
            recorder.record()

    def _restart(self, chosen: Mask) -> None:
        rows = np.flatnonzero(chosen).tolist()
        self.world.reset(rows, [episode_seed(self._generators[row]) for row in rows])
        self._over = self._over & ~chosen

    def _final(self, ended: Mask, observations: Observation, infos: dict[str, Any]) -> dict[str, Any]:
        rows = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            rows[row] = {key: value[row].copy() for key, value in observations.items()}
        return {"final_obs": rows, "_final_obs": ended.copy(), "final_info": infos, "_final_info": ended.copy()}

    def _infos(self, chosen: Mask) -> dict[str, Any]:
        """Infos as Gymnasium's own vector environments lay them out: a mask beside every array, zeros where false."""
        world = self.world

        def masked(values: dict[str, Any]) -> dict[str, Any]:
            out: dict[str, Any] = {}
            for key, value in values.items():
                if isinstance(value, dict):
                    out[key] = masked(value)
                else:
                    # A copy, and nothing of the rows that were not asked for.
                    out[key] = np.where(chosen.reshape(-1, *[1] * (value.ndim - 1)), value, np.zeros((), value.dtype))
                out[f"_{key}"] = chosen.copy()
            return out

        return masked(
            {
                "tracking_error": world.tracking_error,
                "feature_error": world.feature_error,
                "success": world.tracking_error < SUCCESS_DISTANCE,
                "truth": {
                    "joint_angles": world.joints,
                    "tool": world.tool,
                    "target": world.target[:, :2],
                    "target_velocity": world.target[:, 2:],
                },
            }
        )

    def privileged(self) -> Observation:
        """What `VectorPrivilegedObservation` adds to the observations; see `ServoWorld.privileged`."""
        return self.world.privileged()

    def _generate(self, seeds: Sequence[int | None]) -> None:
        """Make or replace the generators that have a seed, and those that do not exist yet."""
        fresh = not self._generators
        for row, seed in enumerate(seeds):
            if fresh or seed is not None:
                generator, used = seeding.np_random(seed)
                if fresh:
                    self._generators.append(generator)
                    self._seeds.append(used)
                else:
                    self._generators[row], self._seeds[row] = generator, used

    def _seed_list(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, (list, tuple, np.ndarray)):
            first = check_seed(seed)
            assert first is not None
            return [first + row for row in range(self.num_envs)]
        seeds = [check_seed(s) for s in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed must be an int or a list of {self.num_envs}, one for each sub-environment, got {len(seeds)}"
            )
        return seeds

    def _reset_mask(self, options: dict[str, Any] | None) -> Mask:
        if options is None or "reset_mask" not in options:
            check_options(options)
            return np.ones(self.num_envs, np.bool_)
        check_options({key: value for key, value in options.items() if key != "reset_mask"})
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, got {mask!r}")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"options['reset_mask'] must have shape ({self.num_envs},), got {mask.shape}")
        if not mask.any():
            raise ValueError("options['reset_mask'] must be true for at least one sub-environment")
        return mask.copy()


class UncalibServoReachVectorEnv(UncalibServoVectorEnv):
    """`UncalibServoReach-v0`, N at a time."""

    def _configure(self, level: int, axes: dict[str, Any]) -> ServoConfig:
        return reach_config(level, **axes)


def _step_limit(max_episode_steps: int | None) -> int | None:
    if max_episode_steps is not None and max_episode_steps < 1:
        raise ValueError(f"max_episode_steps must be None or at least 1, got {max_episode_steps!r}")
    return max_episode_steps
