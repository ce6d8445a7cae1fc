"""The card of a submission: agent, claims and digests of all files, in canonical JSON with a seal."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from servotrack.baselines.agents.learned.field_rules import Choice, Many, Number, Plain, Record, Rule, Text, Whole
from servotrack.baselines.agents.protocol import Information

FORMAT, FORMAT_VERSION = "servotrack-submission", 1
LARGEST_CARD = 200_000
"""Largest accepted size of a card, bytes."""
MOST_FILES = 50
"""Largest number of files of an agent."""
KINDS = ("registered", "network", "command")
"""Kinds of agents: one of this package by name, an ONNX network with its card, a program that speaks messages."""

NAME = Text(60, r"[a-z0-9][a-z0-9.+-]*", "a name of lower-case letters, digits, dots, plus signs and hyphens")
FILE_NAME = Text(
    100, r"[A-Za-z0-9_][A-Za-z0-9_.+-]*", "a file name of at most 100 letters, digits, dots, hyphens and underscores"
)
_HEX = Text(64, "[0-9a-f]{64}", "64 hexadecimal digits")


@dataclass(frozen=True)
class Table:
    """A mapping whose keys and values follow one rule each.

    Attributes:
        names: Condition on the keys.
        of: Condition on the values.
        least, most: Bounds of the number of entries.
    """

    names: Rule
    of: Rule
    least: int
    most: int

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a mapping with {self.least} to {self.most} entries, each {self.of.words}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if not isinstance(value, Mapping) or not self.least <= len(value) <= self.most:
            raise ValueError(f"{where} must be {self.words}, got {type(value).__name__}")
        for name, found in value.items():
            self.names.check(name, f"a name in {where}")
            self.of.check(found, f"{where}.{name}")


@dataclass(frozen=True)
class Optional:
    """A value or null.

    Attributes:
        of: Condition on a value that is not null.
    """

    of: Rule

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"null or {self.of.words}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if value is not None:
            self.of.check(value, where)


_CELL_NAME = Text(200, r"[\w.,=+-]+", "the name of a cell")
_AGENT = Record(
    {
        "kind": Choice(KINDS),
        "entry": Many(Text(200), 1, 50),
        "files": Table(FILE_NAME, _HEX, 1, MOST_FILES),
    },
    required=("kind", "entry", "files"),
)
CLAIMS = Record(
    {
        "summary": Text(300),
        "authors": Text(300),
        "information": Choice(get_args(Information)),
        "requires": Many(Choice(("truth",)), 0, 1),
        "tuning_steps": Optional(Whole(0, 10**15)),
        "step_seconds": Optional(Number(0.0, 1e4)),
    },
    required=("summary", "authors", "information", "requires", "tuning_steps", "step_seconds"),
)
"""Conditions on claims, which no verification can confirm."""
_CARD = Record(
    {
        "format": Text(40, FORMAT, FORMAT),
        "format_version": Whole(FORMAT_VERSION, FORMAT_VERSION),
        "suite": Text(40, r"[a-z0-9][a-z0-9.-]*", "the name of a suite"),
        "name": NAME,
        "agent": _AGENT,
        "claims": CLAIMS,
        "cells": Table(_CELL_NAME, Record({"rows": _HEX, "trace": _HEX}, required=("rows", "trace")), 1, 100),
        "provenance": Record(
            {"versions": Table(Text(100), Text(200), 1, 50), "machine": Plain(20, Text(100)), "created": Text(100)},
            required=("versions", "machine", "created"),
        ),
        "seal": _HEX,
    },
    required=("format", "format_version", "suite", "name", "agent", "claims", "cells", "provenance", "seal"),
)


def sealed_card(fields: Mapping[str, Any]) -> bytes:
    """Return the content of a card.

    Args:
        fields: All fields but `format`, `format_version` and `seal`.

    Raises:
        ValueError: A missing, unknown or wrong field.
    """
    document = {"format": FORMAT, "format_version": FORMAT_VERSION, **fields}
    document["seal"] = _seal(document)
    _CARD.check(document, "")
    return _text(document)


def check_card(content: bytes, document: Any) -> None:
    """Check a card of unknown origin.

    Args:
        content: Content of the file.
        document: The parsed content.

    Raises:
        ValueError: A field or value that is not allowed, a wrong seal, or another form than `sealed_card` writes.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"format must be {FORMAT!r}; give a folder that `servotrack submit` wrote")
    _CARD.check(document, "")
    if document["seal"] != _seal({name: value for name, value in document.items() if name != "seal"}):
        raise ValueError("the card or its seal was changed after it was written")
    if content != _text(document):
        raise ValueError("the card must have the spacing and order that `servotrack submit` writes")


def _seal(document: Mapping[str, Any]) -> str:
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def _text(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode("ascii")
