"""Results on disk: one JSON file per (environment with its arguments, agent), with provenance, and never an aggregate.

A file is written under a temporary name in the same folder and then renamed, so that a reader or a killed writer never
leaves half a file. Rows are episodes. Aggregates are never stored;
`servotrack.baselines.evaluation.statistics` computes them.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_document, temporary_in
from servotrack.baselines.worlds import WORLDS, describe_environment, kind_of_id, plain

FORMAT = "servotrack-results"
FORMAT_VERSION = 1

Row = dict[str, Any]


@dataclass
class CellResults:
    """All episodes of one agent in one environment.

    Attributes:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        agent: Name of the agent.
        card: Information and cost of the agent: `information`, `requires`, `tuning_steps`, `summary`.
        max_steps: Steps of a full episode.
        rows: One dictionary per episode; `seed` is the key.
        step_seconds: Durations of single `predict` calls from a pass of its own, unbatched; empty if not measured.
        provenance: Versions, machine, command, creation time (UTC).
        kind: Kind of world, a key of `servotrack.baselines.worlds.WORLDS`; "" for that of the id.
    """

    env_id: str
    env_kwargs: dict[str, Any]
    agent: str
    card: dict[str, Any]
    max_steps: int | None = None
    rows: list[Row] = field(default_factory=list)
    step_seconds: list[float] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=dict)
    kind: str = ""

    def __post_init__(self) -> None:
        self.kind = self.kind or kind_of_id(self.env_id)
        if self.kind not in WORLDS:
            raise ValueError(f"kind must be one of {', '.join(WORLDS)}, got {self.kind!r}")

    @property
    def seeds(self) -> list[int]:
        """Seeds of the finished episodes."""
        return [row["seed"] for row in self.rows]

    @property
    def environment(self) -> str:
        """Id and arguments in one line."""
        return describe_environment(self.env_id, self.env_kwargs)

    def select(self, seeds: list[int]) -> list[Row]:
        """Rows of these seeds, in their order; seeds without a row are left out."""
        by_seed = {row["seed"]: row for row in self.rows}
        return [by_seed[seed] for seed in seeds if seed in by_seed]


def _file_name(text: str) -> str:
    readable = re.sub(r"[^A-Za-z0-9=,.+_-]+", "_", text)
    if readable == text and len(text) <= 100:
        return text
    return f"{readable[:80]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


class ResultsFolder:
    """A folder of results.

    Args:
        path: The folder; made when the first result is saved.

    Raises:
        ResultsError: `path` is a file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise ResultsError(f"{self.path} is a file, not a results folder; choose another path")

    def check_writable(self) -> None:
        """Make the folder and try a write, before hours of work depend on it.

        Raises:
            ResultsError: The folder cannot be made or written.
        """
        temporary_in(self.path, "").unlink()

    def file_of(self, env_id: str, env_kwargs: Mapping[str, Any], agent: str) -> Path:
        """Return the path of a cell's file."""
        return self.path / _file_name(describe_environment(env_id, env_kwargs)) / f"{_file_name(agent)}.json"

    def save(self, cell: CellResults) -> Path:
        """Write a cell; an earlier file is replaced only once the new one is complete."""
        path = self.file_of(cell.env_id, cell.env_kwargs, cell.agent)
        document = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(cell)}
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        return path

    def load(self, env_id: str, env_kwargs: Mapping[str, Any], agent: str) -> CellResults | None:
        """The stored cell, or None if there is none yet.

        Raises:
            ResultsError: The file is corrupt, foreign, of another format, package version, environment or agent.
        """
        path = self.file_of(env_id, env_kwargs, agent)
        if not path.exists():
            return None
        cell = read_cell(path)
        wanted = (env_id, plain(env_kwargs), agent)
        if (cell.env_id, cell.env_kwargs, cell.agent) != wanted:
            raise ResultsError(
                f"{path} holds {cell.agent!r} in {cell.environment}, not {agent!r} in {env_id}; move it away"
            )
        check_version(path, cell)
        return cell

    def load_all(self) -> list[CellResults]:
        """Every cell of the folder, in the order of their paths.

        Raises:
            ResultsError: The folder does not exist or is empty, or a file in it is no result.
        """
        paths = sorted(p for p in self.path.glob("*/*.json") if not p.name.startswith("."))
        if not paths:
            raise ResultsError(f"{self.path} holds no results; run `servotrack bench` or `servotrack evaluate` first")
        cells = [read_cell(path) for path in paths]
        versions = {
            cell.provenance["versions"].get("servotrack"): path for cell, path in zip(cells, paths, strict=True)
        }
        if len(versions) > 1:
            found = ", ".join(f"{version} ({path})" for version, path in versions.items())
            raise ResultsError(
                f"{self.path} mixes results of several servotrack versions: {found}; keep one per folder"
            )
        return cells


def check_version(path: Path, cell: CellResults) -> None:
    """Refuse to extend a file that other code wrote: its rows would not be comparable.

    Raises:
        ResultsError: The versions differ.
    """
    written, present = cell.provenance["versions"].get("servotrack"), code_version()
    if written != present:
        raise ResultsError(
            f"{path} was written by servotrack {written}, this is {present} (after the + a digest of the sources); "
            "choose another folder, or return to that version to extend it"
        )


def read_cell(path: Path) -> CellResults:
    """Read one file.

    Raises:
        ResultsError: The file is unreadable, corrupt, foreign or of another format version.
    """
    remedy = "move it away or restore it; it has been left as it is"
    document = read_document(path, FORMAT, FORMAT_VERSION, "not a servotrack result", remedy)
    names = ("env_id", "env_kwargs", "agent", "card", "max_steps", "rows", "step_seconds", "provenance")
    missing = [name for name in names if name not in document]
    if missing:
        raise ResultsError(f"{path} is corrupt (no {', '.join(missing)}); {remedy}")
    try:
        # Files of version 0.1.0 name no kind: theirs follows from the id.
        cell = CellResults(**{name: document[name] for name in names}, kind=document.get("kind", ""))
    except ValueError as error:
        raise ResultsError(f"{path} cannot be used ({error}); {remedy}") from error
    seeds = [row.get("seed") if isinstance(row, dict) else None for row in cell.rows]
    if None in seeds or len(set(seeds)) != len(seeds) or "versions" not in cell.provenance:
        raise ResultsError(f"{path} is corrupt (rows without a seed of their own, or no versions); {remedy}")
    return cell
