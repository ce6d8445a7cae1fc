"""Tuning by a stated protocol with counted environment steps: a coordinate search over a declared grid, on tune seeds.

The search begins at the estimators' defaults. It goes through the hyper-parameters one by one, measures every value of
the grid with the others held, on the same episodes for all, and moves only where a value is better by more than noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.agents.servo.catalog import ESTIMATORS
from servotrack.baselines.agents.servo.hyper_parameters import value_at
from servotrack.baselines.agents.servo.tuning_grid import BORROWED, GRIDS, Grid
from servotrack.baselines.agents.tuning_record import Candidate, TunedAgent, TuningRecord, Values, resume_record
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.worlds import plain
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.estimators.types import Array

FIRST_SEED = 50_000
"""Offset in the tune range, away from its beginning, where tests and trials by hand take their seeds."""
EPISODES = 16
RESAMPLES = 20_000
"""Enough for the tails of an interval that is shared among a whole grid."""


class Measured(NamedTuple):
    """A setting's episodes.

    Attributes:
        costs: One per episode, in the same order for every setting. Shape (k,).
        steps: Environment steps that they took.
    """

    costs: Array
    steps: int


@dataclass(frozen=True)
class TuningProtocol:
    """What every candidate is measured on, and when one replaces another.

    The cost of an episode is ln(steady error in m), plus `failure_cost` where it is no success. A candidate is better
    than the incumbent by more than noise if the bootstrap interval of its mean paired difference lies below zero; the
    interval's confidence is 1 - `error_rate` / (candidates of the grid), Bonferroni's correction, so that a whole pass
    moves away from a best start with a probability of about `error_rate` at most. It replaces the incumbent if it is
    also better by `least_gain`, for a certain gain of nothing is no reason to change a default.

    Args:
        env_id: A servo.
        levels: Levels, each with all seeds.
        seeds: Environment seeds, of the tune range.
        failure_cost: Added for an episode that is no success.
        error_rate: For all candidates of an agent together.
        least_gain: In units of the cost: 0.02 is 2 % of every episode's error.
        passes: Over all hyper-parameters, at most; a pass that changes nothing is the last.
    """

    env_id: str = "UncalibServo-v0"
    levels: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    seeds: tuple[int, ...] = field(default_factory=lambda: tuple(seed_ranges.take("tune", EPISODES, FIRST_SEED)))
    failure_cost: float = 3.0
    error_rate: float = 0.05
    least_gain: float = 0.02
    passes: int = 2

    def __post_init__(self) -> None:
        strangers = [seed for seed in self.seeds if seed not in seed_ranges.TUNE]
        if strangers or not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(
                "seeds must be different ones, at least one, of the tune range "
                f"{seed_ranges.TUNE.start}..{seed_ranges.TUNE.stop - 1}, got {strangers[:5] or list(self.seeds[:5])}; "
                "take them with seeds.take('tune', count)"
            )
        if not self.levels:
            raise ValueError("levels must hold at least one level, got none")
        if not 0.0 < self.error_rate < 1.0:
            raise ValueError(f"error_rate must be in (0, 1), got {self.error_rate}")
        if not self.least_gain >= 0.0:
            raise ValueError(f"least_gain must be >= 0, got {self.least_gain}")
        if self.passes < 1:
            raise ValueError(f"passes must be at least 1, got {self.passes}")

    def as_record(self) -> dict[str, Any]:
        """What the record keeps of it."""
        return plain(asdict(self))


def measure(agent: str, values: Values, protocol: TuningProtocol) -> Measured:
    """An agent's episodes with other values than its defaults, run as the evaluator runs them."""
    card = agent_card(agent)
    card = replace(card, parameters={**card.parameters, "values": values})
    costs, steps = [], 0
    for level in protocol.levels:
        rows, _ = run_episodes(protocol.env_id, card, protocol.seeds, {"level": level})
        costs += [np.log(row["steady"]) + protocol.failure_cost * (not row["success"]) for row in rows]
        steps += sum(row["length"] for row in rows)
    return Measured(np.array(costs), steps)


