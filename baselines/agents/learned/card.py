"""The card of a network: environment, encoding, training and provenance, in JSON."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from servotrack.baselines.agents.protocol import Information
from servotrack.baselines.reporting.files import ResultsError, read_document
from servotrack.baselines.worlds import describe_environment

FORMAT = "servotrack-agent"
FORMAT_VERSION = 1
LARGEST_CARD = 2_000_000
"""Largest accepted size of a card, bytes."""


class AgentFileError(ResultsError):
    """Invalid file of a learned agent; the message names the file and the reason."""


@dataclass(frozen=True)
class LearnedCard:
    """Description of a learned agent, everything but its weights.

    Attributes:
        name: Name of the agent; several cards may share one, each for another environment.
        summary: Description in one line.
        env_id: Gymnasium id of the training environment.
        env_kwargs: Arguments of that environment.
        encoding: Settings of the encoding; see `servotrack.baselines.agents.learned.encoding.create_encoding`.
        network: File name of the ONNX file, in the card's folder.
        sha256: SHA-256 digest of that file.
        memory: Size of the state that the network carries from step to step, 0 for none.
        information: Information that the agent receives about the system.
        levels: Levels of the environment that it was trained in; empty: the one in `env_kwargs` only.
        steps: Environment steps of its training, all runs together.
        training: Algorithm, seed, hyper-parameters, command, versions, machine, the curve of the chosen run, and the
            last evaluation of every run.
    """

    name: str
    summary: str
    env_id: str
    env_kwargs: dict[str, Any]
    encoding: dict[str, Any]
    network: str
    sha256: str
    memory: int = 0
    information: Information = "prior"
    levels: list[int] = field(default_factory=list)
    steps: int = 0
    training: dict[str, Any] = field(default_factory=dict)

    @property
    def environment(self) -> str:
        """Id and arguments in one line."""
        return describe_environment(self.env_id, self.env_kwargs)

    @property
    def environments(self) -> list[str]:
        """Id and arguments in one line, for each level that it was trained in."""
        return [describe_environment(self.env_id, {**self.env_kwargs, "level": level}) for level in self.levels] or [
            self.environment
        ]

    def as_json(self) -> str:
        """Return the card as JSON text."""
        return json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(self)}, indent=1) + "\n"


_TYPES: Mapping[str, type] = {
    "name": str, "summary": str, "env_id": str, "env_kwargs": dict, "encoding": dict, "network": str, "sha256": str,
    "memory": int, "information": str, "levels": list, "steps": int, "training": dict,
}  # fmt: skip


def load_card(path: Path) -> LearnedCard:
    """Read and check a card.

    Args:
        path: A JSON file, or the ONNX file beside it.

    Raises:
        AgentFileError: A missing or invalid card; the message gives the reason.
    """
    path = path.with_suffix(".json")
    if path.is_file() and path.stat().st_size > LARGEST_CARD:
        raise AgentFileError(f"{path} has {path.stat().st_size} bytes, more than the {LARGEST_CARD} allowed for a card")
    try:
        document = read_document(
            path, FORMAT, FORMAT_VERSION, "no card of a learned agent", "give the .json that `servotrack train` wrote"
        )
    except AgentFileError:
        raise
    except ResultsError as error:
        raise AgentFileError(str(error)) from error
    content = {name: value for name, value in document.items() if name not in ("format", "format_version")}
    required = {f.name for f in fields(LearnedCard) if f.default is MISSING and f.default_factory is MISSING}
    if wrong := [*(required - set(content)), *(set(content) - set(_TYPES))]:
        raise AgentFileError(f"{path} has missing or unknown fields {', '.join(sorted(wrong))}")
    for name, value in content.items():
        if not isinstance(value, _TYPES[name]) or isinstance(value, bool):
            raise AgentFileError(f"{path}: {name} must be a {_TYPES[name].__name__}, got {value!r}")
    card = LearnedCard(**content)
    if card.information not in get_args(Information):
        known = ", ".join(get_args(Information))
        raise AgentFileError(f"{path}: information must be one of {known}, got {card.information!r}")
    if Path(card.network).name != card.network:
        raise AgentFileError(f"{path}: network must be a file name in the card's own folder, got {card.network!r}")
    if not all(type(level) is int for level in card.levels):
        raise AgentFileError(f"{path}: levels must be whole numbers, got {card.levels!r}")
    if card.memory < 0 or card.steps < 0:
        raise AgentFileError(f"{path}: memory and steps must be >= 0, got {card.memory} and {card.steps}")
    return card


def digest(content: bytes) -> str:
    """Return the SHA-256 digest of a network's file."""
    return hashlib.sha256(content).hexdigest()
