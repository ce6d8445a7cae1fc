"""Record of a tuning: settings tried, their cost in environment steps, and the chosen setting."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from servotrack.baselines.agents.clutter import tuning_grid as clutter_grid
from servotrack.baselines.agents.color import tuning_grid as color_grid
from servotrack.baselines.agents.follow import tuning_grid as follow_grid
from servotrack.baselines.agents.people import tuning_grid as people_grid
from servotrack.baselines.agents.servo import tuning_grid as servo_grid
from servotrack.baselines.agents.sonar import tuning_grid as sonar_grid
from servotrack.baselines.reporting.files import ResultsError, atomic_path, locked_folder, read_document

FORMAT = "servotrack-tuning"
FORMAT_VERSION = 1
SHIPPED = Path(__file__).with_name("tuning.json")
"""Record behind the servo agents' defaults, of levels 0 to 5."""
SHIPPED_UNSTAMPED = SHIPPED.with_name("tuning-unstamped.json")
"""The same of agents that are searched at level 6."""

Values = dict[str, float]

_GRIDS = (
    servo_grid.GRIDS,
    servo_grid.UNSTAMPED_GRIDS,
    clutter_grid.GRIDS,
    color_grid.GRIDS,
    sonar_grid.GRIDS,
    people_grid.GRIDS,
    follow_grid.GRIDS,
)
TUNED = frozenset().union(*_GRIDS)
"""Agents that have a grid."""
BORROWED = {**servo_grid.BORROWED, **clutter_grid.BORROWED, **follow_grid.BORROWED}
"""Agents that use the values of another agent, besides their own."""


@dataclass
class Candidate:
    """A measured setting.

    Attributes:
        values: Value of each searched hyper-parameter, by path.
        objective: Mean cost of the episodes.
        difference: Objective minus that of the incumbent at the time: `value`, and the interval's `low` and `high`;
            None for the start.
        environment_steps: Environment steps of all episodes.
    """

    values: Values
    objective: float
    difference: dict[str, float] | None
    environment_steps: int


@dataclass
class TunedAgent:
    """The search of one agent.

    Attributes:
        grid: Values tried, by path.
        start: First setting.
        candidates: Measured settings in order; the first is `start`.
        chosen: Best setting.
        provenance: Versions, machine, command, creation time (UTC).
    """

    grid: dict[str, list[float]]
    start: Values
    candidates: list[Candidate]
    chosen: Values
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def environment_steps(self) -> int:
        """Environment steps of all candidates."""
        return sum(candidate.environment_steps for candidate in self.candidates)

    def objective(self, values: Values) -> float:
        """Return the objective measured for a setting."""
        return next(candidate.objective for candidate in self.candidates if candidate.values == values)


@dataclass
class TuningRecord:
    """All searches under one protocol.

    Attributes:
        protocol: Environment, levels, seeds and the constants of the rule.
        agents: Searches by agent name.
    """

    protocol: dict[str, Any]
    agents: dict[str, TunedAgent] = field(default_factory=dict)

    def tuning_steps(self, name: str) -> int | None:
        """Return the environment steps behind an agent's values, borrowed ones included; None if not all are known."""
        if name in servo_grid.UNTUNED:
            return 0
        parts: list[int | None] = []
        if name in TUNED:
            parts.append(self.agents[name].environment_steps if name in self.agents else None)
        if name in BORROWED:
            parts.append(self.tuning_steps(BORROWED[name]))
        known = [part for part in parts if part is not None]
        return sum(known) if parts and len(known) == len(parts) else None

    def save(self, path: Path) -> None:
        """Write the record together with the agents that another process saved; the file is replaced when complete.

        Afterwards the record holds those agents, too.

        Raises:
            ResultsError: An invalid file, or one of another protocol or release (see `resume_record`).
            StorageError: A folder that cannot be written or locked.
        """
        with locked_folder(path.parent):
            self.agents = {**resume_record(path, self.protocol).agents, **self.agents}
            document: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(self)}
            for name, tuned in self.agents.items():
                document["agents"][name]["environment_steps"] = tuned.environment_steps
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_record(path: Path) -> TuningRecord:
    """Read a record.

    Raises:
        ResultsError: An unreadable or corrupt file, or one of another kind or format version.
    """
    remedy = "restore it, or move it away and run `servotrack tune` again"
    document = read_document(path, FORMAT, FORMAT_VERSION, "no record of a tuning", remedy)
    try:
        agents = {name: _tuned(entry) for name, entry in document["agents"].items()}
        protocol = dict(document["protocol"])
        if ":" in protocol["env_id"]:
            raise ValueError("env_id names a module")
        return TuningRecord(protocol, agents)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultsError(f"{path} is corrupt ({type(error).__name__}: {error}); {remedy}") from error


def _tuned(entry: dict[str, Any]) -> TunedAgent:
    candidates = [Candidate(**candidate) for candidate in entry["candidates"]]
    for candidate in candidates:
        numbers = [*candidate.values.values(), candidate.objective, *(candidate.difference or {}).values()]
        if not all(type(number) in (int, float) for number in numbers):
            raise ValueError(f"values, objective and difference must be numbers, got {candidate}")
        if type(candidate.environment_steps) is not int or candidate.environment_steps < 0:
            raise ValueError(f"environment_steps must be integers >= 0, got {candidate.environment_steps!r}")
    if not all(isinstance(tried, list) for tried in entry["grid"].values()):
        raise ValueError(f"grid must hold a list per hyper-parameter, got {entry['grid']}")
    tuned = TunedAgent(entry["grid"], entry["start"], candidates, entry["chosen"], entry["provenance"])
    if tuned.environment_steps != entry["environment_steps"]:
        raise ValueError(f"environment_steps {entry['environment_steps']}, but {tuned.environment_steps} by candidate")
    if not isinstance(tuned.provenance.get("versions"), dict) or "command" not in tuned.provenance:
        raise ValueError("provenance has no versions or no command")
    if tuned.chosen not in [candidate.values for candidate in candidates]:
        raise ValueError(f"chosen {tuned.chosen} was never measured")
    return tuned


def resume_record(path: Path, protocol: dict[str, Any]) -> TuningRecord:
    """Return the record to continue: the file's, or an empty one if there is no file.

    Raises:
        ResultsError: An invalid file (see `read_record`), another protocol, or another release of servotrack.
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
        # The part after + is a digest of the sources. It may differ: agents are not compared with each other here.
        written = str(tuned.provenance["versions"].get("servotrack")).partition("+")[0]
        if written != present:
            raise ResultsError(f"{path}: {name} was tuned with servotrack {written}, this is {present}; {remedy}")
    return record


@lru_cache(maxsize=1)
def _shipped() -> TuningRecord:
    records = [read_record(path) for path in (SHIPPED, SHIPPED_UNSTAMPED) if path.exists()]
    return TuningRecord({}, {name: tuned for record in records for name, tuned in record.agents.items()})


def shipped_tuning_steps(name: str) -> int | None:
    """Return the environment steps behind an agent's defaults, from the package's record; None if not counted.

    Raises:
        ResultsError: A corrupt record.
    """
    return _shipped().tuning_steps(name)
