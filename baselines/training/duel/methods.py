"""Methods of the duel: what each of them searches, and what it sees while it learns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from optuna.trial import Trial

from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.training.duel.cells import Cell
from servotrack.baselines.training.settings import TrainingSettings, load_settings

Information = Literal["observations", "simulator"]
"""Data that a method sees while it is trained or tuned: observations and scores; or also the simulator's state."""

Suggest = Callable[[Trial, Cell], TrainingSettings]


@dataclass(frozen=True)
class LearnedMethod:
    """A method that trains a network.

    Attributes:
        summary: One line.
        information: Data that it sees in training. When it acts, every method sees observations only.
        suggest: Settings of one trial of the search; `n_timesteps` is set by the budget.
        fixed: True for settings that are not searched: the whole budget goes into training.
        worlds: Kinds of worlds that the method supports.
    """

    summary: str
    information: Information
    suggest: Suggest
    fixed: bool = False
    worlds: frozenset[str] = frozenset({"servo"})


def _encoding(trial: Trial, cell: Cell) -> dict[str, Any]:
    """Return the hand-made encoding: of frames as they are stamped, or of three possible ages."""
    if cell.world.kind == "follow":
        return {"kind": "servo", "follower": trial.suggest_categorical("follower", ["phd-servo", "crowd-servo"])}
    known = trial.suggest_categorical("stamps", ["known", "unknown"])
    return {"kind": "servo", **({} if known == "known" else {"ages": [0.2, 1.2, 2.2]})}


def _identified(trial: Trial, cell: Cell) -> dict[str, Any]:
    """Return the encoding with the estimate of a shipped filter, which adds no steps to the budget."""
    names = ["lifted-kf", "latency-bank-lifted-kf"]
    return {**_encoding(trial, cell), "identifier": trial.suggest_categorical("identifier", names)}


def _raw(trial: Trial) -> dict[str, Any]:
    """Return the last observations as they are, scaled by the bounds of their space."""
    return {"kind": "flat", "frames": trial.suggest_categorical("frames", [2, 4, 8])}


def _net(trial: Trial) -> list[int]:
    return [trial.suggest_categorical("width", [64, 128])] * 2


def _on_policy(trial: Trial) -> dict[str, Any]:
    """Return the searched numbers that PPO and recurrent PPO share."""
    steps = trial.suggest_categorical("n_steps", [16, 32, 64])
    return {
        "n_steps": steps,
        "batch_size": min(64 * steps, trial.suggest_categorical("batch_size", [512, 1024, 2048])),
        "n_epochs": trial.suggest_int("n_epochs", 3, 10),
        "gamma": 1.0 - trial.suggest_float("horizon_rate", 0.01, 0.2, log=True),
        "gae_lambda": trial.suggest_float("gae_lambda", 0.8, 0.98),
        "learning_rate": f"lin_{trial.suggest_float('learning_rate', 3e-4, 3e-3, log=True):.3g}",
        "ent_coef": 0.0,
    }


def _ppo(encode: Callable[[Trial, Cell], dict[str, Any]], name: str) -> Suggest:
    def suggest(trial: Trial, cell: Cell) -> TrainingSettings:
        net = _net(trial)
        policy = {
            "log_std_init": trial.suggest_float("log_std_init", -2.5, 0.0),
            "net_arch": {"pi": net, "vf": net},
        }
        numbers = {**_on_policy(trial), "policy_kwargs": policy}
        return TrainingSettings(name, "ppo", n_envs=64, encoding=encode(trial, cell), hyper_parameters=numbers)

    return suggest


def _recurrent(trial: Trial, cell: Cell) -> TrainingSettings:
    width = trial.suggest_categorical("width", [64, 128])
    policy = {
        "log_std_init": trial.suggest_float("log_std_init", -2.5, 0.0),
        "lstm_hidden_size": width,
        "net_arch": {"pi": [width], "vf": [width]},
    }
    numbers = {**_on_policy(trial), "policy_kwargs": policy}
    return TrainingSettings(
        "recurrent_ppo", "recurrent_ppo", 64, policy="MlpLstmPolicy", encoding={"kind": "flat"},
        hyper_parameters=numbers,
    )  # fmt: skip


