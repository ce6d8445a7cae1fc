"""Suites of cells (agents x environments x seeds), evaluated in parallel and resumable."""

from __future__ import annotations

import difflib
import inspect
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
from joblib import delayed
from rich.progress import Progress

from servotrack.baselines.agents.registry import AGENTS, agent_card
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder
from servotrack.baselines.running.stopping import GO_ON, keeping
from servotrack.baselines.running.workers import in_workers, on_cluster
from servotrack.baselines.worlds import describe_environment, kind_of_id

DEFAULT_LEVELS = (0, 1, 2, 3, 4, 5)
DEFAULT_EPISODES = 100
TASK_EPISODES = 25
"""Episodes of one task on a cluster: what the loss of a worker costs."""
SAVE_INTERVAL = 2.0
"""Wait of finished tasks of a cluster to be saved together, s. Larger values lose more by a SIGKILL."""
SAVING_SHARE = 0.02
"""Largest share of the time that saving takes before a cell is complete. Lower values lose more by a SIGKILL."""


@dataclass(frozen=True)
class Cell:
    """One agent in one environment.

    Attributes:
        env_id: Gymnasium id.
        agent: Name of the agent.
        env_kwargs: Arguments of the environment.
    """

    env_id: str
    agent: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)


def default_agents(env_id: str = "UncalibServo-v0") -> list[str]:
    """Every registered agent that is measured in a world by default, in the table's order."""
    kind = kind_of_id(env_id)
    return [name for name, card in AGENTS.items() if card.in_default_suite and kind in card.worlds]


