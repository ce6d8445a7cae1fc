"""The record of a tuning: what was tried, what it cost in environment steps, and what was chosen."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from servotrack.baselines.agents.servo.tuning_grid import BORROWED, GRIDS, UNTUNED
from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_document

FORMAT = "servotrack-tuning"
FORMAT_VERSION = 1
SHIPPED = Path(__file__).with_name("tuning.json")

Values = dict[str, float]


@dataclass
class Candidate:
    """One setting that was measured.

    Attributes:
        values: Path to number, all of the agent's searched hyper-parameters.
        objective: Mean cost of its episodes.
        difference: Its objective less the incumbent's at the time: `value`, and the interval's `low` and `high`; None
            for the setting that the search began with.
        environment_steps: Steps of all its episodes.
    """

    values: Values
    objective: float
    difference: dict[str, float] | None
    environment_steps: int


@dataclass
class TunedAgent:
    """The search of one agent.

    Attributes:
        grid: Path to the values tried.
        start: The setting that it began with.
        candidates: In the order in which they were measured; the first is `start`.
        chosen: The setting that it ended with.
        provenance: Versions, machine, command, creation time (UTC).
    """

    grid: dict[str, list[float]]
    start: Values
    candidates: list[Candidate]
    chosen: Values
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def environment_steps(self) -> int:
        """Steps of all candidates."""
        return sum(candidate.environment_steps for candidate in self.candidates)

    def objective(self, values: Values) -> float:
        """What was measured for a setting."""
        return next(candidate.objective for candidate in self.candidates if candidate.values == values)


@dataclass
class TuningRecord:
    """All searches under one protocol.

    Attributes:
        protocol: Environment, levels, seeds and the constants of the rule.
        agents: Name to search.
    """

    protocol: dict[str, Any]
    agents: dict[str, TunedAgent] = field(default_factory=dict)

    def tuning_steps(self, name: str) -> int | None:
        """Environment steps behind an agent's values, those behind borrowed values included; None: not all counted."""
        if name in UNTUNED:
            return 0
        parts: list[int | None] = []
        if name in GRIDS:
            parts.append(self.agents[name].environment_steps if name in self.agents else None)
        if name in BORROWED:
            parts.append(self.tuning_steps(BORROWED[name]))
        known = [part for part in parts if part is not None]
        return sum(known) if parts and len(known) == len(parts) else None

    def save(self, path: Path) -> None:
        """Write it; an earlier file is replaced only once the new one is complete.

        Raises:
            ResultsError: The folder cannot be written.
        """
        document: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(self)}
        for name, tuned in self.agents.items():
            document["agents"][name]["environment_steps"] = tuned.environment_steps
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_record(path: Path) -> TuningRecord:
    """Read a record.

    Raises:
        ResultsError: The file is unreadable, corrupt, foreign or of another format version.
    """
    remedy = "restore it, or move it away and run `servotrack tune` again"
    document = read_document(path, FORMAT, FORMAT_VERSION, "no record of a tuning", remedy)
    try:
        agents = {name: _tuned(entry) for name, entry in document["agents"].items()}
        return TuningRecord(dict(document["protocol"]), agents)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultsError(f"{path} is corrupt ({type(error).__name__}: {error}); {remedy}") from error


def _tuned(entry: dict[str, Any]) -> TunedAgent:
    candidates = [Candidate(**candidate) for candidate in entry["candidates"]]
    tuned = TunedAgent(entry["grid"], entry["start"], candidates, entry["chosen"], entry["provenance"])
    if tuned.environment_steps != entry["environment_steps"]:
        raise ValueError(f"environment_steps {entry['environment_steps']}, but {tuned.environment_steps} by candidate")
    if not {"versions", "command"} <= set(tuned.provenance):
        raise ValueError("provenance has no versions or no command")
    if tuned.chosen not in [candidate.values for candidate in candidates]:
        raise ValueError(f"chosen {tuned.chosen} was never measured")
    return tuned


def resume_record(path: Path, protocol: dict[str, Any]) -> TuningRecord:
    """The record to go on with: the file's, or an empty one where there is none.

    Raises:
        ResultsError: As `read_record`; or the file has another protocol, or is of another release of servotrack.
    """
    if not path.exists():
        return TuningRecord(protocol)
    record = read_record(path)
    remedy = "choose another --output, or move it away"
    if record.protocol != protocol:
        other = [key for key in protocol if record.protocol.get(key) != protocol[key]]
        raise ResultsError(f"{path} was written under another protocol (different: {', '.join(other)}); {remedy}")
    present = metadata.version("servotrack")
    for name, tuned in record.agents.items():
        # What follows the + is a digest of the sources: agents are not compared with each other here, so it may differ.
        written = str(tuned.provenance["versions"].get("servotrack")).partition("+")[0]
        if written != present:
            raise ResultsError(f"{path}: {name} was tuned with servotrack {written}, this is {present}; {remedy}")
    return record


@lru_cache(maxsize=1)
def _shipped() -> TuningRecord:
    return read_record(SHIPPED) if SHIPPED.exists() else TuningRecord({})


def shipped_tuning_steps(name: str) -> int | None:
    """Environment steps behind an agent's defaults, from the record in the package; None where nobody counted.

    Raises:
        ResultsError: That record is corrupt.
    """
    return _shipped().tuning_steps(name)
