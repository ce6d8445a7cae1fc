"""Training with Stable-Baselines3 on the vector environments, measured as it goes, resumed after a kill."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from servotrack.baselines import seeds as seed_ranges
from servotrack.baselines.learned.card import LearnedCard
from servotrack.baselines.learned.encoded_env import EncodedVecEnv
from servotrack.baselines.learned.encoding import create_encoding
from servotrack.baselines.learned.export import PolicyMode, write_agent
from servotrack.baselines.learned.settings import TrainingSettings, schedule
from servotrack.baselines.learned.shipped import agent_in_file
from servotrack.baselines.learned.yardstick import Yardstick
from servotrack.baselines.protocol import AgentCard
from servotrack.baselines.results import ResultsError, atomic_path, describe_environment, plain, provenance
from servotrack.baselines.sb3 import StableBaselinesVecEnv

MEASUREMENTS = 20
"""In the course of a run; the policy is saved as often."""
AGENT, CHECKPOINT, TASK = "agent", "checkpoint.pt", "task.json"
ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "nn.ReLU": nn.ReLU,
    "nn.Tanh": nn.Tanh,
    "nn.ELU": nn.ELU,
    "nn.SiLU": nn.SiLU,
}

Entry = dict[str, Any]


@dataclass(frozen=True)
class TrainingTask:
    """One run of a training.

    Attributes:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        settings: Hyper-parameters.
        seed: Of weights, exploration and the environments, which take their seeds from the train range.
        folder: Where everything of the run lies.
        tensorboard: Whether to write TensorBoard's events beside it.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    settings: TrainingSettings
    seed: int
    folder: Path
    tensorboard: bool = True

    def as_record(self) -> dict[str, Any]:
        """What decides the run's course."""
        return {
            "env_id": self.env_id,
            "env_kwargs": plain(self.env_kwargs),
            "settings": self.settings.as_record(),
            "seed": self.seed,
        }


@dataclass
class TrainingCurve:
    """What a run reached on tune seeds, and when.

    Attributes:
        entries: One per measurement: `steps`, `seconds` of training without the measurements, and what `Yardstick`
            measures.
        provenance: Versions, machine, command, creation time (UTC).
        interruptions: How often the run was resumed.
    """

    entries: list[Entry] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=provenance)
    interruptions: int = 0

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.entries[-1]["steps"]) if self.entries else 0


def train(
    task: TrainingTask,
    yardstick: Yardstick,
    on_steps: Callable[[int], None] = lambda steps: None,
    on_entry: Callable[[Entry], None] = lambda entry: None,
) -> TrainingCurve:
    """Train one agent, or finish a training that was interrupted.

    The newest policy lies in the task's folder as `agent.onnx` with its card, always one that works.

    Args:
        task: What to do.
        yardstick: Measures the policy as it goes.
        on_steps: Called with the environment steps so far.
        on_entry: Called with every measurement.

    Raises:
        ResultsError: The folder holds another training or cannot be written.
        ValueError: Hyper-parameters that the algorithm does not take.
    """
    _claim(task)
    checkpoint, total = _load_checkpoint(task.folder), task.settings.n_timesteps
    curve = TrainingCurve()
    if checkpoint is not None:
        curve = TrainingCurve(**json.loads(checkpoint["curve"]))
        curve.interruptions += curve.steps < total
    for entry in curve.entries:
        on_entry(entry)
    if curve.steps >= total:
        on_steps(curve.steps)
        return curve
    model = create_model(task, curve.steps)
    if checkpoint is not None:
        _restore(model, checkpoint, task.folder)
    callback = _Course(task, curve, yardstick, on_steps, on_entry)
    try:
        model.learn(
            total - model.num_timesteps, callback, log_interval=10, tb_log_name="run", reset_num_timesteps=False
        )
        callback.conclude()
    finally:
        model.get_env().close()  # type: ignore[union-attr]
    return curve


