"""The card of a network: environment, encoding, training and provenance, in JSON."""

from __future__ import annotations

import hashlib
import json
import reprlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from servotrack.baselines.agents.learned.card_fields import check_card
from servotrack.baselines.agents.protocol import Information
from servotrack.baselines.reporting.files import ResultsError, read_bounded
from servotrack.baselines.reporting.strict import parse_json
from servotrack.baselines.worlds import describe_environment

FORMAT = "servotrack-agent"
FORMAT_VERSION = 1
LARGEST_CARD = 2_000_000
"""Largest accepted size of a card, bytes."""
_REMEDY = "give the .json that `servotrack train` wrote"


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


def load_card(path: Path) -> LearnedCard:
    """Read and check a card. It is data: no name in it is imported, and no path in it is opened.

    Args:
        path: A JSON file, or the ONNX file beside it. A regular file, not a symbolic link.

    Raises:
        AgentFileError: A missing or invalid card; the message names the file, the field and its bounds.
    """
    if not path.name:
        raise AgentFileError(f"{path} is no file; {_REMEDY}")
    path = path.with_suffix(".json")
    try:
        document = parse_json(read_bounded(path, LARGEST_CARD, follow=False))
    except ResultsError as error:
        raise AgentFileError(str(error)) from error
    except ValueError as error:
        raise AgentFileError(f"{path} is not valid JSON ({error}); {_REMEDY}") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise AgentFileError(f"{path} is no card of a learned agent; {_REMEDY}")
    version = document.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        raise AgentFileError(
            f"{path} has format version {reprlib.repr(version)}, this servotrack reads {FORMAT_VERSION}; use the "
            f"servotrack that wrote it, or {_REMEDY}"
        )
    content = {name: value for name, value in document.items() if name not in ("format", "format_version")}
    try:
        check_card(content)
    except ValueError as error:
        raise AgentFileError(f"{path}: {error}") from error
    return LearnedCard(**content)


def digest(content: bytes) -> str:
    """Return the SHA-256 digest of a network's file."""
    return hashlib.sha256(content).hexdigest()
