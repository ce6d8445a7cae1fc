"""Making of a submission: record an agent in the cells of a suite and write the folder."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from joblib import delayed

from servotrack.baselines.agents.learned.card import load_card
from servotrack.baselines.agents.learned.shipped import shipped_cards
from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.agents.registry import AGENTS, agent_card
from servotrack.baselines.board.arithmetic import arithmetic_digest
from servotrack.baselines.board.card import FILE_NAME, MOST_FILES, NAME, sealed_card
from servotrack.baselines.board.message_agent import MessageAgent
from servotrack.baselines.board.recording import AgentPlayer, Player
from servotrack.baselines.board.replay import Episode, ReplayError, replayed
from servotrack.baselines.board.sealed_seeds import agent_digest
from servotrack.baselines.board.submission import (
    AGENT,
    CARD,
    LARGEST_AGENT_FILE,
    Part,
    SubmissionError,
    cell_files,
    rows_text,
)
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.baselines.board.trace_files import Trace, encoded
from servotrack.baselines.evaluation.bench import TASK_EPISODES
from servotrack.baselines.evaluation.evaluate import time_steps
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import Row
from servotrack.baselines.reporting.files import read_bounded, temporary_folder_in
from servotrack.baselines.running.stopping import undisturbed
from servotrack.baselines.running.workers import in_workers, on_cluster

AGENT_FILE = "agent.json"
"""File that stands for an agent of this package."""
ARITHMETIC = "arithmetic"
"""Entry of a card's machine for the digest of its floating-point results."""
LONGEST_RUN = 3600.0
"""Time that a program has for all episodes of a suite, s."""


@dataclass(frozen=True)
class Candidate:
    """An agent that can be submitted.

    Attributes:
        name: Name on the board.
        kind: Kind of agent; see `servotrack.baselines.board.card.KINDS`.
        entry: Name of the agent's card, or command line of a program.
        files: Contents of the agent's files by name.
        claims: Claims of the card without `step_seconds`.
        environments: Names of the cells that it was made for; None for all.
        card: Card of an agent with `predict`; None for a program.
    """

    name: str
    kind: str
    entry: Sequence[str]
    files: Mapping[str, bytes]
    claims: Mapping[str, Any]
    environments: frozenset[str] | None = None
    card: AgentCard | None = field(default=None, compare=False)


def registered_candidate(name: str, authors: str) -> Candidate:
    """Return one of the package's agents; its file is its name, settings, networks' digests, and the package's version.

    Raises:
        ValueError: No such agent.
    """
    import servotrack

    if name.partition("+")[0] not in AGENTS:
        near = difflib.get_close_matches(name, AGENTS, n=1)
        remedy = f"did you mean {near[0]!r}?" if near else "submit agents of your own as ONNX or by --command"
        raise ValueError(f"the package has no agent {name!r}; {remedy}")
    card = agent_card(name)
    fields = {"name": name, "parameters": dict(card.parameters), "servotrack": servotrack.__version__}
    if networks := {path.name: learned.sha256 for path, learned in shipped_cards().items() if learned.name == name}:
        fields["networks"] = networks
    content = (json.dumps(fields, sort_keys=True, indent=1) + "\n").encode("ascii")
    claims = _claims(card, authors)
    made_for = None if card.trained_in is None else frozenset(card.trained_in)
    return Candidate(name, "registered", [name], {AGENT_FILE: content}, claims, made_for, card)


def network_candidate(path: Path, name: str | None, authors: str) -> Candidate:
    """Return an agent in an ONNX file with its card.

    Args:
        path: The .json or .onnx file.
        name: Name on the board; None for that in the card.
        authors: Authors.

    Raises:
        AgentFileError: A missing or invalid file.
    """
    learned = load_card(path)
    file = path.with_suffix(".json")
    names = (file.name, learned.network)
    files = {each: read_bounded(path.parent / each, LARGEST_AGENT_FILE, follow=False) for each in names}
    card = agent_card(str(file))
    return Candidate(
        name or learned.name,
        "network",
        [file.name],
        files,
        _claims(card, authors),
        frozenset(learned.environments),
        card,
    )