def create_model(task: TrainingTask, steps: int = 0) -> BaseAlgorithm:
    """The algorithm with its environments, before the first step.

    Args:
        task: What to do.
        steps: Done before an interruption; the environments' seeds go on from there.
    """
    settings = task.settings
    torch.set_num_threads(1)
    venv = gym.make_vec(
        task.env_id,
        num_envs=settings.n_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
        **task.env_kwargs,
    )
    encoding = create_encoding(settings.encoding, venv)
    env: Any = EncodedVecEnv(StableBaselinesVecEnv(venv, info_keys=()), encoding)
    if settings.normalize:
        env = VecNormalize(env, gamma=float(settings.hyper_parameters.get("gamma", 0.99)))
    env.seed(_first_seed(task, steps))
    keywords = {name: schedule(value) if name in ("learning_rate", "clip_range") else value
                for name, value in settings.hyper_parameters.items()}  # fmt: skip
    if "policy_kwargs" in keywords:
        keywords["policy_kwargs"] = _with_classes(keywords["policy_kwargs"])
    try:
        return _algorithm(settings.algorithm)(
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


def _first_seed(task: TrainingTask, steps: int) -> int:
    """Where in the train range the environments' seeds begin; other ones after an interruption."""
    room = len(seed_ranges.TRAIN) - task.settings.n_envs
    return seed_ranges.TRAIN.start + (7919 * task.seed + steps) % room


def _algorithm(name: str) -> Any:
    if name in ("recurrent_ppo", "tqc"):
        import sb3_contrib

        return {"recurrent_ppo": sb3_contrib.RecurrentPPO, "tqc": sb3_contrib.TQC}[name]
    return {"ppo": PPO, "a2c": A2C, "sac": SAC, "td3": TD3}[name]


def _with_classes(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Activations by their names in rl-zoo3's files."""
    named = dict(policy_kwargs)
    name = named.get("activation_fn")
    if name is not None:
        if name not in ACTIVATIONS:
            raise ValueError(f"activation_fn must be one of {', '.join(ACTIVATIONS)}, got {name!r}")
        named["activation_fn"] = ACTIVATIONS[name]
    return named


def _claim(task: TrainingTask) -> None:
    """Say in the folder which training it holds; refuse one that holds another."""
    path, mine = task.folder / TASK, task.as_record()
    if path.exists():
        if json.loads(path.read_text(encoding="utf-8")) != mine:
            raise ResultsError(
                f"{task.folder} holds a training with other settings; choose another folder or move it away"
            )
        return
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(mine, indent=1), encoding="utf-8")


def _load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The last checkpoint: tensors, numbers and text only, nothing is unpickled."""
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        saved: dict[str, Any] = torch.load(path, weights_only=True)
        if {"parameters", "curve"} <= set(saved):
            return saved
        reason = "it lacks parameters or curve"
    except Exception as error:  # torch raises what its readers raise
        reason = str(error).splitlines()[0]
    raise ResultsError(f"{path} is no checkpoint ({reason}); move its folder away to begin anew")


def _restore(model: BaseAlgorithm, checkpoint: Mapping[str, Any], folder: Path) -> None:
    """Weights, optimizers and running means as they were."""
    try:
        model.set_parameters(checkpoint["parameters"])
    except Exception as error:
        raise ResultsError(
            f"{folder / CHECKPOINT} does not fit this training ({error}); move its folder away to begin anew"
        ) from error
    model.num_timesteps = int(checkpoint["steps"])
    for name, statistics in _running(model).items():
        statistics.mean, statistics.var, statistics.count = (np.asarray(part) for part in checkpoint[name])


def _running(model: BaseAlgorithm) -> dict[str, Any]:
    """Running means of an algorithm whose environment is normalized."""
    normalizer = model.get_vec_normalize_env()
    return {} if normalizer is None else {"observations": normalizer.obs_rms, "returns": normalizer.ret_rms}


def policy_mode(model: BaseAlgorithm) -> PolicyMode:
    """The policy as it is shipped."""
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return PolicyMode(model.policy)
    running: Any = normalizer.obs_rms
    return PolicyMode(model.policy, running.mean, np.sqrt(running.var + normalizer.epsilon), normalizer.clip_obs)


class _Course(BaseCallback):
    """Measures and saves the policy between two rollouts, when nothing is half done."""

    def __init__(
        self,
        task: TrainingTask,
        curve: TrainingCurve,
        yardstick: Yardstick,
        on_steps: Callable[[int], None],
        on_entry: Callable[[Entry], None],
    ) -> None:
        super().__init__()
        self.task, self.curve, self.yardstick = task, curve, yardstick
        self.on_steps, self.on_entry = on_steps, on_entry
        self.interval = max(1, task.settings.n_timesteps // MEASUREMENTS)
        self.seconds = float(curve.entries[-1]["seconds"]) if curve.entries else 0.0
        self.since = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.on_steps(self.num_timesteps)
        if self.num_timesteps >= self.curve.steps + self.interval:
            self._measure()

    def conclude(self) -> None:
        """Measure what the last update made."""
        if self.num_timesteps > self.curve.steps:
            self._measure()
        self.on_steps(self.num_timesteps)

    def _measure(self) -> None:
        self.seconds += time.perf_counter() - self.since
        entry: Entry = {"steps": self.num_timesteps, "seconds": round(self.seconds, 1)}
        entry |= self.yardstick.measure(self._write_agent())
        self.curve.entries.append(entry)
        self._save()
        for name, value in entry.items():
            self.logger.record(f"tune/{name}", value)
        self.on_entry(entry)
        self.since = time.perf_counter()

    def _write_agent(self) -> AgentCard:
        """Export the policy as it is; what is measured is what would be shipped."""
        task, folder = self.task, self.task.folder
        policy = policy_mode(self.model)
        size = int(self.model.observation_space.shape[0])  # type: ignore[index]
        card = LearnedCard(
            name=task.settings.algorithm.replace("_", "-"),
            summary=f"{task.settings.algorithm.upper()} on {describe_environment(task.env_id, task.env_kwargs)}",
            env_id=task.env_id,
            env_kwargs=plain(task.env_kwargs),
            encoding=plain(task.settings.encoding),
            network=f"{AGENT}.onnx",
            sha256="",
            steps=self.num_timesteps,
            training={**task.as_record(), "curve": self.curve.entries, "provenance": self.curve.provenance},
        )
        write_agent(policy, size, policy.memory, card, folder)
        return agent_in_file(folder / f"{AGENT}.json")

    def _save(self) -> None:
        saved: dict[str, Any] = {
            "parameters": self.model.get_parameters(),
            "steps": self.num_timesteps,
            "curve": json.dumps(vars(self.curve)),
        }
        for name, statistics in _running(self.model).items():
            parts = (statistics.mean, statistics.var, statistics.count)
            saved[name] = tuple(torch.as_tensor(np.asarray(part)) for part in parts)
        with atomic_path(self.task.folder / CHECKPOINT) as temporary:
            torch.save(saved, temporary)
