"""Rows of the board before they are summarized: results with their proof and, where there are traces, their actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from servotrack.baselines.agents.registry import AGENTS, agent_card, create_agent
from servotrack.baselines.board.action_grid import ActionGrid
from servotrack.baselines.board.replay import make_replay_env
from servotrack.baselines.board.submission import CARD, Submission, SubmittedCell, read_submission
from servotrack.baselines.board.verification import Badge, CellVerdict, Verdict
from servotrack.baselines.board.verify import read_verdicts
from servotrack.baselines.evaluation import statistics
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder, Row
from servotrack.baselines.leaderboard.summary import AgentSummary, TaskSummary, summarize
from servotrack.baselines.reporting.files import ResultsError
from servotrack.estimators.types import Array

Proof = Badge
"""Check behind a row: its trace was replayed, its agent was run again, or neither."""
VERDICTS = "verdicts.json"
"""Name of the file of verdicts beside the submissions of a suite."""

ActionsOf = Callable[[CellResults, Sequence[int]], Mapping[int, Array]]
"""Function that returns the actions of episodes by seed, each (length, n); seeds without a trace are left out."""


@dataclass(frozen=True)
class Entry:
    """One agent in one environment.

    Attributes:
        suite: Name of the suite, "" for results outside a suite.
        cell: Results; those of a submission hold its episodes on public seeds.
        proof: Check behind the rows.
        stale: True if the package's rollouts have changed since the rows were made.
        actions: Source of the episodes' actions.
        traced: True if `actions` reads a trace of every episode, False if it runs the agent.
        scores: Scores of the episodes by the suite's frozen anchors, shape (rows,); None: by the agents of the table.
        anchors: Errors at which the suite's score is 0 and 1, and the resolution, in the unit of the rows.
        sealed: Rows of the episodes on seeds that follow from the agent's files.
        sealed_scores: Scores of these episodes, shape (len(sealed),).
        fresh: Mean score on seeds that the verifier drew, and its standard error; None if the agent was not run.
    """

    suite: str
    cell: CellResults
    proof: Proof
    stale: bool
    actions: ActionsOf
    traced: bool = False
    scores: Array | None = None
    anchors: tuple[float, float, float] | None = None
    sealed: Sequence[Row] = ()
    sealed_scores: Array | None = None
    fresh: tuple[float, float] | None = None


def entries_of(folder: Path, verdicts: Path | None = None) -> list[Entry]:
    """Read a folder of submissions, of results, or of folders of results as `servotrack bench` makes them.

    Submissions lie in SUITE/AGENT; see `servotrack.baselines.board.submission`.

    Args:
        folder: The folder.
        verdicts: File that `servotrack verify --output` wrote, which says whose agents were run again; None for
            `verdicts.json` in the folder of each suite, if there is one.

    Raises:
        ResultsError: There are neither, or a file is damaged.
    """
    if cards := sorted(folder.glob(f"*/*/{CARD}")):
        found: dict[str, Verdict] = {}
        for path in [verdicts] if verdicts else sorted(folder.glob(f"*/{VERDICTS}")):
            found |= read_verdicts(path)
        return [entry for card in cards for entry in _submitted_entries(read_submission(card.parent), found)]
    folders = [folder] if any(folder.glob("*/*.json")) else sorted({p.parents[1] for p in folder.glob("*/*/*.json")})
    if not folders:
        raise ResultsError(f"{folder} holds no submissions and no results; run `servotrack bench` first")
    return [
        Entry("", cell, "self-reported", False, rerun_actions)
        for results in folders
        for cell in ResultsFolder(results).load_all()
        if cell.rows
    ]


def _submitted_entries(submission: Submission, verdicts: Mapping[str, Verdict]) -> list[Entry]:
    entries = []
    verdict = verdicts.get(submission.seal)
    parts = zip(submission.cells, submission.results("public"), submission.results("sealed"), strict=True)
    for submitted, public, sealed in parts:
        confirmed = _confirmed(verdict, submitted.cell.name)
        entries.append(
            Entry(
                submission.suite.name,
                public,
                "self-reported" if verdict is None or confirmed is None else verdict.badge,
                submitted.cell.is_stale(),
                _traced_actions(submission, submitted),
                traced=True,
                scores=submitted.cell.scores(public.rows),
                anchors=(*submitted.cell.anchors, submitted.cell.resolution),
                sealed=sealed.rows,
                sealed_scores=submitted.cell.scores(sealed.rows),
                fresh=None if confirmed is None else confirmed.fresh,
            )
        )
    return entries


def _confirmed(verdict: Verdict | None, cell: str) -> CellVerdict | None:
    """Verdict of a cell, if it and the whole submission were confirmed."""
    found = None if verdict is None or not verdict.is_confirmed else verdict.cells.get(cell)
    return found if found is not None and found.state in ("equal", "close") else None


def _traced_actions(submission: Submission, submitted: SubmittedCell) -> ActionsOf:
    def actions(cell: CellResults, seeds: Sequence[int]) -> Mapping[int, Array]:
        env = make_replay_env(submitted.cell, 1)
        try:
            grid = ActionGrid.of(env.single_action_space, submission.suite.grid)
        finally:
            env.close()
        wanted = set(seeds)
        return {
            episode.seed: np.asarray(grid.actions(episode.points), dtype=np.float64)
            for episode in submitted.episodes()
            if episode.seed in wanted
        }

    return actions


def rerun_actions(cell: CellResults, seeds: Sequence[int]) -> Mapping[int, Array]:
    """Run a registered agent again and return its actions by seed, each (length, n).

    Agents that this package does not have yield nothing: no foreign code is run.

    Args:
        cell: Results of the agent, which name the environment.
        seeds: Seeds of the episodes.
    """
    if cell.agent not in AGENTS or not seeds:
        return {}
    card = agent_card(cell.agent)
    env = make_vector(cell.env_id, len(seeds), cell.env_kwargs, privileged=card.privileged)
    try:
        agent = create_agent(card, env)
        observation, _ = env.reset(seed=list(seeds))
        state, starts, ended = None, np.ones(len(seeds), dtype=bool), np.zeros(len(seeds), dtype=bool)
        over = ended
        taken: list[list[Array]] = [[] for _ in seeds]
        while not over.all():
            action, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
            for row in np.flatnonzero(~over):
                taken[row].append(np.array(action[row], dtype=np.float64))
            observation, _, terminated, truncated, _ = env.step(action)
            # In Gymnasium's next-step mode the step after an end only resets: its observation starts an episode.
            starts, ended = ended, terminated | truncated
            over = over | ended
    finally:
        env.close()
    return {seed: np.stack(rows) for seed, rows in zip(seeds, taken, strict=True)}


def summaries_of(entries: Sequence[Entry]) -> list[TaskSummary]:
    """Summarize the entries of one suite; scores are those of the suite's frozen anchors where it has some."""
    by_cell = {(entry.cell.environment, entry.cell.agent): entry for entry in entries}
    return [
        _rescored(task, {row.agent: by_cell[task.environment, row.agent] for row in task.rows})
        for task in summarize([entry.cell for entry in entries])
    ]


def _rescored(task: TaskSummary, entries: Mapping[str, Entry]) -> TaskSummary:
    if any(entry.scores is None for entry in entries.values()):
        return task

    def rescored(row: AgentSummary) -> AgentSummary:
        scores = entries[row.agent].scores
        assert scores is not None
        worst = statistics.worst_tenth(scores, high_is_bad=False)
        return replace(row, scores=scores, score=statistics.bootstrap_mean(scores), worst_score=worst)

    rows = sorted(map(rescored, task.rows), key=lambda row: -row.score.value if row.score else 0.0)
    return replace(task, rows=tuple(rows), notes=tuple(note for note in task.notes if "score" not in note.lower()))
