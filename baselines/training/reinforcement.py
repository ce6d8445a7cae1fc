"""Reinforcement learning with Stable-Baselines3 on the native vector environments."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.training.checkpoint import CHECKPOINT, restore_random_states
from servotrack.baselines.training.curriculum import Curriculum
from servotrack.baselines.training.encoded_env import EncodedVecEnv
from servotrack.baselines.training.export import PolicyMode, exportable_policy
from servotrack.baselines.training.run import TrainingRun, TrainingTask
from servotrack.baselines.training.sb3 import StableBaselinesVecEnv
from servotrack.baselines.training.settings import schedule

ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "nn.ReLU": nn.ReLU,
    "nn.Tanh": nn.Tanh,
    "nn.ELU": nn.ELU,
    "nn.SiLU": nn.SiLU,
}


_COUNTERS = ("_n_updates", "_episode_num")
"""Counters of an algorithm; some update a target network or a policy only every n-th time."""


def reinforce(run: TrainingRun) -> None:
    """Train by reinforcement learning from the newest checkpoint to the next.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: Hyper-parameters that the algorithm does not take.
    """
    task = run.task
    model = create_model(task, run.curve.steps)
    try:
        if run.checkpoint is not None:
            restore(model, run.checkpoint, task.folder)
        with contextlib.suppress(_Due):
            model.learn(
                task.settings.n_timesteps - model.num_timesteps,
                _UntilDue(run),
                log_interval=10,
                tb_log_name="run",
                reset_num_timesteps=False,
            )
        run.on_steps(model.num_timesteps)
        _measure(run, model)
    finally:
        model.get_env().close()  # type: ignore[union-attr]


def create_model(task: TrainingTask, steps: int = 0) -> BaseAlgorithm:
    """Create the algorithm with its environments, before the first step.

    Args:
        task: Environment, settings and seed of the run.
        steps: Environment steps done before an interruption; the environments' seeds continue from there.
    """
    settings = task.settings
    torch.set_num_threads(1)
    env: Any = _environments(task, steps)
    if settings.normalize:
        env = VecNormalize(env, gamma=float(settings.hyper_parameters.get("gamma", 0.99)))
    keywords = {name: schedule(value) if name in ("learning_rate", "clip_range") else value
                for name, value in settings.hyper_parameters.items()}  # fmt: skip
    if "policy_kwargs" in keywords:
        keywords["policy_kwargs"] = _with_classes(keywords["policy_kwargs"])
    try:
        model: BaseAlgorithm = _algorithm(settings.algorithm)(
            settings.policy,
            env,
            seed=task.seed,
            device="cpu",
            verbose=0,
            tensorboard_log=str(task.folder / "tensorboard") if task.tensorboard else None,
            **keywords,
        )
    except TypeError as error:
        env.close()
        raise ValueError(f"{settings.algorithm} does not take these hyper-parameters: {error}") from error
    if not task.tensorboard:
        # Without a logger the algorithm would create an empty folder among the temporary files.
        model.set_logger(Logger(None, []))
    # After the algorithm, which overwrites the environments' seeds with its own: runs would share most episodes.
    env.seed(_first_seed(task, steps))
    return model


def _environments(task: TrainingTask, steps: int) -> Any:
    """Create encoded environments; with a curriculum, those of its stages."""
    settings = task.settings

    def make(level: int | None, count: int) -> EncodedVecEnv:
        arguments = task.env_kwargs if level is None else {**task.env_kwargs, "level": level}
        venv = gym.make_vec(
            task.env_id,
            num_envs=count,
            vectorization_mode="vector_entry_point",
            autoreset_mode=AutoresetMode.SAME_STEP,
            **arguments,
        )
        return EncodedVecEnv(StableBaselinesVecEnv(venv, info_keys=()), create_encoding(settings.encoding, venv))

    if not settings.curriculum:
        return make(None, settings.n_envs)
    stage_steps = -(-settings.n_timesteps // len(settings.curriculum))
    return Curriculum(
        make, settings.curriculum, settings.n_envs, stage_steps, lambda done: _first_seed(task, done), steps
    )


def _first_seed(task: TrainingTask, steps: int) -> int:
    """Return the first seed of the environments in the train range; it depends on the steps done."""
    room = len(seed_ranges.TRAIN) - task.settings.n_envs
    return seed_ranges.TRAIN.start + (7919 * task.seed + steps) % room


def _algorithm(name: str) -> Any:
    if name in ("recurrent_ppo", "tqc"):
        import sb3_contrib

        return {"recurrent_ppo": sb3_contrib.RecurrentPPO, "tqc": sb3_contrib.TQC}[name]
    return {"ppo": PPO, "a2c": A2C, "sac": SAC, "td3": TD3}[name]


def _with_classes(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the activation's name, as in rl-zoo3's files, by its class."""
    named = dict(policy_kwargs)
    name = named.get("activation_fn")
    if name is not None:
        if name not in ACTIVATIONS:
            raise ValueError(f"activation_fn must be one of {', '.join(ACTIVATIONS)}, got {name!r}")
        named["activation_fn"] = ACTIVATIONS[name]
    return named


