"""Train a network within a budget of environment steps; the search of its settings is part of the budget."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import optuna

from servotrack.baselines.agents.learned.shipped import agent_in_file
from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.baselines.training.dispatch import train
from servotrack.baselines.training.duel.cells import Cell
from servotrack.baselines.training.duel.methods import LearnedMethod
from servotrack.baselines.training.progress import NoEvaluation
from servotrack.baselines.training.run import AGENT, TrainingTask
from servotrack.baselines.training.settings import SUPERVISED, TrainingSettings
from servotrack.baselines.tuning.search import episode_cost

SEARCH_SHARE = 0.5
"""Share of the budget that the search of settings takes."""
TRIALS = ((3_000_000, 16), (300_000, 8), (0, 4))
"""Trials of the search, by the least budget in environment steps."""
MEASURED_SHARE = 0.2
"""Share of a trial in which its policy is measured on tune seeds."""
MOST_MEASURED = 50
"""Most episodes in which a policy is measured."""


@dataclass(frozen=True)
class Trained:
    """A policy and what it took.

    Attributes:
        agent: Card of the policy, whose files are in the folder that was given.
        steps: Environment steps: `search`, `training`.
        trials: Trials of the search: parameters, cost on tune seeds, environment steps.
        settings: Settings of the final training.
    """

    agent: AgentCard
    steps: dict[str, int]
    trials: list[dict[str, Any]]
    settings: dict[str, Any]


def train_within(method: LearnedMethod, cell: Cell, budget: int, run: int, folder: Path) -> Trained:
    """Search settings, then train with the best ones.

    Args:
        method: The method.
        cell: The cell.
        budget: Environment steps of the search, its measurements and the training together.
        run: Number of the run; seeds derive from it.
        folder: Folder of the run's files. Its former content is removed.

    Raises:
        ValueError: A budget that is too small for the method.
    """
    shutil.rmtree(folder, ignore_errors=True)
    trials: list[dict[str, Any]] = []
    if method.fixed:
        best: TrainingSettings = method.suggest(optuna.trial.FixedTrial({}), cell)  # type: ignore[arg-type]
    else:
        best = _searched(method, cell, budget, run, folder, trials)
    spent = sum(trial["steps"] for trial in trials)
    settings, steps = _trained(best, cell, budget - spent, run, folder / "final")
    return Trained(
        agent_in_file(folder / "final" / f"{AGENT}.json"),
        {"search": spent, "training": steps},
        trials,
        settings.as_record(),
    )


def _searched(
    method: LearnedMethod, cell: Cell, budget: int, run: int, folder: Path, trials: list[dict[str, Any]]
) -> TrainingSettings:
    """Run the trials, append their records to `trials`, and return the settings of the best one."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    count = next(count for least, count in TRIALS if budget >= least)
    sampler = optuna.samplers.TPESampler(seed=run, n_startup_trials=count // 2)
    study = optuna.create_study(sampler=sampler)
    rng = np.random.default_rng([run, budget])
    share = int(SEARCH_SHARE * budget) // count
    measured = int(np.clip(MEASURED_SHARE * share / cell.episode_steps, 1, MOST_MEASURED))
    # One seed set for all trials: their costs are paired.
    seeds = (seed_ranges.TUNE.start + rng.choice(len(seed_ranges.TUNE), measured, replace=False)).tolist()
    found: list[TrainingSettings] = []
    for number in range(count):
        trial = study.ask()
        asked = method.suggest(trial, cell)
        room = share - measured * cell.episode_steps
        settings, steps = _trained(asked, cell, room, run * 1000 + number + 1, folder / f"trial{number}")
        agent = agent_in_file(folder / f"trial{number}" / f"{AGENT}.json")
        rows, _ = run_episodes(cell.env_id, agent, seeds, cell.env_kwargs)
        cost = float(np.mean([episode_cost(cell.world, row) for row in rows]))
        study.tell(trial, cost)
        found.append(settings)
        trials.append(
            {
                "parameters": dict(trial.params),
                "cost": round(cost, 4),
                "steps": steps + sum(row["length"] for row in rows),
            }
        )
        shutil.rmtree(folder / f"trial{number}")
    return found[study.best_trial.number]


def _trained(
    settings: TrainingSettings, cell: Cell, budget: int, seed: int, folder: Path
) -> tuple[TrainingSettings, int]:
    """Train within a budget of environment steps, none of them uncounted; return the settings and the steps taken."""
    block = _block(settings, cell)
    # A training stops at the end of the block in which it reaches `n_timesteps`.
    if budget < block:
        raise ValueError(f"budget must be at least {block} steps for {settings.recipe}, got {budget}")
    settings = replace(settings, n_timesteps=budget - block + 1, measurements=1)
    task = TrainingTask(cell.env_id, cell.env_kwargs, settings, seed, folder, tensorboard=False)
    return settings, train(task, NoEvaluation()).steps


def _block(settings: TrainingSettings, cell: Cell) -> int:
    """Return the environment steps between two points at which a training may end."""
    if settings.algorithm in SUPERVISED:
        return settings.n_envs * cell.episode_steps
    numbers: Mapping[str, Any] = settings.hyper_parameters
    return settings.n_envs * int(numbers.get("n_steps", numbers.get("train_freq", 1)))
