"""Writes the board as a static site: one page, its scripts, and one file of data per task. It also opens from file://."""

from __future__ import annotations

import base64
import dataclasses
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.evaluation.servo_scores import LOST_ERROR
from servotrack.baselines.leaderboard.site import arm_replays, replays
from servotrack.baselines.leaderboard.site.entries import Entry, Proof, summaries_of
from servotrack.baselines.leaderboard.site.tables import agent_facts, episode_values, overall_table, task_table
from servotrack.baselines.leaderboard.summary import TaskSummary, stamp
from servotrack.baselines.reporting.files import atomic_path
from servotrack.envs.track.files.recorded import SequenceError

LARGEST_SITE = 1_450_000
"""Size that the site is kept below by showing fewer shared seeds, bytes."""
MOST_SHARED = 12
"""Largest number of seeds of which every agent's episode can be watched."""
SET_COST = 6
"""Size of a seed with measurements in seeds of an arm. Raising it shows fewer shared seeds with measurements."""
RACERS = ("lifted-kf", "ppo")
"""Opponents of the visitor."""
RACE_EPISODES = 6
"""Largest number of seeds per task on which a visitor can race."""

SCRIPTS = (
    "arm.js", "camera.js", "data.js", "dom.js", "scene.js", "sets.js", "stages.js", "player.js", "plots.js", "board.js",
    "watch.js", "compare.js", "compute.js", "race.js", "proof.js", "main.js",
)  # fmt: skip


@dataclass
class _Task:
    """A task with everything that its file of data is made from."""

    summary: TaskSummary
    entries: dict[str, Entry]
    chunk: str
    motions: dict[str, dict[int, Any]] = field(default_factory=dict)
    scenes: dict[int, Any] = field(default_factory=dict)

    @property
    def cell(self) -> CellResults:
        return next(iter(self.entries.values())).cell

    def values(self, agent: str) -> dict[int, float]:
        """Headline measure by seed."""
        column = self.summary.world.headline.column
        return {row["seed"]: row[column] for row in self.entries[agent].cell.rows if column in row}

    def common_seeds(self) -> list[int]:
        """Seeds that all agents were evaluated on."""
        common = set.intersection(*(set(entry.cell.seeds) for entry in self.entries.values()))
        return sorted(common)

    def labels(self, shared: int) -> dict[str, dict[int, list[str]]]:
        """Seeds to show of every agent, see `replays.chosen_seeds`."""
        shown = shared if self.cell.kind == "servo" else shared // SET_COST
        seeds, good = self.common_seeds()[:shown], self.summary.world.headline.high_is_good
        return {
            agent: replays.chosen_seeds(values, good, seeds) for agent in self.entries if (values := self.values(agent))
        }


def write_site(
    entries: Sequence[Entry],
    folder: Path,
    command: str,
    on_cell: Callable[[str], None] = lambda name: None,
    every_seed: bool = False,
) -> list[Path]:
    """Write the site.

    Args:
        entries: Rows of the board, at least one.
        folder: Output folder, made where it is missing. Files of other names stay.
        command: Command that the page names as its origin.
        on_cell: Called with agent and environment before the replays of a cell are made.
        every_seed: True for replays of all seeds that the agents of a task share, however large the site becomes.

    Returns:
        The paths written; `index.html` is the first.

    Raises:
        ValueError: No entries.
        ResultsError: The folder cannot be written.
    """
    if not entries:
        raise ValueError("entries must hold at least one row, got none; run `servotrack bench` first")
    suites = []
    tasks: list[_Task] = []
    for suite in dict.fromkeys(entry.suite for entry in entries):
        of_suite = [entry for entry in entries if entry.suite == suite]
        made = [
            _Task(summary, _entries_of(summary, of_suite), f"task-{len(tasks) + k}")
            for k, summary in enumerate(summaries_of(of_suite))
        ]
        tasks += made
        suites.append((suite, made))
    for task in tasks:
        _add_motions(task, on_cell, len(task.common_seeds()) * SET_COST if every_seed else MOST_SHARED)
    race = _race(tasks)
    files = {"data/board.js": _script("board", _board(suites, entries, command, race is not None))}
    if race is not None:
        files["data/race.js"] = _script("race", race)
    for name in SCRIPTS:
        files[name] = _asset(name)
    files["board.css"] = _asset("board.css")
    files["index.html"] = _asset("index.html")
    if every_seed:
        files |= _chunks(tasks, max(len(task.common_seeds()) for task in tasks) * SET_COST)
    else:
        files |= _chunks_within(tasks, LARGEST_SITE - sum(len(text.encode()) for text in files.values()))
    written = []
    for name in sorted(files, key=lambda name: name != "index.html"):
        with atomic_path(folder / name) as temporary:
            temporary.write_text(files[name], encoding="utf-8", newline="\n")
        written.append(folder / name)
    return written


