"""Tuning protocol with counted environment steps: a coordinate search over a declared grid, on tune seeds.

The search starts at the estimators' defaults. It goes through the hyper-parameters one by one, measures every value of
the grid with the others held, on the same episodes for all, and moves only if a value is better by more than noise.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.agents.tuning_record import Candidate, TunedAgent, TuningRecord, Values, resume_record
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import Row
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.running.workers import in_workers
from servotrack.baselines.tuning.families import Grid, common_family, family_of
from servotrack.baselines.worlds import World, plain, world_of_id
from servotrack.estimators.types import Array

FIRST_SEED = 50_000
"""First seed in the tune range, apart from its beginning, where tests and manual trials take theirs."""
EPISODES = 16
"""Default number of seeds per level."""
FAILURE_COST = 3.0
"""Cost of a failed episode, beside its error."""
SMALLEST_ERROR = 1e-12
"""Bound of an error before its logarithm is taken."""
RESAMPLES = 20_000
"""Bootstrap resamples; an interval with Bonferroni's correction needs the far tails."""


class Measured(NamedTuple):
    """Result of the episodes of one setting.

    Attributes:
        costs: Cost of each episode, in the same order for every setting. Shape (k,).
        steps: Environment steps of all episodes.
    """

    costs: Array
    steps: int


