"""Results on disk: one JSON file per (environment with its arguments, agent), with provenance, and never an aggregate.

A file is written under a temporary name in the same folder and then renamed, so that a killed writer never leaves half
a file. Several processes may save into one folder. Rows are episodes. Aggregates are never stored;
`servotrack.baselines.evaluation.statistics` computes them.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.results_format import FIELDS, read_fields, sealed
from servotrack.baselines.reporting.files import ResultsError, atomic_path, locked_folder, temporary_in
from servotrack.baselines.reporting.temporary import PREFIX, remove_abandoned
from servotrack.baselines.worlds import WORLDS, describe_environment, kind_of_id, plain

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
        provenance: Versions, machine, command, creation time (UTC), and the physics engine where there is a choice.
        kind: Kind of world, a key of `servotrack.baselines.worlds.WORLDS`; "" for that of the id.
        has_digests: False for a cell from a file of servotrack 0.1.0, in which later changes cannot be seen.
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
    has_digests: bool = field(default=True, compare=False)

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
        """Make the folder and try a write, before hours of work depend on it; remove what killed writers left there.

        Raises:
            ResultsError: The folder's name is that of a file.
            StorageError: The folder cannot be made or written.
        """
        with temporary_in(self.path, ""):
            pass
        for folder in {path.parent for path in self.path.glob(f"*/{PREFIX}*")}:
            remove_abandoned(folder)

    def file_of(self, env_id: str, env_kwargs: Mapping[str, Any], agent: str) -> Path:
        """Return the path of a cell's file."""
        return self.path / _file_name(describe_environment(env_id, env_kwargs)) / f"{_file_name(agent)}.json"

    def save(self, cell: CellResults) -> Path:
        """Write a cell together with the rows that its file holds; the file is replaced once the new one is complete.

        Several processes may save into one folder: each holds the folder's lock while it reads, merges by seed and
        replaces. The newest step times win. Provenance stays that of the process that made the file.

        Args:
            cell: The cell. Afterwards it holds the rows of the file, too, by seed.

        Returns:
            Path of the file.

        Raises:
            ResultsError: The file holds another row for one of the seeds, or was written by another version or for
                another agent of this name; a value of `cell` cannot be stored.
            StorageError: The folder cannot be written or locked.
        """
        path = self.file_of(cell.env_id, cell.env_kwargs, cell.agent)
        with locked_folder(self.path):
            stored = self.load(cell.env_id, cell.env_kwargs, cell.agent)
            if stored is not None:
                _merge(path, cell, stored)
            cell.rows.sort(key=lambda row: row["seed"])
            try:
                text = sealed({name: getattr(cell, name) for name in FIELDS})
            except (ValueError, TypeError) as error:
                raise ResultsError(f"{path} cannot hold these results ({error}); nothing was written") from error
            with atomic_path(path) as temporary:
                temporary.write_text(text, encoding="ascii")
        return path

    def load(self, env_id: str, env_kwargs: Mapping[str, Any], agent: str) -> CellResults | None:
        """The stored cell, or None if there is none yet.

        Raises:
            ResultsError: The file is corrupt, changed, foreign, of another format, package version, environment or
                agent.
        """
        path = self.file_of(env_id, env_kwargs, agent)
        if not path.exists():
            return None
        cell = self._read(path)
        if (cell.env_id, cell.env_kwargs) != (env_id, plain(env_kwargs)) or cell.agent != agent:
            raise ResultsError(
                f"{path} holds {cell.agent!r} in {cell.environment}, not {agent!r} in {env_id}; move it away"
            )
        check_version(path, cell)
        return cell

    def load_all(self) -> list[CellResults]:
        """Every cell of the folder, in the order of their paths.

        Raises:
            ResultsError: The folder does not exist or is empty; a file in it is no result, or that of another
                environment or agent than its name says, or contradicts the others about its environment.
        """
        paths = sorted(p for p in self.path.glob("*/*.json") if not p.name.startswith("."))
        if not paths:
            raise ResultsError(f"{self.path} holds no results; run `servotrack bench` or `servotrack evaluate` first")
        cells = [self._read(path) for path in paths]
        versions = {cell.provenance["versions"]["servotrack"]: path for cell, path in zip(cells, paths, strict=True)}
        if len(versions) > 1:
            found = ", ".join(f"{version} ({path})" for version, path in versions.items())
            raise ResultsError(
                f"{self.path} mixes results of several servotrack versions: {found}; keep one per folder"
            )
        first: dict[str, tuple[CellResults, Path]] = {}
        for cell, path in zip(cells, paths, strict=True):
            other, other_path = first.setdefault(cell.environment, (cell, path))
            if (cell.kind, cell.env_kwargs) != (other.kind, other.env_kwargs):
                raise ResultsError(
                    f"{path} says kind {cell.kind!r} and arguments {cell.env_kwargs}, {other_path} in the same "
                    f"environment says {other.kind!r} and {other.env_kwargs}; move one of them away"
                )
        return cells

    def _read(self, path: Path) -> CellResults:
        """Read a file and hold its name against its content: a renamed or copied file would pass for another agent's.

        Raises:
            ResultsError: See `read_cell`, or another name.
        """
        cell = read_cell(path)
        own = self.file_of(cell.env_id, cell.env_kwargs, cell.agent)
        if path.parts[-2:] != own.parts[-2:]:
            raise ResultsError(
                f"{path} holds {cell.agent!r} in {cell.environment}, whose file is {own}; move it there or away"
            )
        return cell


def _merge(path: Path, cell: CellResults, stored: CellResults) -> None:
    """Add the stored rows to a cell.

    Raises:
        ResultsError: The cells contradict each other.
    """
    for name in ("kind", "max_steps", "card"):
        old, new = getattr(stored, name), getattr(cell, name)
        if old != new:
            raise ResultsError(
                f"{path}: {name} is {old!r} there and {new!r} in the new results; results of another agent or world "
                "of this name need another folder"
            )
    rows = {row["seed"]: row for row in cell.rows}
    for old_row in stored.rows:
        new_row = rows.setdefault(old_row["seed"], old_row)
        # A key that one of them lacks counts as a difference, too.
        differing = [name for name in {**old_row, **new_row} if old_row.get(name) != new_row.get(name)]
        if differing:
            name = differing[0]
            raise ResultsError(
                f"{path}: seed {old_row['seed']} has {name} {old_row.get(name)} there and {new_row.get(name)} in the "
                "new results of the same version; the computation does not repeat, or two machines differ: choose "
                "another folder"
            )
    cell.rows[:] = rows.values()
    cell.step_seconds = cell.step_seconds or stored.step_seconds
    cell.provenance = stored.provenance


def check_version(path: Path, cell: CellResults) -> None:
    """Refuse to extend a file that other code wrote: its rows would not be comparable.

    Raises:
        ResultsError: The versions differ.
    """
    written, present = cell.provenance["versions"]["servotrack"], code_version()
    if written != present:
        raise ResultsError(
            f"{path} was written by servotrack {written}, this is {present} (after the + a digest of the sources); "
            "choose another folder, or return to that version to extend it"
        )


def read_cell(path: Path) -> CellResults:
    """Read one file.

    Raises:
        ResultsError: The file is unreadable, corrupt, changed, foreign or of another format version.
    """
    fields, has_digests = read_fields(path)
    return CellResults(**fields, has_digests=has_digests)