def command_candidate(
    command: str, name: str, authors: str, files: Sequence[Path] = (), claims: Mapping[str, Any] | None = None
) -> Candidate:
    """Return a program that speaks messages.

    Args:
        command: Command line. Every word in it that names a file of the working directory becomes a file of the agent.
        name: Name on the board.
        authors: Authors.
        files: Further files that the program needs.
        claims: `summary`, `information` and `tuning_steps`, where they differ from "", "undeclared" and None.

    Raises:
        ValueError: An empty command, two files of one name, or none at all.
    """
    words = shlex.split(command)
    if not words:
        raise ValueError("--command must name a program, got an empty text")
    contents: dict[str, bytes] = {}
    entry = []
    for word in words:
        path = Path(word)
        own = not path.is_absolute() and path.is_file()
        if own:
            _add_file(contents, path)
        entry.append(f"./{path.name}" if own else word)
    for path in files:
        _add_file(contents, path)
    if not contents:
        raise ValueError(
            f"--command must name a file of the agent, got {command!r}; start it as ./agent or python agent.py, or "
            "give its files with --file"
        )
    plain: dict[str, Any] = {"summary": "", "information": "undeclared", "requires": [], "tuning_steps": None}
    return Candidate(name, "command", entry, contents, {**plain, "authors": authors, **(claims or {})})


def _add_file(contents: dict[str, bytes], path: Path) -> None:
    FILE_NAME.check(path.name, "name of an agent's file")
    content = read_bounded(path, LARGEST_AGENT_FILE)
    if contents.setdefault(path.name, content) != content or len(contents) > MOST_FILES:
        raise ValueError(f"files of an agent must have different names, at most {MOST_FILES}, got {path.name} twice")


def _claims(card: AgentCard, authors: str) -> dict[str, Any]:
    return {
        "summary": card.summary,
        "information": card.information,
        "requires": sorted(card.requires),
        "tuning_steps": card.tuning_steps if card.trained_in is None else sum(card.trained_in.values()),
        "authors": authors,
    }


def chosen_cells(candidate: Candidate, suite: Suite, names: Sequence[str] = ()) -> list[SuiteCell]:
    """Return the cells to record: those of `names`, or all that the agent was made for.

    Raises:
        ValueError: An unknown cell, or none.
    """
    if names:
        wanted = {suite.cell(name).name for name in names}
        return [cell for cell in suite.cells if cell.name in wanted]
    made_for = candidate.environments
    cells = [cell for cell in suite.cells if made_for is None or cell.name in made_for]
    if not cells:
        raise ValueError(f"{candidate.name} was made for {', '.join(sorted(made_for or ()))}, not in {suite.name}")
    return cells