@dataclass(frozen=True)
class TuningProtocol:
    """Episodes that every candidate is measured on, and the rule by which one replaces another.

    The cost of an episode is the logarithm of the world's ranking metric, or minus the metric if larger is better. In
    a servo world it is ln(steady error in m), plus `failure_cost` if the episode fails. A candidate is better than the
    incumbent by more than noise if the bootstrap interval of its mean paired difference lies below zero; the interval's
    confidence is 1 - `error_rate` / (candidates of the grid), Bonferroni's correction, so that a whole pass leaves an
    optimal start with a probability of at most about `error_rate`. It replaces the incumbent if it is also better by
    `least_gain`, so that a significant but negligible gain changes no default.

    Args:
        env_id: Gymnasium id of one of `FAMILIES`.
        levels: Levels, each with all seeds.
        seeds: Environment seeds, of the tune range.
        failure_cost: Cost added for a failed episode, in worlds that have successes.
        error_rate: Probability of a false change, for all candidates of an agent together.
        least_gain: Smallest gain that changes a value, in units of the cost: 0.02 is 2 % of every episode's error.
        passes: Largest number of passes over all hyper-parameters; a pass without a change is the last.
    """

    env_id: str = "UncalibServo-v0"
    levels: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    seeds: tuple[int, ...] = field(default_factory=lambda: tuple(seed_ranges.take("tune", EPISODES, FIRST_SEED)))
    failure_cost: float = FAILURE_COST
    error_rate: float = 0.05
    least_gain: float = 0.02
    passes: int = 2

    def __post_init__(self) -> None:
        outside = [seed for seed in self.seeds if seed not in seed_ranges.TUNE]
        if outside or not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(
                "seeds must be different ones, at least one, of the tune range "
                f"{seed_ranges.TUNE.start}..{seed_ranges.TUNE.stop - 1}, got {outside[:5] or list(self.seeds[:5])}; "
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
        """Return the protocol as the record keeps it."""
        return plain(asdict(self))


def episode_cost(world: World, row: Row, failure_cost: float = FAILURE_COST) -> float:
    """Return the cost of an episode that searches minimize; see `TuningProtocol`.

    Args:
        world: Record of the kind of world.
        row: Row of the episode.
        failure_cost: Cost added for a failed episode. Larger values prefer fewer failures to smaller errors.
    """
    value = row[world.headline.column]
    cost = -value if world.headline.high_is_good else float(np.log(max(value, SMALLEST_ERROR)))
    return cost + failure_cost * (not row.get("success", True))


def measure(agent: str, values: Values, protocol: TuningProtocol) -> Measured:
    """Run an agent's episodes with other values than its defaults, as the evaluator runs them."""
    return next(measure_all(agent, [values], protocol))


def measure_all(
    agent: str, settings: Sequence[Values], protocol: TuningProtocol, jobs: int = 1
) -> Generator[Measured, None, None]:
    """Measure several settings in worker processes or on a cluster; yield them in their order.

    Args:
        agent: Name of the agent.
        settings: Values of its hyper-parameters.
        protocol: Episodes.
        jobs: Processes; 1 runs the episodes in this process.
    """
    calls = (
        delayed(_measure_level)(agent, values, protocol, level) for values in settings for level in protocol.levels
    )
    parts = in_workers(calls, jobs, ordered=True)
    for _ in settings:
        costs, steps = zip(*itertools.islice(parts, len(protocol.levels)), strict=True)
        yield Measured(np.concatenate(costs), sum(steps))


def _measure_level(agent: str, values: Values, protocol: TuningProtocol, level: int) -> Measured:
    """Run the episodes of one level. A worker must register the ids first."""
    import servotrack  # noqa: F401

    card = family_of(agent, protocol.env_id).insert(agent_card(agent), values)
    world = world_of_id(protocol.env_id)
    rows, _ = run_episodes(protocol.env_id, card, protocol.seeds, {"level": level})
    costs = np.array([episode_cost(world, row, protocol.failure_cost) for row in rows])
    return Measured(costs, sum(row["length"] for row in rows))


def coordinate_search(
    evaluate: Callable[[Sequence[Values]], Iterable[Measured]],
    start: Values,
    grid: Grid,
    *,
    error_rate: float = 0.05,
    least_gain: float = 0.02,
    passes: int = 2,
    on_candidate: Callable[[], None] | None = None,
) -> TunedAgent:
    """Search a grid one hyper-parameter at a time; every setting is measured at most once.

    Args:
        evaluate: Measures settings, which may run at the same time, and yields the results in their order.
        start: Initial value of each hyper-parameter.
        grid: Values to try, by hyper-parameter.
        error_rate: See `TuningProtocol`.
        least_gain: See `TuningProtocol`.
        passes: See `TuningProtocol`.
        on_candidate: Called after every measured setting.

    Raises:
        ValueError: A start that is not on the grid.
    """
    off_grid = [name for name in grid if start.get(name) not in grid[name]] + [n for n in start if n not in grid]
    if off_grid:
        raise ValueError(f"start must be on the grid, {off_grid[0]} = {start.get(off_grid[0])} is not; add it")
    confidence = 1.0 - error_rate / max(1, candidate_count(grid) - 1)
    measured: dict[tuple[float, ...], Measured] = {}
    candidates: list[Candidate] = []

    def place(values: Values) -> tuple[float, ...]:
        return tuple(values[name] for name in grid)

    def gain(values: Values, incumbent: Values) -> dict[str, float]:
        difference = measured[place(values)].costs - measured[place(incumbent)].costs
        return bootstrap_mean(difference, confidence, RESAMPLES)._asdict()

    def measure_new(settings: Sequence[Values], incumbent: Values | None) -> None:
        new = [values for values in settings if place(values) not in measured]
        for values, found in zip(new, evaluate(new), strict=True):
            measured[place(values)] = found
            difference = None if incumbent is None else gain(values, incumbent)
            candidates.append(Candidate(dict(values), float(found.costs.mean()), difference, found.steps))
            if on_candidate:
                on_candidate()

    best = dict(start)
    measure_new([best], None)
    for _ in range(passes):
        before = best
        for name, choices in grid.items():
            others = [{**best, name: choice} for choice in choices if choice != best[name]]
            measure_new(others, best)
            gains = [gain(values, best) for values in others]
            winners = [v for v, g in zip(others, gains, strict=True) if g["high"] < 0.0 and g["value"] <= -least_gain]
            best = min(winners, key=lambda v: measured[place(v)].costs.mean(), default=best)
        if best == before:
            break
    return TunedAgent({name: list(choices) for name, choices in grid.items()}, dict(start), candidates, best)


def candidate_count(grid: Grid) -> int:
    """Return the number of settings that one pass measures, the start included."""
    return 1 + sum(len(choices) - 1 for choices in grid.values())


def default_values(agent: str, env_id: str | None = None) -> Values:
    """Return the estimator's defaults of an agent's searched hyper-parameters; arguments as in `family_of`.

    Raises:
        ValueError: An unknown agent, or one without a grid.
    """
    return family_of(agent, env_id).default_values(agent)


def default_protocol(agents: Sequence[str], seeds: Sequence[int], env_id: str | None = None) -> TuningProtocol:
    """Return the protocol of the agents' family: its environment and levels, with the given seeds.

    Args:
        agents: Names of the agents.
        seeds: Seeds of the tune range.
        env_id: Environment of the family; None for the first family that holds all the agents.

    Raises:
        ValueError: Agents of different families, or seeds outside the tune range.
    """
    family = common_family(agents, env_id)
    return TuningProtocol(family.env_id, family.levels, tuple(seeds))


def tune(
    agents: Sequence[str],
    path: Path,
    protocol: TuningProtocol,
    *,
    jobs: int = 1,
    on_agent: Callable[[str, int], None] | None = None,
    on_candidate: Callable[[], None] | None = None,
) -> TuningRecord:
    """Search agent after agent; agents that the file already holds are skipped.

    Args:
        agents: Names of agents that have a grid.
        path: The record, saved after every agent.
        protocol: Episodes and rule of the search.
        jobs: Processes that measure the values of one hyper-parameter at the same time.
        on_agent: Called with every agent's name before its search, and the settings of one pass; 0 if it is done.
        on_candidate: Called after every measured setting.

    Raises:
        ValueError: An unknown agent, one without a grid, or one that is tuned in another environment.
        ResultsError: An invalid file, or one that holds a search over another grid.
    """
    family = common_family(agents, protocol.env_id)
    starts = {name: family.default_values(name) for name in agents}
    record = resume_record(path, protocol.as_record())
    for name in agents:
        done = record.agents.get(name)
        if done and done.grid != {key: list(choices) for key, choices in family.grids[name].items()}:
            raise ResultsError(f"{path}: {name} was searched over another grid; choose another --output")
    for name, start in starts.items():
        done = record.agents.get(name)
        if on_agent:
            on_agent(name, 0 if done else candidate_count(family.grids[name]))
        if done:
            continue
        # Taken before the search, so that it describes the sources that the search runs.
        record_of_run = provenance()
        tuned = coordinate_search(
            lambda settings, name=name: measure_all(name, settings, protocol, jobs),  # type: ignore[misc]
            start,
            family.grids[name],
            error_rate=protocol.error_rate,
            least_gain=protocol.least_gain,
            passes=protocol.passes,
            on_candidate=on_candidate,
        )
        tuned.provenance = record_of_run
        record.agents[name] = tuned
        record.save(path)
    return record
