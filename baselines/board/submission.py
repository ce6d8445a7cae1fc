"""Submissions: one folder with a card, the agent's files, rows of episodes and traces of actions.

card.json               agent, claims, digests of all other files
agent/                  files of the agent
rows/CELL.json          rows of a cell, public and sealed
traces/CELL.trace       actions of the same episodes; see `trace_files`
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from servotrack.baselines.agents.protocol import Information
from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.board.card import LARGEST_CARD, MOST_FILES, check_card
from servotrack.baselines.board.replay import LONGEST_EPISODE, Episode
from servotrack.baselines.board.sealed_seeds import agent_digest
from servotrack.baselines.board.suites import MOST_EPISODES, Suite, SuiteCell, load_suite
from servotrack.baselines.board.trace_files import LARGEST_TRACE, Trace, decoded
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import CellResults, Row
from servotrack.baselines.evaluation.results_format import FIELDS, check_fields
from servotrack.baselines.reporting.files import ResultsError, read_bounded
from servotrack.baselines.reporting.strict import parse_json

Part = Literal["public", "sealed"]
PARTS: tuple[Part, ...] = get_args(Part)
CARD, AGENT, ROWS, TRACES = "card.json", "agent", "rows", "traces"
ROWS_FORMAT = "servotrack-rows"
ROWS_VERSION = 1
LARGEST_ROWS = 2_000_000
"""Largest accepted size of the rows of a cell, bytes."""
LARGEST_AGENT_FILE = 20_000_000
"""Largest accepted size of a file of an agent, bytes."""
LARGEST_AGENT = 40_000_000
"""Largest accepted size of all files of an agent, bytes."""
_MOST_ENTRIES = MOST_FILES + 250


class SubmissionError(ResultsError):
    """A folder that is not a valid submission; the message names the file and the reason."""


@dataclass(frozen=True)
class SubmittedCell:
    """Episodes of a submission in one cell.

    Attributes:
        cell: The cell of the suite.
        rows: Submitted rows of both parts, in the order of their seeds.
        trace: Actions of the same episodes, first the public, then the sealed ones.
    """

    cell: SuiteCell
    rows: Mapping[Part, Sequence[Row]]
    trace: Trace

    def episodes(self, part: Part | None = None) -> list[Episode]:
        """Seeds and actions of one part, or of both."""
        rows = [row for name in PARTS for row in self.rows[name]]
        found = [Episode(row["seed"], points) for row, points in zip(rows, self.trace.episodes, strict=True)]
        public = len(self.rows["public"])
        return found if part is None else found[:public] if part == "public" else found[public:]


@dataclass(frozen=True)
class Submission:
    """A submission that is whole and well-formed. Nothing in it has been verified yet.

    Attributes:
        folder: The folder.
        card: Checked content of the card.
        suite: The suite.
        cells: Submitted cells in the order of the suite.
        agent_files: Contents of the agent's files by name.
    """

    folder: Path
    card: Mapping[str, Any]
    suite: Suite
    cells: tuple[SubmittedCell, ...]
    agent_files: Mapping[str, bytes]

    @property
    def name(self) -> str:
        """Name of the agent."""
        return self.card["name"]

    @property
    def kind(self) -> str:
        """Kind of agent: registered, network or command."""
        return self.card["agent"]["kind"]

    @property
    def information(self) -> Information:
        """Claimed information that the agent receives."""
        return self.card["claims"]["information"]

    @property
    def seal(self) -> str:
        """Digest that stands for the whole submission."""
        return self.card["seal"]

    @cached_property
    def digest(self) -> str:
        """Digest of the agent's files, which chooses the form of the sealed seeds."""
        return agent_digest(self.agent_files)

    @property
    def is_complete(self) -> bool:
        """True if no cell of the suite is missing."""
        return len(self.cells) == len(self.suite.cells)

    def results(self, part: Part) -> list[CellResults]:
        """Rows as results, one per cell, for summaries and tables; the `provenance` is claimed, not verified."""
        return [_as_results(self.card, submitted.cell, submitted.rows[part]) for submitted in self.cells]


def read_submission(folder: Path, suite: Suite | None = None) -> Submission:
    """Read and check a folder of unknown origin. Nothing in it is run, and no path in it is opened.

    Files are regular, exactly those that the card lists, and have the digests that it lists. Seeds are those that the
    suite and the agent's files demand. Rows are plausible; whether they are true is what `verify` finds.

    Args:
        folder: The folder.
        suite: The suite; None for the suite of this package that the card names.

    Raises:
        SubmissionError: Anything else.
    """
    try:
        return _read(folder, suite)
    except SubmissionError:
        raise
    except ResultsError as error:
        raise SubmissionError(str(error)) from error