def submit(
    candidate: Candidate,
    suite: Suite,
    folder: Path,
    cells: Sequence[SuiteCell] | None = None,
    on_cell: Callable[[str], None] = lambda name: None,
) -> None:
    """Record an agent on public and sealed seeds and write a submission.

    Actions are rounded to the suite's grid before they reach the environment. The folder appears when it is complete.

    Args:
        candidate: The agent.
        suite: The suite.
        folder: Folder to write. It must not exist.
        cells: Cells; None for all that the agent was made for.
        on_cell: Called with the name of every finished cell.

    Raises:
        SubmissionError: The folder exists, or a world of this package differs from that of the suite.
        MessageError: A program fails.
        ResultsError: The folder cannot be written.
    """
    NAME.check(candidate.name, "name")
    if folder.exists():
        raise SubmissionError(f"{folder} exists; remove it or choose another folder")
    chosen = chosen_cells(candidate, suite) if cells is None else list(cells)
    if stale := [cell.name for cell in chosen if cell.is_stale()]:
        raise SubmissionError(
            f"{stale[0]} of this servotrack differs from that of suite {suite.name}; install the version that froze it"
        )
    digest = agent_digest(candidate.files)
    with temporary_folder_in(folder.parent) as staged:
        for name, content in candidate.files.items():
            _write(staged / AGENT / name, content, executable=candidate.kind == "command")
        listed: dict[str, dict[str, str]] = {}
        with _player(candidate, staged / AGENT) as player:
            seeds = [[*cell.public_seeds, *suite.sealed_seeds(cell, digest)] for cell in chosen]
            for cell, episodes in zip(chosen, _played(player, suite, chosen, seeds), strict=True):
                contents = recorded(suite, cell, episodes)
                for name, content in zip(cell_files(cell.name), contents, strict=True):
                    _write(staged / name, content)
                rows_digest, trace_digest = (hashlib.sha256(content).hexdigest() for content in contents)
                listed[cell.name] = {"rows": rows_digest, "trace": trace_digest}
                on_cell(cell.name)
            seconds = _step_seconds(candidate, player, chosen[len(chosen) // 2])
        record = provenance()
        record["machine"][ARITHMETIC] = arithmetic_digest()
        fields = {
            "suite": suite.name,
            "name": candidate.name,
            "agent": {
                "kind": candidate.kind,
                "entry": list(candidate.entry),
                "files": {name: hashlib.sha256(content).hexdigest() for name, content in candidate.files.items()},
            },
            "claims": {**candidate.claims, "step_seconds": seconds},
            "cells": listed,
            "provenance": {name: record[name] for name in ("versions", "machine", "created")},
        }
        _write(staged / CARD, sealed_card(fields))
        with undisturbed():
            staged.chmod(0o755)
            staged.replace(folder)


def _played(
    player: Player, suite: Suite, cells: Sequence[SuiteCell], seeds: Sequence[Sequence[int]]
) -> Iterator[list[Episode]]:
    """Play cell by cell, on a cluster in tasks of `TASK_EPISODES`; a program runs on this machine."""
    if not (on_cluster() and isinstance(player, AgentPlayer)):
        for cell, of_cell in zip(cells, seeds, strict=True):
            yield player.play(suite, cell, of_cell)
        return
    firsts = [range(0, len(of_cell), TASK_EPISODES) for of_cell in seeds]
    calls = (
        delayed(_played_task)(player.card, suite, cell, of_cell[first : first + TASK_EPISODES], first)
        for cell, of_cell, begins in zip(cells, seeds, firsts, strict=True)
        for first in begins
    )
    parts = in_workers(calls, -1, ordered=True)
    for begins in firsts:
        yield [episode for _ in begins for episode in next(parts)]


def _played_task(card: AgentCard, suite: Suite, cell: SuiteCell, seeds: Sequence[int], first: int) -> list[Episode]:
    """Play some episodes of a cell on a worker, which must register the ids first."""
    import servotrack  # noqa: F401

    return AgentPlayer(card).play(suite, cell, seeds, first)


def recorded(suite: Suite, cell: SuiteCell, episodes: Sequence[Episode]) -> tuple[bytes, bytes]:
    """Replay a cell, public seeds first, and return the contents of its two files, rows and trace."""
    rows: list[Row] = []
    for row in replayed(suite, cell, episodes):
        if isinstance(row, ReplayError):
            raise row
        rows.append(row)
    parts: dict[Part, Sequence[Row]] = {"public": rows[: cell.public], "sealed": rows[cell.public :]}
    trace = Trace(suite.grid, tuple(episode.points for episode in episodes))
    return rows_text(cell, parts), encoded(trace)


@contextlib.contextmanager
def _player(candidate: Candidate, folder: Path) -> Any:
    if candidate.card is not None:
        yield AgentPlayer(candidate.card)
        return
    with MessageAgent(candidate.entry, folder, LONGEST_RUN) as agent:
        yield agent


def _step_seconds(candidate: Candidate, player: Any, cell: SuiteCell) -> float:
    if candidate.card is None:
        durations = player.answer_seconds
    else:
        durations = time_steps(cell.env_id, candidate.card, cell.env_kwargs, cell.public_seeds[0])
    return float(f"{np.median(durations):.3g}")


def _write(path: Path, content: bytes, executable: bool = False) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    if executable:
        path.chmod(0o755)