def suite_of(
    env_id: str | Sequence[str],
    agents: Sequence[str] | None = None,
    levels: Sequence[int] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> list[Cell]:
    """Agents against levels of one world, or of several.

    Args:
        env_id: Gymnasium id, or several.
        agents: Names; None for all that are measured in a world by default.
        levels: None for `DEFAULT_LEVELS`, or for the world as it is where it has no levels.
        settings: Arguments of the environments besides their level.

    Raises:
        ValueError: An unknown agent, a level that an environment does not have, or nothing to do.
    """
    for name in agents or ():
        agent_card(name)
    if levels is not None and not levels:
        raise ValueError("levels must hold at least one level, got none")
    given, cells, worlds = dict(settings or {}), [], []
    for each in [env_id] if isinstance(env_id, str) else env_id:
        own = levels or (DEFAULT_LEVELS if _has_levels(each) else ())
        for kwargs in [{"level": level, **given} for level in own] or [given]:
            # Now, not after minutes of the levels before it: making one says what is wrong with it.
            gym.make(each, **kwargs).close()
            worlds.append(describe_environment(each, kwargs))
            names = list(agents) if agents else default_agents(each)
            cells += [Cell(each, name, kwargs) for name in names if _has_network(name, each, kwargs)]
    if missing := sorted(set(agents or ()) - {cell.agent for cell in cells}):
        raise ValueError(f"{', '.join(missing)} was trained in none of {', '.join(worlds)}")
    return cells


def _has_network(name: str, env_id: str, kwargs: Mapping[str, Any]) -> bool:
    """Return True if an agent can act in an environment: a learned one needs a network trained at its level."""
    trained_in = agent_card(name).trained_in
    level = {key: kwargs[key] for key in ("level",) if key in kwargs}
    return trained_in is None or describe_environment(env_id, level) in trained_in


def _has_levels(env_id: str) -> bool:
    """True if the id takes a `level` and is registered without one."""
    spec = gym.spec(env_id)
    entry = spec.entry_point
    creator = gym.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry
    return creator is not None and "level" in inspect.signature(creator).parameters and "level" not in spec.kwargs


def bench(
    env_id: str = "UncalibServo-v0",
    agents: Sequence[str] | None = None,
    levels: Sequence[int] | None = None,
    *,
    folder: str | Path,
    episodes: int = DEFAULT_EPISODES,
    split: str = "test",
    jobs: int = -1,
    settings: Mapping[str, Any] | None = None,
) -> list[CellResults]:
    """Evaluate agents on the levels of one environment; the Python face of `servotrack bench`.

    Args:
        env_id: Gymnasium id.
        agents: Names, "module:callable" or files; None for the default suite of the kind of world.
        levels: Levels; None for 0 to 5, or for the environment as it is where it has no levels.
        folder: Results folder. Finished cells in it are not evaluated again.
        episodes: Episodes per cell.
        split: Seed range: "test" for reported numbers, "tune" while parameters are still being chosen.
        jobs: Processes, as in joblib; -1 for all processors.
        settings: Arguments of the environment besides its level.

    Returns:
        One cell per level and agent, for `servotrack.baselines.leaderboard.summary.summarize`.

    Raises:
        ValueError: An unknown agent, level or split.
        ResultsError: The folder cannot be used.
    """
    cells = suite_of(env_id, agents, levels, settings)
    return run_suite(cells, ResultsFolder(folder), episodes=episodes, split=split, jobs=jobs)


def check_cell(env_id: str, agent: str, env_kwargs: Mapping[str, Any]) -> None:
    """Refuse an unknown environment or agent before anything is computed.

    Raises:
        ValueError: An unknown id or name, with the nearest known one, or arguments that the environment refuses.
    """
    agent_card(agent)
    if ":" not in env_id and env_id not in gym.registry:
        near = difflib.get_close_matches(env_id, list(gym.registry), n=1, cutoff=0.5)
        remedy = f"did you mean {near[0]!r}?" if near else "see gymnasium.pprint_registry()"
        raise ValueError(f"no environment is called {env_id!r}; {remedy}")
    gym.make(env_id, **env_kwargs).close()


def run_suite(
    cells: Sequence[Cell],
    folder: ResultsFolder,
    *,
    episodes: int = DEFAULT_EPISODES,
    split: str = "test",
    jobs: int = -1,
    progress: Progress | None = None,
) -> list[CellResults]:
    """Evaluate every cell on the same seeds; what the folder holds already is not done again.

    Compute time per step is measured afterwards, one agent at a time, when the processors are free.

    Args:
        cells: Cells to evaluate.
        folder: Results folder. Finished cells in it are skipped.
        episodes: Per cell.
        split: Seeds to take: "test", or "tune" while anything is still being chosen.
        jobs: Processes, as in joblib; -1 for all processors.
        progress: Progress display for the bars.

    Raises:
        ValueError: Bad arguments.
        ResultsError: The folder cannot be used.
    """
    chosen = seed_ranges.take(split, episodes)
    folder.check_writable()
    record = provenance()
    # A damaged or foreign file has to be refused before hours of work, not in the middle of them.
    todo = _unfinished(cells, folder, chosen)
    bar = progress.add_task("evaluating", total=len(cells), completed=len(cells) - len(todo)) if progress else None
    with keeping(lambda: _kept(cells, folder, chosen)):
        for _ in _evaluated(todo, folder, chosen, jobs, record):
            if progress and bar is not None:
                progress.advance(bar)
        _measure_times(cells, folder, chosen, progress)
    loaded = [folder.load(cell.env_id, cell.env_kwargs, cell.agent) for cell in cells]
    return [result for result in loaded if result is not None]


def _evaluated(
    cells: Sequence[Cell], folder: ResultsFolder, seeds: list[int], jobs: int, record: dict[str, Any]
) -> Iterator[None]:
    if not cells:
        return
    if on_cluster():
        yield from _evaluated_elsewhere(cells, folder, seeds, record)
        return
    workers = min((os.cpu_count() or 1) + 1 + jobs if jobs < 0 else jobs, len(cells))
    if workers <= 1:
        for cell in cells:
            _evaluate_cell(cell, folder, seeds, record)
            yield
        return
    yield from in_workers((delayed(_evaluate_cell)(cell, folder, seeds, record) for cell in cells), workers)


def _evaluated_elsewhere(
    cells: Sequence[Cell], folder: ResultsFolder, seeds: Sequence[int], record: dict[str, Any]
) -> Iterator[None]:
    """Evaluate on a cluster, whose workers may not see the folder: this process saves their rows.

    A file is written anew each time, which takes longer the more rows it has. So rows wait for each other for
    `SAVE_INTERVAL`, longer where saving would take more than `SAVING_SHARE`, or until their cell is complete.
    """
    tasks = []
    for cell in cells:
        stored = folder.load(cell.env_id, cell.env_kwargs, cell.agent)
        todo = [seed for seed in seeds if stored is None or seed not in set(stored.seeds)]
        tasks += [(cell, todo[first : first + TASK_EPISODES]) for first in range(0, len(todo), TASK_EPISODES)]
    unfinished = Counter(cells.index(cell) for cell, _ in tasks)
    calls = (delayed(_evaluated_task)(cells.index(cell), cell, chunk, record) for cell, chunk in tasks)
    waiting: dict[int, CellResults] = {}
    due = time.monotonic() + SAVE_INTERVAL
    try:
        for number, result in in_workers(calls, -1):
            if number in waiting:
                waiting[number].rows.extend(result.rows)
            else:
                waiting[number] = result
            unfinished[number] -= 1
            if (begin := time.monotonic()) > due:
                while waiting:
                    folder.save(waiting.popitem()[1])
                due = time.monotonic() + max(SAVE_INTERVAL, (time.monotonic() - begin) / SAVING_SHARE)
            if not unfinished[number]:
                if number in waiting:
                    folder.save(waiting.pop(number))
                yield
    finally:
        while waiting:
            folder.save(waiting.popitem()[1])


def _evaluated_task(number: int, cell: Cell, seeds: list[int], record: dict[str, Any]) -> tuple[int, CellResults]:
    """Run one task on a worker of a cluster."""
    import servotrack  # noqa: F401

    return number, evaluate(cell.env_id, cell.agent, seeds, cell.env_kwargs, timing=False, record=record)


def _evaluate_cell(cell: Cell, folder: ResultsFolder, seeds: list[int], record: dict[str, Any]) -> None:
    """Run one cell in a worker process. Workers must register the ids first, and have no command line of their own."""
    import servotrack  # noqa: F401

    evaluate(cell.env_id, cell.agent, seeds, cell.env_kwargs, folder=folder, timing=False, record=record)


def _measure_times(cells: Sequence[Cell], folder: ResultsFolder, seeds: list[int], progress: Progress | None) -> None:
    """Measure compute times once per agent and id, in the middle cell of the suite: they do not depend on the level."""
    by_agent: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        by_agent.setdefault((cell.env_id, cell.agent), []).append(cell)
    bar = progress.add_task("timing", total=len(by_agent)) if progress else None
    for group in by_agent.values():
        cell = group[len(group) // 2]
        evaluate(cell.env_id, cell.agent, seeds, cell.env_kwargs, folder=folder, timing=True)
        if progress and bar is not None:
            progress.advance(bar)


def _unfinished(cells: Sequence[Cell], folder: ResultsFolder, seeds: Sequence[int]) -> list[Cell]:
    return [cell for cell in cells if not _is_complete(folder.load(cell.env_id, cell.env_kwargs, cell.agent), seeds)]


def _kept(cells: Sequence[Cell], folder: ResultsFolder, seeds: Sequence[int]) -> str:
    finished = len(cells) - len(_unfinished(cells, folder, seeds))
    return f"{finished} of {len(cells)} cells finished; {GO_ON}"


def _is_complete(result: CellResults | None, seeds: Sequence[int]) -> bool:
    return result is not None and set(seeds) <= set(result.seeds)