def restore(model: BaseAlgorithm, checkpoint: Mapping[str, Any], folder: Path) -> None:
    """Restore everything that `_content` saved, and the random states.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
    """
    try:
        model.set_parameters(checkpoint["parameters"])
        for name, value in checkpoint["variables"].items():
            recursive_getattr(model, name).data = value
        for name, number in checkpoint["counters"].items():
            setattr(model, name, number)
        for name, statistics in _running(model).items():
            statistics.mean, statistics.var, statistics.count = (np.asarray(part) for part in checkpoint[name])
        if "replay" in checkpoint:
            _restore_replay(model, checkpoint["replay"])
        model.action_space.np_random.bit_generator.state = checkpoint["actions"]
        restore_random_states(checkpoint["random"])
    except Exception as error:
        raise ResultsError(
            f"{folder / CHECKPOINT} does not fit this training ({error}); move its folder away to start again"
        ) from error
    model.num_timesteps = int(checkpoint["steps"])


def _content(model: BaseAlgorithm) -> dict[str, Any]:
    """Return everything that the next segment depends on, besides steps and random states."""
    _, variables = model._get_torch_save_params()
    saved: dict[str, Any] = {
        "parameters": model.get_parameters(),
        # Outside the parameters: the entropy coefficient of SAC.
        "variables": {name: recursive_getattr(model, name) for name in variables},
        "counters": {name: int(getattr(model, name)) for name in _COUNTERS if hasattr(model, name)},
        "actions": model.action_space.np_random.bit_generator.state,
    }
    for name, statistics in _running(model).items():
        saved[name] = tuple(np.asarray(part) for part in (statistics.mean, statistics.var, statistics.count))
    replay = getattr(model, "replay_buffer", None)
    if replay is not None:
        filled = replay.size()
        arrays = {name: array[:filled] for name, array in _replay_arrays(replay).items()}
        saved["replay"] = {"arrays": arrays, "position": int(replay.pos), "full": bool(replay.full)}
    return saved


def _replay_arrays(replay: Any) -> dict[str, Any]:
    return {
        name: array
        for name, array in vars(replay).items()
        if isinstance(array, np.ndarray) and array.shape[:1] == (replay.buffer_size,)
    }


def _restore_replay(model: Any, saved: Mapping[str, Any]) -> None:
    replay = model.replay_buffer
    for name, array in _replay_arrays(replay).items():
        array[: len(saved["arrays"][name])] = saved["arrays"][name]
    replay.pos, replay.full = saved["position"], saved["full"]


def _running(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the running means of an algorithm whose environment is normalized."""
    normalizer = model.get_vec_normalize_env()
    return {} if normalizer is None else {"observations": normalizer.obs_rms, "returns": normalizer.ret_rms}


def policy_mode(model: BaseAlgorithm) -> PolicyMode:
    """Return the policy as it is exported."""
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return PolicyMode(model.policy)
    running: Any = normalizer.obs_rms
    return PolicyMode(model.policy, running.mean, np.sqrt(running.var + normalizer.epsilon), normalizer.clip_obs)


class _Due(Exception):
    """Ends a segment between two rollouts."""


class _UntilDue(BaseCallback):
    """Raises `_Due` between two rollouts when an evaluation is due and most episodes have just begun.

    The next segment begins new episodes. Cut off in the middle, the learner would see more beginnings than ends: it
    waits up to half an interval for environments whose episodes end together.
    """

    def __init__(self, run: TrainingRun) -> None:
        super().__init__()
        self.run = run
        self._ages: NDArray[np.int64] = np.zeros(0, np.int64)
        self._longest = 0
        self._rollout_start = 0

    def _on_training_start(self) -> None:
        self._ages = np.zeros(self.training_env.num_envs, np.int64)
        self._rollout_start = self.num_timesteps

    def _on_step(self) -> bool:
        self._ages += 1
        ended = np.asarray(self.locals["dones"], dtype=bool)
        self._longest = max(self._longest, int(self._ages[ended].max(initial=0)))
        self._ages[ended] = 0
        return True

    def _on_rollout_start(self) -> None:
        self.run.on_steps(self.num_timesteps)
        envs = len(self._ages)
        rollout = (self.num_timesteps - self._rollout_start) / envs
        self._rollout_start = self.num_timesteps
        overdue = self.run.overdue(self.num_timesteps)
        patience = min(self._longest * envs, self.run.interval // 2)
        if overdue >= 0 and (self._ages.mean() < rollout or overdue >= patience):
            raise _Due


def _measure(run: TrainingRun, model: BaseAlgorithm) -> None:
    """Evaluate and save the policy."""
    policy = policy_mode(model)
    size = int(model.observation_space.shape[0])  # type: ignore[index]
    entry = run.measure(model.num_timesteps, exportable_policy(policy, size, policy.memory), _content(model))
    for name, value in entry.items():
        model.logger.record(f"tune/{name}", value)
    model.logger.dump(model.num_timesteps)