def _entries_of(summary: TaskSummary, entries: Sequence[Entry]) -> dict[str, Entry]:
    return {entry.cell.agent: entry for entry in entries if entry.cell.environment == summary.environment}


def _add_motions(task: _Task, on_cell: Callable[[str], None], shared: int) -> None:
    """Replay the episodes of a task: all that have traces, which proves its rows, else those that may be shown."""
    for agent, labels in task.labels(shared).items():
        on_cell(f"{agent} in {task.summary.environment}")
        if not replays.can_replay(task.cell):
            continue
        entry = task.entries[agent]
        whole = dataclasses.replace(entry.cell, rows=[*entry.cell.rows, *entry.sealed])
        seeds = whole.seeds if entry.traced else list(labels)
        try:
            made = replays.replay(whole, entry.actions(whole, sorted(seeds)))
        except SequenceError:
            # A recording that has gone leaves the table without episodes.
            continue
        task.motions[agent] = {seed: made.motions[seed] for seed in labels if seed in made.motions}
        task.scenes |= {seed: made.scenes[seed] for seed in task.motions[agent]}
        if entry.traced:
            proof: Proof = "re-run" if entry.proof == "re-run" else "replayed"
            task.entries[agent] = dataclasses.replace(entry, proof=proof if made.faithful else "self-reported")


def _board(
    suites: Sequence[tuple[str, list[_Task]]], entries: Sequence[Entry], command: str, race: bool
) -> dict[str, Any]:
    """The tables, which the page loads first."""
    return {
        "command": command,
        "race": race,
        "stamp": stamp(entry.cell for entry in entries),
        "agents": agent_facts(entries),
        "suites": [{"name": name, "worlds": _worlds(tasks)} for name, tasks in suites],
    }


def _worlds(tasks: Sequence[_Task]) -> list[dict[str, Any]]:
    """Tasks gathered by world: those of one id that differ by the level alone, and each other one by itself."""
    groups: dict[str, list[_Task]] = {}
    for task in tasks:
        name = task.summary.env_id if task.summary.level is not None else task.summary.environment
        groups.setdefault(name, []).append(task)
    worlds = []
    for name, members in groups.items():
        members.sort(key=lambda task: task.summary.level or 0)
        kind = members[0].summary.world
        worlds.append(
            {
                "name": name,
                "summary": kind.summary,
                "replays": replays.can_replay(members[0].cell),
                "scale": _scale(members[0]),
                "overall": overall_table([task.summary for task in members]) if len(members) > 1 else [],
                "tasks": [{**_table(task), "chunk": task.chunk} for task in members],
            }
        )
    return worlds


def _table(task: _Task) -> dict[str, Any]:
    watchable = {
        agent: {name for seed, names in labels.items() if seed in task.motions.get(agent, {}) for name in names}
        for agent, labels in task.labels(0).items()
    }
    return task_table(task.summary, task.entries, watchable)