def _read(folder: Path, suite: Suite | None) -> Submission:
    found = _regular_files(folder)
    if CARD not in found:
        raise SubmissionError(f"{folder} has no {CARD}; give a folder that `servotrack submit` wrote")
    path = folder / CARD
    content = read_bounded(path, LARGEST_CARD, follow=False)
    card = _checked(path, lambda: _parsed_card(content))
    suite = suite or load_suite(card["suite"])
    if card["suite"] != suite.name:
        raise SubmissionError(f"{path} is for suite {card['suite']!r}, not {suite.name!r}")
    cells = {cell.name: cell for cell in suite.cells}
    if unknown := [name for name in card["cells"] if name not in cells]:
        raise SubmissionError(f"{path}: suite {suite.name} has no cell {unknown[0]!r}")
    expected = {CARD, *(f"{AGENT}/{name}" for name in card["agent"]["files"])}
    expected |= {name for cell in card["cells"] for name in cell_files(cell)}
    if found != expected:
        odd = sorted(found ^ expected)[0]
        raise SubmissionError(f"{folder / odd} is {'not listed in the card' if odd in found else 'missing'}")
    agent_files = _agent_files(folder, card)
    digest = agent_digest(agent_files)
    submitted = tuple(
        _read_cell(folder, card, suite, cell, digest) for name, cell in cells.items() if name in card["cells"]
    )
    return Submission(folder, card, suite, submitted, agent_files)


def _parsed_card(content: bytes) -> dict[str, Any]:
    document = parse_json(content)
    check_card(content, document)
    kind, name = document["agent"]["kind"], document["name"]
    if kind != "registered" and name in AGENTS:
        raise ValueError(f"name must differ from the package's own agents, got {name!r}")
    if kind != "registered" and document["claims"]["requires"]:
        raise ValueError("only agents of the package may see the truth")
    return document


def _checked(path: Path, check: Any) -> Any:
    """Return the result of a check; its ValueError becomes a SubmissionError that names the file."""
    try:
        return check()
    except ValueError as error:
        raise SubmissionError(f"{path}: {error}") from error


def cell_files(cell: str) -> tuple[str, str]:
    """Return the names of a cell's files in a submission: rows and trace."""
    return f"{ROWS}/{cell}.json", f"{TRACES}/{cell}.trace"


def _regular_files(folder: Path) -> set[str]:
    """Return the names of all files, relative to the folder; everything but files in the known folders is refused."""
    found: set[str] = set()
    waiting = [""]
    try:
        if not stat.S_ISDIR(os.lstat(folder).st_mode):
            raise SubmissionError(f"{folder} is not a folder; give one that `servotrack submit` wrote")
        while waiting:
            inner = waiting.pop()
            with os.scandir(folder / inner) as entries:
                for entry in entries:
                    name = f"{inner}/{entry.name}" if inner else entry.name
                    mode = entry.stat(follow_symlinks=False).st_mode
                    if stat.S_ISDIR(mode) and not inner and name in (AGENT, ROWS, TRACES):
                        waiting.append(name)
                    elif stat.S_ISREG(mode):
                        found.add(name)
                    else:
                        raise SubmissionError(f"{folder / inner} holds {entry.name!r}, which is not a regular file")
                    if len(found) > _MOST_ENTRIES:
                        raise SubmissionError(f"{folder} holds more than {_MOST_ENTRIES} files")
    except (OSError, ValueError) as error:
        raise SubmissionError(f"{folder} cannot be read ({getattr(error, 'strerror', None) or error})") from error
    return found


def _agent_files(folder: Path, card: Mapping[str, Any]) -> dict[str, bytes]:
    contents: dict[str, bytes] = {}
    for name, digest in card["agent"]["files"].items():
        contents[name] = _read_listed(folder / AGENT / name, LARGEST_AGENT_FILE, digest)
        if sum(map(len, contents.values())) > LARGEST_AGENT:
            raise SubmissionError(f"{folder / AGENT} has more than {LARGEST_AGENT} bytes")
    return contents


def _read_listed(path: Path, limit: int, digest: str) -> bytes:
    content = read_bounded(path, limit, follow=False)
    if hashlib.sha256(content).hexdigest() != digest:
        raise SubmissionError(f"{path} is not the file that the card lists: its SHA-256 is another one")
    return content