def _off_policy(algorithm: str) -> Suggest:
    def suggest(trial: Trial, cell: Cell) -> TrainingSettings:
        numbers = {
            "batch_size": 256,
            "train_freq": 1,
            "gradient_steps": trial.suggest_categorical("gradient_steps", [2, 4]),
            "learning_starts": 2_000,
            "buffer_size": 1_000_000,
            "gamma": 1.0 - trial.suggest_float("horizon_rate", 0.01, 0.2, log=True),
            "tau": trial.suggest_float("tau", 0.005, 0.05, log=True),
            "learning_rate": trial.suggest_float("learning_rate", 3e-4, 3e-3, log=True),
            "policy_kwargs": {"net_arch": _net(trial)},
        }
        return TrainingSettings(
            algorithm, algorithm, n_envs=16, encoding=_encoding(trial, cell), hyper_parameters=numbers
        )

    return suggest


def _student(trial: Trial, cell: Cell) -> TrainingSettings:
    numbers = {
        "hidden": trial.suggest_categorical("hidden", [64, 96]),
        "learning_rate": f"lin_{trial.suggest_float('learning_rate', 5e-4, 3e-3, log=True):.3g}",
        "n_epochs": trial.suggest_int("n_epochs", 3, 12),
        "batch_size": trial.suggest_categorical("batch_size", [8, 16]),
        "exploration": trial.suggest_float("exploration", 0.02, 0.3, log=True),
        "scale": trial.suggest_float("scale", 0.002, 0.02, log=True),
    }
    encoding = {**_encoding(trial, cell), "lags": [1, 2, 4]}
    return TrainingSettings("student", "student", n_envs=16, encoding=encoding, hyper_parameters=numbers)


def _shipped(trial: Trial, cell: Cell) -> TrainingSettings:
    return load_settings(cell.env_id, "follower" if cell.world.kind == "follow" else "ppo", cell.level)


CLASSICAL = "classical"
"""Name of the classical method: `search_structure` over filters, target models, ages, law and probing."""

_BOTH = frozenset({"servo", "follow"})

LEARNED: Mapping[str, LearnedMethod] = {
    "ppo": LearnedMethod(
        "PPO on the encoded image error, settings searched", "observations", _ppo(_encoding, "ppo"), worlds=_BOTH
    ),
    "ppo-fixed": LearnedMethod(
        "PPO on the encoded image error with the package's settings", "observations", _shipped, True, _BOTH
    ),
    "ppo-raw": LearnedMethod(
        "PPO on the last raw observations, settings searched",
        "observations",
        _ppo(lambda trial, cell: _raw(trial), "ppo-raw"),
    ),
    "ppo-identified": LearnedMethod(
        "PPO on the encoded image error and a lifted Kalman filter's estimate, settings searched",
        "observations",
        _ppo(_identified, "ppo-identified"),
    ),
    "recurrent-ppo": LearnedMethod("recurrent PPO on raw observations, settings searched", "observations", _recurrent),
    "sac": LearnedMethod("SAC on the encoded image error, settings searched", "observations", _off_policy("sac")),
    "tqc": LearnedMethod("TQC on the encoded image error, settings searched", "observations", _off_policy("tqc")),
    "student": LearnedMethod(
        "recurrent history encoder, taught where the target will be, settings searched", "simulator", _student
    ),
}
"""Learned methods by name."""

REFERENCES: Mapping[str, tuple[str, ...]] = {
    "servo": (
        "random",
        "oracle",
        "kf",
        "latency-bank-lifted-kf",
        "latency-bank-agile-kf",
        "shipped-ppo",
        "shipped-hybrid",
    ),
    "follow": ("random", "phd-servo", "crowd-servo", "shipped-follower"),
}
"""Agents as shipped, without a budget in the cell, by kind of world; the agent of the score 0 is among them."""
SHIPPED_PREFIX = "shipped-"
SHIPPED = frozenset(name for names in REFERENCES.values() for name in names)
"""Names of all agents of `REFERENCES`."""


def supports(method: str, cell: Cell) -> bool:
    """Return True if a method or a reference agent takes part in a cell."""
    kind = cell.world.kind
    if method in LEARNED:
        return kind in LEARNED[method].worlds
    if method not in SHIPPED:
        return method == CLASSICAL
    trained_in = shipped_card(method).trained_in
    return method in REFERENCES.get(kind, ()) and (trained_in is None or cell.title in trained_in)


def shipped_card(name: str) -> AgentCard:
    """Return the card of a reference agent, whose name says `shipped-` where a method has the same name."""
    return agent_card(name.removeprefix(SHIPPED_PREFIX))