def coordinate_search(
    evaluate: Callable[[Values], Measured],
    start: Values,
    grid: Grid,
    *,
    error_rate: float = 0.05,
    least_gain: float = 0.02,
    passes: int = 2,
    on_candidate: Callable[[], None] | None = None,
) -> TunedAgent:
    """Search a grid one hyper-parameter at a time; no setting is measured twice.

    Args:
        evaluate: Measures a setting.
        start: One value of each hyper-parameter.
        grid: The values to try.
        error_rate: See `TuningProtocol`.
        least_gain: See `TuningProtocol`.
        passes: See `TuningProtocol`.
        on_candidate: Called after every setting measured.

    Raises:
        ValueError: `start` is not on the grid.
    """
    off_grid = [name for name in grid if start.get(name) not in grid[name]] + [n for n in start if n not in grid]
    if off_grid:
        raise ValueError(f"start must be on the grid, {off_grid[0]} = {start.get(off_grid[0])} is not; add it")
    confidence = 1.0 - error_rate / max(1, candidate_count(grid) - 1)
    measured: dict[tuple[float, ...], Measured] = {}
    candidates: list[Candidate] = []

    def better(values: Values, incumbent: Values | None) -> bool:
        key = tuple(values[name] for name in grid)
        known = key in measured
        if not known:
            measured[key] = evaluate(values)
        costs, steps = measured[key]
        if incumbent is None:
            difference = None
        else:
            reference = measured[tuple(incumbent[name] for name in grid)].costs
            difference = bootstrap_mean(costs - reference, confidence, RESAMPLES)._asdict()
        if not known:
            candidates.append(Candidate(dict(values), float(costs.mean()), difference, steps))
            if on_candidate:
                on_candidate()
        return difference is not None and difference["high"] < 0.0 and difference["value"] <= -least_gain

    best = dict(start)
    better(best, None)
    for _ in range(passes):
        before = best
        for name, choices in grid.items():
            others = [{**best, name: choice} for choice in choices if choice != best[name]]
            winners = [values for values in others if better(values, best)]
            best = min(winners, key=lambda v: measured[tuple(v[n] for n in grid)].costs.mean(), default=best)
        if best == before:
            break
    return TunedAgent({name: list(choices) for name, choices in grid.items()}, dict(start), candidates, best)


def candidate_count(grid: Grid) -> int:
    """Settings that one pass measures, the start included."""
    return 1 + sum(len(choices) - 1 for choices in grid.values())


def default_values(agent: str) -> Values:
    """The estimator's defaults of an agent's searched hyper-parameters.

    Raises:
        ValueError: The agent has none.
    """
    agent_card(agent)
    if agent not in GRIDS:
        reason = f"it uses the values of {BORROWED[agent]}" if agent in BORROWED else "nothing of it can be tuned"
        raise ValueError(f"agent {agent!r} has no values of its own to tune ({reason}); choose of {', '.join(GRIDS)}")
    estimator = ESTIMATORS[agent]()
    return {path: value_at(estimator, path) for path in GRIDS[agent]}


def tune(
    agents: Sequence[str],
    path: Path,
    protocol: TuningProtocol,
    *,
    on_agent: Callable[[str, int], None] | None = None,
    on_candidate: Callable[[], None] | None = None,
) -> TuningRecord:
    """Search agent after agent; those that the file holds already are not searched again.

    Args:
        agents: Names with a grid.
        path: The record, saved after every agent.
        protocol: What to measure on.
        on_agent: Called with every agent's name before its search, and the settings of one pass; 0 where it is done.
        on_candidate: Called after every setting measured.

    Raises:
        ValueError: An unknown agent or one without a grid.
        ResultsError: The file cannot be used, or holds a search over another grid.
    """
    starts = {name: default_values(name) for name in agents}
    record = resume_record(path, protocol.as_record())
    for name in agents:
        done = record.agents.get(name)
        if done and done.grid != {key: list(choices) for key, choices in GRIDS[name].items()}:
            raise ResultsError(f"{path}: {name} was searched over another grid; choose another --output")
    for name, start in starts.items():
        done = record.agents.get(name)
        if on_agent:
            on_agent(name, 0 if done else candidate_count(GRIDS[name]))
        if done:
            continue
        # Before the search: these are the sources that it runs.
        record_of_run = provenance()
        tuned = coordinate_search(
            lambda values, name=name: measure(name, values, protocol),  # type: ignore[misc]
            start,
            GRIDS[name],
            error_rate=protocol.error_rate,
            least_gain=protocol.least_gain,
            passes=protocol.passes,
            on_candidate=on_candidate,
        )
        tuned.provenance = record_of_run
        record.agents[name] = tuned
        record.save(path)
    return record