def _read_cell(folder: Path, card: Mapping[str, Any], suite: Suite, cell: SuiteCell, digest: str) -> SubmittedCell:
    listed, (rows_name, trace_name) = card["cells"][cell.name], cell_files(cell.name)
    path = folder / rows_name
    content = _read_listed(path, LARGEST_ROWS, listed["rows"])
    rows = _checked(path, lambda: _parsed_rows(content, card, cell))
    required = {"public": cell.public_seeds, "sealed": suite.sealed_seeds(cell, digest)}
    for part, seeds in required.items():
        if [row["seed"] for row in rows[part]] != seeds:
            why = "the first test seeds" if part == "public" else "those of the form that the agent's files choose"
            raise SubmissionError(f"{path}: {part} seeds must be {why}, {len(seeds)} of them, in order")
    path = folder / trace_name
    content = _read_listed(path, LARGEST_TRACE, listed["trace"])
    lengths = [row["length"] for part in PARTS for row in rows[part]]
    width = action_width(cell)
    trace = _checked(path, lambda: decoded(content, len(lengths), width, suite.grid, LONGEST_EPISODE))
    if trace.lengths != lengths:
        raise SubmissionError(f"{path}: lengths of episodes differ from those of the rows")
    return SubmittedCell(cell, rows, trace)


def action_width(cell: SuiteCell) -> int:
    """Return the number of components of an action in a cell."""
    return _action_width(cell.env_id, json.dumps(cell.env_kwargs))


@lru_cache(maxsize=64)
def _action_width(env_id: str, env_kwargs: str) -> int:
    env = make_vector(env_id, 1, json.loads(env_kwargs), privileged=False)
    try:
        return int(np.prod(env.single_action_space.shape))
    finally:
        env.close()


def rows_text(cell: SuiteCell, rows: Mapping[Part, Sequence[Row]]) -> bytes:
    """Return the content of a file of rows: names of the columns, then one line per episode.

    Args:
        cell: The cell.
        rows: Rows of both parts, all with the same columns.
    """
    columns = list(rows["public"][0])
    lines = [f'"format": "{ROWS_FORMAT}",', f'"format_version": {ROWS_VERSION},', f'"cell": {json.dumps(cell.name)},']
    lines.append(f'"columns": {json.dumps(columns)},')
    for part in PARTS:
        listed = ",\n  ".join(json.dumps([row[name] for name in columns], allow_nan=False) for row in rows[part])
        lines.append(f'"{part}": [\n  {listed}\n ]' + ("," if part == "public" else ""))
    return ("{\n " + "\n ".join(lines) + "\n}\n").encode("ascii")


def _parsed_rows(content: bytes, card: Mapping[str, Any], cell: SuiteCell) -> dict[Part, list[Row]]:
    document = parse_json(content)
    if not isinstance(document, dict) or set(document) != {"format", "format_version", "cell", "columns", *PARTS}:
        raise ValueError(f"it must have format, format_version, cell, columns, {' and '.join(PARTS)}")
    if document["format"] != ROWS_FORMAT or document["format_version"] is not ROWS_VERSION:
        raise ValueError(f"format must be {ROWS_FORMAT!r}, version {ROWS_VERSION}")
    if document["cell"] != cell.name:
        raise ValueError(f"cell must be {cell.name!r}")
    columns = document["columns"]
    if not isinstance(columns, list) or not all(isinstance(name, str) and name.isidentifier() for name in columns):
        raise ValueError("columns must be a list of names")
    if len(set(columns)) != len(columns) or not {"seed", "return", "length"} <= set(columns) or len(columns) > 50:
        raise ValueError("columns must be different, at most 50, with seed, return and length")
    if cell.ends.column not in columns:
        raise ValueError(f"columns must have {cell.ends.column}")
    rows: dict[Part, list[Row]] = {}
    for part in PARTS:
        listed = document[part]
        if not isinstance(listed, list) or len(listed) > MOST_EPISODES:
            raise ValueError(f"{part} must be a list of at most {MOST_EPISODES} rows")
        if not all(isinstance(values, list) and len(values) == len(columns) for values in listed):
            raise ValueError(f"rows in {part} must be lists of {len(columns)} values")
        rows[part] = [dict(zip(columns, values, strict=True)) for values in listed]
        results = _as_results(card, cell, rows[part])
        check_fields({name: getattr(results, name) for name in FIELDS})
        if any(type(row["length"]) is not int or row["length"] > LONGEST_EPISODE for row in rows[part]):
            raise ValueError(f"lengths in {part} must be whole numbers up to {LONGEST_EPISODE}")
    if not rows["public"] or content != rows_text(cell, rows):
        raise ValueError("rows must have the spacing and order that `servotrack submit` writes")
    return rows


def _as_results(card: Mapping[str, Any], cell: SuiteCell, rows: Sequence[Row]) -> CellResults:
    claims = card["claims"]
    return CellResults(
        cell.env_id,
        dict(cell.env_kwargs),
        card["name"],
        {name: claims[name] for name in ("summary", "information", "requires", "tuning_steps")},
        rows=list(rows),
        step_seconds=[] if claims["step_seconds"] is None else [claims["step_seconds"]],
        provenance=dict(card["provenance"]),
    )
