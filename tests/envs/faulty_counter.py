"""A small single and vector environment, with a switch for every fault that the checkers must find."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

OBSERVATIONS = gym.spaces.Box(0.0, 100.0, (2,), np.float64)
ACTIONS = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
GOAL = 6.0

SHARED_NOISE = np.random.default_rng(0)


class Counter(gym.Env[Any, Any]):
    """Counts up from a random start by random steps until it reaches the goal."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    observation_space, action_space = OBSERVATIONS, ACTIONS
    state = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(0.0, 3.0), 0.0])
        return self.state.copy(), self.info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.state = advance(self.state, action, self.np_random.uniform(0.5, 1.0))
        return self.state.copy(), float(self.state[0]), bool(self.state[0] >= GOAL), False, self.info()

    def info(self) -> dict[str, Any]:
        return {"height": float(self.state[0]), "truth": {"state": self.state.copy()}}


def advance(state: Any, action: Any, push: float) -> Any:
    return np.array([state[0] + push + 0.1 * float(action[0]), state[1] + 1.0])


class CounterVectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """N counters with the named fault, or None."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        num_envs: int,
        autoreset_mode: AutoresetMode,
        fault: str | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        self.num_envs, self.mode, self.fault, self.render_mode = num_envs, autoreset_mode, fault, render_mode
        if fault == "changes the metadata of its class":
            type(self).metadata["made"] = self
        declared = AutoresetMode.DISABLED if fault == "declares another mode" else autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": declared}
        self.single_observation_space, self.single_action_space = OBSERVATIONS, ACTIONS
        self.observation_space = batch_space(OBSERVATIONS, num_envs + (fault == "batches the wrong number"))
        self.action_space = batch_space(ACTIONS, num_envs)
        self.generators: list[np.random.Generator] = []
        self.state, self.over = np.zeros((num_envs, 2)), np.zeros(num_envs, np.bool_)
        self.started = fault == "steps before the reset"
        if self.started:
            self.generators = [seeding.np_random(row)[0] for row in range(num_envs)]

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._seed(seed)
        chosen = self._chosen(options)
        for row in np.flatnonzero(chosen):
            self._restart(row)
        if self.fault == "a mask disturbs the neighbors" and not chosen.all():
            for generator in self.generators:
                generator.random()
        self.started = True
        included = np.ones_like(chosen) if self.fault == "infos of all after a mask" else chosen
        return self._observations(), self._infos(included)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        assert self.started, "call reset() first"
        waiting = self.over & (self.mode == AutoresetMode.NEXT_STEP)
        rewards = np.zeros(self.num_envs)
        for row in range(self.num_envs):
            if waiting[row]:
                self._restart(row)
                if self.fault == "rewards the reset":
                    rewards[row] = 1.0
                if self.fault == "obeys the ignored action":
                    self.state[row] = advance(self.state[row], actions[row], 0.0)
            else:
                push = self.generators[row].uniform(0.5, 1.0)
                if self.fault == "draws from a shared source":
                    push += SHARED_NOISE.random() * 1e-3
                self.state[row] = advance(self.state[row], actions[row], push)
                rewards[row] = self.state[row, 0]
        if self.fault == "differs in the last bit":
            self.state[:, 0] = np.nextafter(self.state[:, 0], 200.0)
        if self.fault == "writes into the actions":
            actions[...] = 0.0
        terminated = (self.state[:, 0] >= GOAL) & ~waiting
        if self.fault == "never ends":
            terminated[:] = False
            self.state[:, 0] = np.minimum(self.state[:, 0], 50.0)
        self.over = terminated.copy()
        infos = self._infos(np.ones(self.num_envs, np.bool_))
        if self.mode == AutoresetMode.SAME_STEP and terminated.any():
            infos = self._restart_at_once(terminated)
        if self.fault == "rewards as a list":
            return self._observations(), rewards.tolist(), terminated, np.zeros_like(terminated), infos
        if self.fault == "rewards in single precision":
            rewards = rewards.astype(np.float32)
        return self._observations(), rewards, terminated, np.zeros_like(terminated), infos

    def render(self) -> Any:
        if self.fault == "rendering draws random numbers":
            self.generators[0].random()
        count = self.num_envs - (self.fault == "a frame too few")
        dtype = np.float64 if self.fault == "frames of floats" else np.uint8
        frames = tuple(np.full((4, 5, 3), int(self.state[row, 0]), dtype) for row in range(count))
        if self.fault == "frames change without a step":
            frames[0][...] += SHARED_NOISE.integers(0, 200, frames[0].shape, dtype=np.uint8)
        return frames

    def _restart_at_once(self, ended: Any) -> dict[str, Any]:
        finals = np.full(self.num_envs, None, dtype=object)
        final_infos = self._infos(ended)
        rows = np.flatnonzero(ended)
        if self.fault != "final_obs of the next episode":
            for row in rows:
                finals[row] = self.state[row].copy()
        for row in rows:
            self._restart(row)
            if self.fault == "final_obs of the next episode":
                finals[row] = self.state[row].copy()
        infos = self._infos(np.ones(self.num_envs, np.bool_))
        if self.fault == "no final_obs":
            return infos
        mask = np.ones_like(ended) if self.fault == "final mask for all" else ended.copy()
        return infos | {"final_obs": finals, "_final_obs": mask, "final_info": final_infos, "_final_info": ended.copy()}

    def _restart(self, row: int) -> None:
        self.state[row] = [self.generators[row].uniform(0.0, 3.0), 0.0]
        self.over[row] = False

    def _seed(self, seed: Any) -> None:
        if seed is None:
            seeds = [None] * self.num_envs
        elif isinstance(seed, int):
            seeds = [seed + (0 if self.fault == "one seed for all" else row) for row in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs and self.fault != "accepts any number of seeds":
            raise ValueError(f"seed must have length {self.num_envs}, got {len(seeds)}")
        if not self.generators:
            self.generators = [seeding.np_random(None)[0] for _ in range(self.num_envs)]
        for row, own in zip(range(self.num_envs), seeds, strict=False):
            if self.fault == "None in a list seeds anew" and own is None and seed is not None:
                own = 0
            if self.fault == "ignores a list of seeds" and not isinstance(seed, int):
                own = None
            if own is not None:
                self.generators[row] = seeding.np_random(own)[0]

    def _chosen(self, options: dict[str, Any] | None) -> Any:
        if not options:
            return np.ones(self.num_envs, np.bool_)
        mask = options["reset_mask"]
        if not np.any(mask) and self.fault != "accepts an empty mask":
            raise ValueError("reset_mask must be true somewhere")
        if (mask.shape != (self.num_envs,) or mask.dtype != np.bool_) and self.fault != "accepts any mask":
            raise ValueError(f"reset_mask must be boolean of shape ({self.num_envs},), got {mask}")
        chosen = np.resize(mask, self.num_envs).astype(np.bool_)
        if self.fault == "pops the mask":
            options.pop("reset_mask")
        if self.fault == "writes into the mask":
            mask[:] = True
        return np.ones_like(chosen) if self.fault == "a mask resets all" else chosen

    def _observations(self) -> Any:
        if self.fault == "returns its own state":
            return self.state
        if self.fault == "observations out of bounds":
            return self.state - 10.0
        if self.fault == "observations in single precision":
            return self.state.astype(np.float32)
        return self.state.copy()

    def _infos(self, chosen: Any) -> dict[str, Any]:
        height = np.where(chosen, self.state[:, 0], 0.0)
        state = np.where(chosen[:, None], self.state, 0.0)
        if self.fault == "infos where the mask is False":
            height = self.state[:, 0] + 1.0
        if self.fault == "infos without a leading axis":
            height = float(height[0])
        truth = {"state": state, "_state": chosen.copy()}
        infos: dict[str, Any] = {"height": height, "_height": chosen.copy(), "truth": truth, "_truth": chosen.copy()}
        if self.fault == "infos without a mask":
            del infos["_height"]
        if self.fault == "infos lack a key":
            del infos["truth"], infos["_truth"]
        if self.fault == "infos gain a key after the reset" and (self.state[:, 1] > 0.0).all():
            infos |= {"score": height, "_score": chosen.copy()}
        if self.fault == "infos change their type" and (self.state[:, 1] > 0.0).all():
            truth["state"] = state.astype(np.float32)
        if self.fault == "returns its own info mask":
            infos["_height"] = self.over
        return infos
