"""Adapter from a Gymnasium vector environment to a Stable-Baselines3 `VecEnv`, without single environments between.

Stable-Baselines3 is an optional dependency: importing this module without it raises ImportError.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from servotrack.estimators.types import FloatArray, Mask

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError("Stable-Baselines3 is not installed; run `pip install servotrack[rl]`") from error

Indices = None | int | Iterable[int]


class StableBaselinesVecEnv(VecEnv):
    """Adapter: one call of the vector environment per step, infos split into one dictionary per row.

    Args:
        env: A Gymnasium id, from which a vector environment in the needed mode is made; or a vector environment in
            autoreset mode SAME_STEP, as Stable-Baselines3 resets: an episode's last observation is in
            `infos[i]["terminal_observation"]`.
        num_envs: Number of environments side by side, for an id. More use the processor better.
        info_keys: Names of the infos to pass on, all by default. Splitting them into one dictionary per row costs
            time, so leave out unused ones.
        **env_kwargs: Arguments of the environment, for an id.

    Raises:
        ValueError: Another autoreset mode, or `num_envs` or arguments beside a finished vector environment.
    """

    def __init__(
        self,
        env: str | gym.vector.VectorEnv[Any, Any, Any],
        num_envs: int = 1,
        info_keys: Collection[str] | None = None,
        **env_kwargs: Any,
    ) -> None:
        if isinstance(env, str):
            env = _make_same_step(env, num_envs, env_kwargs)
        elif num_envs != 1 or env_kwargs:
            raise ValueError(
                f"num_envs and arguments of the environment go with an id, got num_envs={num_envs}, {env_kwargs} "
                "beside a vector environment; give them to gym.make_vec"
            )
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                f"autoreset_mode must be SAME_STEP for Stable-Baselines3, got {mode}; give the id instead of the "
                "vector environment, or make the environment with "
                "gym.make_vec(..., autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP)"
            )
        self.env = env
        self._info_keys = None if info_keys is None else frozenset(info_keys)
        self._actions: NDArray[Any] | None = None
        self.render_mode = env.render_mode
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Reset all rows, with the seeds and options given before, and return their observations."""
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        # Options belong to single environments in Stable-Baselines3; a vector environment takes one set for all.
        options = self._options[0] if self._options and any(self._options) else None
        if options is not None and any(other != options for other in self._options):
            raise ValueError(f"options must be the same for all rows, got {self._options}")
        observation, info = self.env.reset(seed=seeds, options=options)
        self.reset_infos = self._split(self._wanted(info))
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions until `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, FloatArray, Mask, list[dict[str, Any]]]:
        """Step all rows.

        Returns:
            Observations, rewards, dones and one info per row, which holds `TimeLimit.truncated` and, at an episode's
            end, `terminal_observation`.
        """
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = np.asarray(terminated) | np.asarray(truncated)
        final_observations = info.pop("final_obs", None)
        final_info = info.pop("final_info", None)
        infos = self._split(self._wanted(info))
        # Most steps end no episode; only rows that ended need more work.
        for row in np.flatnonzero(done):
            if final_info is not None:
                infos[row] = _row_of(self._wanted(final_info), int(row))
            infos[row]["terminal_observation"] = final_observations[row]
        for row_info, was_truncated in zip(infos, (truncated & ~np.asarray(terminated)).tolist(), strict=True):
            row_info["TimeLimit.truncated"] = was_truncated
        return observation, np.asarray(reward, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return one frame per row."""
        frames: Any = self.env.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the vector environment, the same for all rows."""
        value = getattr(self.env, attr_name) if hasattr(self.env, attr_name) else getattr(self.env.unwrapped, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the vector environment; only for all rows at once.

        Raises:
            ValueError: `indices` leaves rows out.
        """
        self._refuse_part("set_attr", indices)
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment once and return its result for every row.

        Raises:
            ValueError: `indices` leaves rows out.
        """
        self._refuse_part("env_method", indices)
        result = getattr(self.env.unwrapped, method_name)(*method_args, **method_kwargs)
        return [result for _ in range(self.num_envs)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:  # type: ignore[type-arg]
        """Return False for every row: a native vector environment has no single-environment wrappers."""
        return [False for _ in self._get_indices(indices)]

    def _refuse_part(self, name: str, indices: Indices) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"{name} reaches all {self.num_envs} rows at once, got indices={indices!r}; leave indices out"
            )

    def _wanted(self, info: Mapping[str, Any]) -> Mapping[str, Any]:
        if self._info_keys is None:
            return info
        return {key: value for key, value in info.items() if key.removeprefix("_") in self._info_keys}

    def _split(self, info: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Split a dictionary of arrays with masks into one dictionary per row."""
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for key, values in info.items():
            if key.startswith("_"):
                continue
            mask = np.asarray(info.get(f"_{key}", True))
            complete = bool(mask.all())
            if isinstance(values, Mapping):
                for row, part in enumerate(self._split(values)):
                    if complete or mask[row]:
                        rows[row][key] = part
                continue
            # Iterating lists of Python numbers is several times faster than arrays.
            listed = values.tolist() if isinstance(values, np.ndarray) and values.ndim == 1 else values
            for row in range(self.num_envs) if complete else np.flatnonzero(mask).tolist():
                rows[row][key] = listed[row]
        return rows


def _make_same_step(env_id: str, num_envs: int, env_kwargs: Mapping[str, Any]) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make a vector environment in autoreset mode SAME_STEP; other packages' ids run one by one."""
    if str(gym.spec(env_id).vector_entry_point).startswith("servotrack."):
        return gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **env_kwargs)
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="sync", vector_kwargs=mode, **env_kwargs)


def _row_of(info: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return one row of a dictionary of arrays with masks."""
    chosen: dict[str, Any] = {}
    for key, values in info.items():
        if (
            key.startswith("_")
            or not np.asarray(info.get(f"_{key}", True)).reshape(-1)[row if f"_{key}" in info else 0]
        ):
            continue
        chosen[key] = _row_of(values, row) if isinstance(values, Mapping) else values[row]
    return chosen