def _race(tasks: Sequence[_Task]) -> dict[str, Any] | None:
    """Episodes in which a visitor can race, by task; None if no task has replays of all opponents."""
    courses = []
    for task in tasks:
        if task.cell.kind != "servo" or not all(task.motions.get(agent) for agent in RACERS):
            continue
        seeds = [
            seed
            for seed in task.common_seeds()
            if all(seed in task.motions[agent] for agent in RACERS) and seed in task.scenes
        ][:RACE_EPISODES]
        if not seeds:
            continue
        env = gym.make(task.cell.env_id, **task.cell.env_kwargs)
        try:
            noise = {seed: arm_replays.rate_noise(env, seed) for seed in seeds}
            config = env.unwrapped.config  # type: ignore[attr-defined]
        finally:
            env.close()
        motions = {agent: {seed: task.motions[agent][seed] for seed in seeds} for agent in RACERS}
        names = ("max_joint_rate", "max_motor_torque", "substeps", "solver_iterations")
        courses.append(
            {
                "task": task.summary.environment,
                "level": task.summary.level,
                "settings": {name: getattr(config, name) for name in names},
                "anchors": _score_ends(task),
                "seeds": seeds,
                **arm_replays.pack_race({seed: task.scenes[seed] for seed in seeds}, motions, noise),
            }
        )
    return {"racers": list(RACERS), "lost": LOST_ERROR, "courses": courses} if courses else None


def _score_ends(task: _Task) -> list[float] | None:
    """Errors at which the score is 0 and 1, and the error that is added to each before its logarithm is taken, m."""
    anchors = next(iter(task.entries.values())).anchors
    if anchors is not None:
        return list(anchors)
    anchoring = task.summary.anchoring
    if anchoring is None:
        return None
    added = anchoring.resolution
    means = [float(np.exp(np.log(errors + added).mean())) for errors in (anchoring.lower, anchoring.upper)]
    return [*(float(f"{mean - added:.6g}") for mean in means), added]


def _scale(task: _Task) -> list[str] | None:
    """The score in words: its ends at 0 and at 1, and the error that it is taken of."""
    world, anchors = task.summary.world, next(iter(task.entries.values())).anchors
    ends = world.anchors if anchors is None else world.suite_anchors
    if ends is None:
        return None
    headings = {metric.column: metric.heading for metric in world.shown}
    error = "the mean error after 3 s" if ends.column == "steady" else headings[ends.column]
    if anchors is not None:
        # Only a bound can be 0, and so only with one there is a resolution.
        upper = "the bound" if anchors[2] else f"{ends.upper} ({ends.upper_knows})"
        return [ends.lower, f"{upper}, both frozen with the suite", error]
    anchoring = task.summary.anchoring
    if anchoring is None:
        return None
    return [ends.lower, "the bound" if anchoring.bound else f"{ends.upper} ({ends.upper_knows})", error]


def _chunks_within(tasks: Sequence[_Task], room: int) -> dict[str, str]:
    """Files of data of all tasks, with as many shared seeds as fit into `room` bytes."""
    for shared in range(MOST_SHARED, 0, -1):
        files = _chunks(tasks, shared)
        if sum(map(len, files.values())) <= room:
            return files
    return _chunks(tasks, 0)


def _chunks(tasks: Sequence[_Task], shared: int) -> dict[str, str]:
    """Files of data of all tasks, with a number of shared seeds."""
    files = {}
    for task in tasks:
        document = episode_values(task.summary, task.entries)
        values = {agent: task.values(agent) for agent in task.entries}
        document |= replays.pack(task.motions, task.labels(shared), task.scenes, values)
        files[f"data/{task.chunk}.js"] = _script(task.chunk, document)
    return files


def _script(name: str, document: Mapping[str, Any]) -> str:
    """A document as a script that hands it over: pages from file:// may load scripts, but no data.

    It is compressed JSON in Base64, so that no name in it can end a string or an element.
    """
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    packed = base64.b64encode(zlib.compress(text.encode("ascii"), 9)).decode("ascii")
    return f"servotrack.deliver('{name}','{packed}');\n"


def _asset(name: str) -> str:
    return resources.files(__package__).joinpath("assets", name).read_text(encoding="utf-8")
