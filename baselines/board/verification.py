"""Verification: submitted rows against rows that are recomputed from the traces, and agents run again."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

import servotrack
from servotrack.baselines.agents.learned.card import load_card
from servotrack.baselines.agents.learned.onnx_file.check import check_network
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.arithmetic import arithmetic_digest
from servotrack.baselines.board.recording import AgentPlayer, Player
from servotrack.baselines.board.replay import Episode, ReplayError, replayed
from servotrack.baselines.board.submission import AGENT, PARTS, Part, Submission, read_submission
from servotrack.baselines.board.submit import AGENT_FILE, ARITHMETIC, registered_candidate
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.baselines.evaluation.results import Row
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.reporting.strict import parse_json

CellState = Literal["equal", "close", "different", "stale", "skipped"]
Badge = Literal["self-reported", "replayed", "re-run"]
TOLERANCE = 1e-6
"""Largest relative difference between rows of machines whose arithmetic differs; see `arithmetic_digest`."""
SUSPICIOUS = 4.0
"""Standard errors by which scores on known seeds may exceed those on fresh ones before the verdict says so."""
EARLIER_VERSIONS = ("0.1.0",)
"""Versions of this package that made submissions of its own agents. Add each that is released."""
_LONGEST_TEXT = 400


@dataclass
class CellVerdict:
    """Result of one cell.

    Attributes:
        state: `equal`: every row to the bit; `close`: to 1e-6, submitted from a machine
            of other arithmetic; `different`; `stale`: the world
            behaves differently from that of the frozen suite, so that nothing can be recomputed; `skipped`.
        scores: Recomputed mean score of each part. Empty unless the state is `equal` or `close`.
        detail: First difference in words, "" for none.
        fresh: Mean score on fresh seeds and its standard error; None if the agent was not run.
    """

    state: CellState
    scores: dict[str, float] = field(default_factory=dict)
    detail: str = ""
    fresh: tuple[float, float] | None = None


@dataclass
class Verdict:
    """Result of one submission.

    Attributes:
        folder: Name of the folder.
        name: Name of the agent; "" if the card could not be read.
        kind: Kind of agent: registered, network or command.
        suite: Name of the suite.
        seal: Seal of the card that was verified.
        badge: `re-run`: the agent itself gave these actions, twice; `replayed`: the actions give these rows;
            `self-reported`: neither.
        refused: Reason why the folder is not a valid submission, "" if it is one.
        cells: Result of each cell.
        notes: Reservations, one sentence each.
    """

    folder: str
    name: str = ""
    kind: str = ""
    suite: str = ""
    seal: str = ""
    badge: Badge = "self-reported"
    refused: str = ""
    cells: dict[str, CellVerdict] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def is_confirmed(self) -> bool:
        """True if every cell that was looked at was recomputed as submitted, and nothing is suspicious."""
        states = {cell.state for cell in self.cells.values()}
        return not self.refused and not self.notes and bool(states) and states <= {"equal", "close", "skipped"}

    @property
    def is_whole(self) -> bool:
        """True if it is confirmed and no cell was skipped."""
        return self.is_confirmed and all(cell.state != "skipped" for cell in self.cells.values())

    def mean_score(self, env_id: str, part: Part | Literal["fresh"]) -> float | None:
        """Mean score over the submitted levels of a world; None if a cell of it was not recomputed."""
        cells = [cell for name, cell in self.cells.items() if name.split(",")[0] == env_id]
        if part == "fresh":
            scores = [cell.fresh[0] for cell in cells if cell.fresh is not None]
        else:
            scores = [cell.scores[part] for cell in cells if part in cell.scores]
        return float(np.mean(scores)) if scores and len(scores) == len(cells) else None


def open_submission(folder: Path, suite: Suite | None) -> tuple[Submission | None, Verdict]:
    """Read a submission and begin its verdict; everything that is wrong with it becomes part of the verdict.

    Args:
        folder: The folder.
        suite: The suite; None for the suite of this package that the card names.
    """
    verdict = Verdict(folder.name)
    try:
        submission = read_submission(folder, suite)
        check_agent(submission)
    except (ResultsError, ValueError) as error:
        verdict.refused = _bounded(str(error).replace(f"{folder}/", ""))
        return None, verdict
    verdict.name, verdict.kind = submission.name, submission.kind
    verdict.suite, verdict.seal = submission.suite.name, submission.seal
    return submission, verdict


def check_agent(submission: Submission) -> None:
    """Check the agent's files without running them.

    Raises:
        ValueError: Files that do not belong to the kind of agent, or a network that may not run.
        ResultsError: A card of a network that is not valid.
    """
    files, entry = submission.agent_files, submission.card["agent"]["entry"]
    if submission.kind == "registered":
        _check_registered(submission)
    elif submission.kind == "network":
        if _only(entry) not in files:
            raise ValueError(f"entry must be the card of the network, got {entry[0]}")
        learned = load_card(submission.folder / AGENT / entry[0])
        if set(files) != {entry[0], learned.network}:
            raise ValueError(f"files of a network must be its card and {learned.network}, got {', '.join(files)}")
        check_network(files[learned.network])
    else:
        own = [word[2:] for word in entry if word.startswith("./")]
        if any(word.startswith(("/", "..", "~")) for word in entry) or not set(own) <= set(files):
            raise ValueError(f"entry must name files of the agent as ./name, got {' '.join(entry)}")


def _check_registered(submission: Submission) -> None:
    name = _only(submission.card["agent"]["entry"])
    content = submission.agent_files.get(AGENT_FILE, b"")
    if name != submission.name or len(submission.agent_files) != 1:
        raise ValueError(f"files of {submission.name} must be {AGENT_FILE} alone")
    document = parse_json(content)
    version = document.get("servotrack") if isinstance(document, dict) else None
    if version != servotrack.__version__ and version in EARLIER_VERSIONS:
        # Settings of an earlier version are not known any more. The form leaves no room for anything else.
        fields = {"name": name, "parameters": document.get("parameters"), "servotrack": version}
        if "networks" in document:
            fields["networks"] = document["networks"]
        _compare_agent_file(content, fields, name)
        return
    # These bytes choose the sealed seeds: nothing in them may be free to choose.
    own = registered_candidate(name, "")
    _compare_agent_file(content, json.loads(own.files[AGENT_FILE]), name)
    claims = submission.card["claims"]
    for claim in ("information", "requires", "tuning_steps"):
        if claims[claim] != own.claims[claim]:
            raise ValueError(f"claims.{claim} must be that of this package's {name}, {own.claims[claim]!r}")


def _compare_agent_file(content: bytes, fields: Mapping[str, Any], name: str) -> None:
    if content != (json.dumps(fields, sort_keys=True, indent=1) + "\n").encode("ascii"):
        raise ValueError(f"{AGENT_FILE} must hold name, settings and version of {name} and nothing else")


def _only(entry: Sequence[str]) -> str:
    if len(entry) != 1 or "/" in entry[0] or "\\" in entry[0]:
        raise ValueError(f"entry must be one name, got {' '.join(entry)[:80]}")
    return entry[0]


def replay_all(
    opened: Sequence[tuple[Submission | None, Verdict]], cells: Mapping[str, Sequence[str]] | None = None
) -> None:
    """Recompute the rows of submissions from their traces and complete their verdicts.

    Episodes of all submissions in a cell are replayed side by side, which is many times as fast as one by one.

    Args:
        opened: Submissions with their verdicts, from `open_submission`.
        cells: Names of the cells to replay, by seal; None for all. The others are skipped.
    """
    groups: dict[tuple[int, str], list[tuple[Submission, Verdict, int]]] = {}
    for submission, verdict in opened:
        if submission is None:
            continue
        for index, submitted in enumerate(submission.cells):
            name = submitted.cell.name
            if cells is not None and name not in cells.get(submission.seal, ()):
                verdict.cells[name] = CellVerdict("skipped")
            else:
                groups.setdefault((id(submission.suite), name), []).append((submission, verdict, index))
    for members in groups.values():
        suite, cell = members[0][0].suite, members[0][0].cells[members[0][2]].cell
        if cell.is_stale():
            for _, verdict, _ in members:
                verdict.cells[cell.name] = CellVerdict("stale")
            continue
        episodes = [submission.cells[index].episodes() for submission, _, index in members]
        rows = replayed(suite, cell, [episode for group in episodes for episode in group])
        start = 0
        for (submission, verdict, index), group in zip(members, episodes, strict=True):
            own = rows[start : start + len(group)]
            start += len(group)
            verdict.cells[cell.name] = _compare(submission, index, own)
    for submission, verdict in opened:
        if submission is not None and verdict.is_whole:
            verdict.badge = "replayed"


def _compare(submission: Submission, index: int, rows: Sequence[Row | ReplayError]) -> CellVerdict:
    submitted = submission.cells[index]
    claimed = [row for part in PARTS for row in submitted.rows[part]]
    state: CellState = "equal"
    for row, other in zip(rows, claimed, strict=True):
        if isinstance(row, ReplayError):
            return CellVerdict("different", detail=_bounded(str(row)))
        found = _difference(row, other)
        if found is None:
            continue
        name, size = found
        if size > TOLERANCE or submission.card["provenance"]["machine"].get(ARITHMETIC) == arithmetic_digest():
            text = f"seed {row['seed']}: {name} is {row.get(name)}, submitted {other.get(name)}"
            return CellVerdict("different", detail=_bounded(text))
        state = "close"
    public = len(submitted.rows["public"])
    own = [row for row in rows if not isinstance(row, ReplayError)]
    parts: dict[Part, list[Row]] = {"public": own[:public], "sealed": own[public:]}
    return CellVerdict(state, {part: float(submitted.cell.scores(found).mean()) for part, found in parts.items()})


def _difference(row: Row, other: Row) -> tuple[str, float] | None:
    """Return the first column in which rows differ, with the relative size of the difference; None for none."""
    for name in {**row, **other}:
        if name not in row or name not in other or type(row[name]) is not type(other[name]):
            return name, math.inf
        a, b = row[name], other[name]
        if a == b:
            continue
        if not isinstance(a, float):
            return name, math.inf
        return name, abs(a - b) / max(abs(a), abs(b))
    return None


def agent_player(submission: Submission) -> AgentPlayer:
    """Return a player of a registered agent or a network.

    Raises:
        ValueError: An agent that cannot be made.
        AgentFileError: An invalid file.
    """
    entry = submission.card["agent"]["entry"][0]
    registered = submission.kind == "registered"
    return AgentPlayer(agent_card(entry if registered else str(submission.folder / AGENT / entry)))


def run_again(submission: Submission, verdict: Verdict, players: Sequence[Player], nonce: str, fresh: int) -> None:
    """Run an agent on all its seeds by each player, compare the actions to the bit, and score it on fresh seeds.

    Fresh seeds follow from the agent's files and a number that is drawn after the submission, so that no agent can know
    them. An agent that is better on known seeds has recognized them.

    Args:
        submission: The submission.
        verdict: Verdict of the submission, with the cells replayed.
        players: Separate runs of the agent, each with a memory of its own.
        nonce: Number of the fresh seeds.
        fresh: Fresh episodes in each cell; 0 for none.
    """
    equal = True
    for submitted in submission.cells:
        cell = submitted.cell
        found = verdict.cells.get(cell.name, CellVerdict("skipped"))
        if found.state not in ("equal", "close"):
            continue
        expected = submitted.episodes()
        runs = [player.play(submission.suite, cell, [episode.seed for episode in expected]) for player in players]
        for number, episodes in enumerate(runs):
            if (different := _first_difference(expected, episodes)) is not None:
                equal = False
                found.detail = f"run {number + 1}: {different}"
        if fresh:
            seeds = submission.suite.fresh_seeds(cell, submission.digest, nonce, fresh)
            found.fresh = fresh_score(submission.suite, cell, players[0].play(submission.suite, cell, seeds))
    if not equal:
        verdict.notes.append("The agent gives other actions than the submitted ones.")
    _judge_fresh(submission, verdict)
    if verdict.is_whole:
        verdict.badge = "re-run"


def fresh_score(suite: Suite, cell: SuiteCell, episodes: Sequence[Episode]) -> tuple[float, float]:
    """Return the mean score of episodes and its standard error."""
    rows = [row for row in replayed(suite, cell, episodes) if not isinstance(row, ReplayError)]
    scores = cell.scores(rows)
    return float(scores.mean()), float(scores.std(ddof=1) / math.sqrt(len(scores))) if len(scores) > 1 else 0.0


def _first_difference(expected: Sequence[Episode], episodes: Sequence[Episode]) -> str | None:
    for a, b in zip(expected, episodes, strict=True):
        if a.points.shape != b.points.shape:
            return f"seed {a.seed} takes {len(b.points)} steps, submitted {len(a.points)}"
        if (steps := np.flatnonzero((a.points != b.points).any(axis=1))).size:
            return f"seed {a.seed} has another action at step {steps[0]}"
    return None


def _judge_fresh(submission: Submission, verdict: Verdict) -> None:
    """Add a note if known seeds give better scores than fresh ones, over all cells that have fresh scores."""
    gaps, variances = [], []
    for submitted in submission.cells:
        found = verdict.cells.get(submitted.cell.name)
        if found is None or found.fresh is None:
            continue
        scores = submitted.cell.scores([row for part in PARTS for row in submitted.rows[part]])
        gaps.append(float(scores.mean()) - found.fresh[0])
        variances.append(float(scores.var()) / len(scores) + found.fresh[1] ** 2)
    if not gaps:
        return
    gap, error = float(np.mean(gaps)), math.sqrt(sum(variances)) / len(gaps)
    if gap > SUSPICIOUS * error and gap > TOLERANCE:
        times = gap / max(error, 1e-12)
        verdict.notes.append(
            f"Known seeds give a score {gap:.3f} higher than fresh ones, {times:.1f} standard errors. "
            "The agent may recognize them."
        )


def _bounded(text: str) -> str:
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
