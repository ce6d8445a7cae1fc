"""Format of a results file: fields with their types and ranges, and digests that show every later change."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from servotrack.baselines.reporting.files import ResultsError, read_document
from servotrack.baselines.worlds import WORLDS, kind_of_id

FORMAT = "servotrack-results"
FORMAT_VERSION = 2
UNSEALED_VERSION = 1
"""Format version of servotrack 0.1.0: the same fields without digests. It is read, and never written."""
DIGEST = "sha256"
"""Key of the digests, in the document and in each row."""
IDENTITY = ("env_id", "env_kwargs", "agent")
FIELDS = (*IDENTITY, "kind", "card", "max_steps", "provenance", "step_seconds", "rows")
REMEDY = "move it away or restore it; it has been left as it is"
_canonical = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False).encode
_plain = json.JSONEncoder(allow_nan=False).encode
_UNLIMITED = (-math.inf, math.inf)
_LONGEST_NAME = 500
_ROUNDING = 1e-9
"""Means of values at the end of a range may leave it by rounding, a share of the end."""
_LARGEST_RETURN = 1e15
_LONGEST_VALUE = 80
"""Characters of a value that a message quotes at most."""


def sealed(fields: Mapping[str, Any]) -> str:
    """Return the text of a file: one line per field and per row, with a digest of each.

    Args:
        fields: Values of `FIELDS`.

    Raises:
        ValueError: A value that the format does not allow; the message names the field.
    """
    check_fields(fields)
    identity = [fields[name] for name in IDENTITY]
    rows = [{**row, DIGEST: _digest([*identity, row])} for row in fields["rows"]]
    digests = {name: _digest(fields[name]) for name in FIELDS if name != "rows"}
    digests["rows"] = _digest([row[DIGEST] for row in rows])
    head: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION}
    head |= {name: fields[name] for name in FIELDS if name != "rows"}
    lines = [f'"{name}": {_plain(value)},' for name, value in head.items()]
    listed = ",\n  ".join(_plain(row) for row in rows)
    lines.append(f'"rows": [\n  {listed}\n ],' if rows else '"rows": [],')
    lines.append(f'"{DIGEST}": {_plain(digests)}')
    return "{\n " + "\n ".join(lines) + "\n}\n"


def read_fields(path: Path) -> tuple[dict[str, Any], bool]:
    """Read a file and compare its digests.

    Returns:
        Values of `FIELDS`, and False for a file of format version 1, which has no digests to compare.

    Raises:
        ResultsError: The file is unreadable, corrupt, foreign, of another format version, or was changed after it was
            written. The message names the file and the field.
    """
    document = read_document(path, FORMAT, FORMAT_VERSION, "not a servotrack result", REMEDY, older=(UNSEALED_VERSION,))
    has_digests = document["format_version"] != UNSEALED_VERSION
    if not has_digests and "env_id" in document:
        # Files of version 0.1.0 may name no kind: theirs follows from the id.
        document.setdefault("kind", "")
    try:
        expected = {"format", "format_version", *FIELDS} | ({DIGEST} if has_digests else set())
        _check_names(document, expected)
        if not has_digests:
            _check(isinstance(document["env_id"], str), "env_id", "be a text", document["env_id"])
            # Without "module:": a file must not import what it names.
            document["kind"] = document["kind"] or kind_of_id(document["env_id"].rpartition(":")[2])
        digests = [row.pop(DIGEST, None) for row in _rows_of(document)] if has_digests else []
        check_fields(document)
        if has_digests:
            _compare_digests(document, digests)
    except ValueError as error:
        raise ResultsError(f"{path} is corrupt ({error}); {REMEDY}") from error
    return {name: document[name] for name in FIELDS}, has_digests


def _compare_digests(document: Mapping[str, Any], of_rows: Sequence[Any]) -> None:
    identity = [document[name] for name in IDENTITY]
    expected = document[DIGEST]
    _check(isinstance(expected, dict) and set(expected) == set(FIELDS), DIGEST, "name every field", expected)
    for name in FIELDS:
        if name != "rows" and expected[name] != _digest(document[name]):
            raise ValueError(f"{name} or its digest was changed after it was written")
    for row, digest in zip(document["rows"], of_rows, strict=True):
        if digest != _digest([*identity, row]):
            raise ValueError(f"the row of seed {row['seed']} or its digest was changed after it was written")
    if expected["rows"] != _digest(list(of_rows)):
        raise ValueError("rows: some were added, removed or moved after the file was written")


def _digest(value: Any) -> str:
    """Return the SHA-256 digest of a value's canonical JSON: sorted keys, no spaces."""
    return hashlib.sha256(_canonical(value).encode("ascii")).hexdigest()


def check_fields(fields: Mapping[str, Any]) -> None:
    """Check types and ranges of all fields.

    Args:
        fields: Values of `FIELDS`.

    Raises:
        ValueError: An invalid value; the message names the field, and the seed if it is in a row.
    """
    for name in ("env_id", "agent"):
        value = fields[name]
        valid = isinstance(value, str) and 0 < len(value) <= _LONGEST_NAME and value.isprintable()
        _check(valid, name, f"be a text of 1 to {_LONGEST_NAME} printable characters", value)
    _check(isinstance(fields["env_kwargs"], dict), "env_kwargs", "be an object", fields["env_kwargs"])
    _check(
        isinstance(fields["kind"], str) and fields["kind"] in WORLDS,
        "kind",
        f"be one of {', '.join(WORLDS)}",
        fields["kind"],
    )
    bare = fields["env_id"].rpartition(":")[2]
    own = next((world.kind for world in WORLDS.values() if bare in world.ids), fields["kind"])
    _check(fields["kind"] == own, "kind", f"be {own!r}, the kind of {bare}", fields["kind"])
    steps = fields["max_steps"]
    _check(steps is None or (_is_integer(steps) and steps > 0), "max_steps", "be null or an integer > 0", steps)
    _check_card(fields["card"])
    record = fields["provenance"]
    versions = record.get("versions") if isinstance(record, dict) else None
    valid = isinstance(versions, dict) and all(isinstance(version, str) for version in versions.values())
    _check(valid and "servotrack" in (versions or {}), "provenance", "name the version of servotrack", record)
    engine = record.get("engine", "pymunk")
    _check(isinstance(engine, str), "provenance", "name the engine as text", engine)
    times = fields["step_seconds"]
    _check(isinstance(times, list), "step_seconds", "be a list", times)
    for i, seconds in enumerate(times):
        _check(_is_number(seconds) and seconds >= 0.0, f"step_seconds[{i}]", "be a number >= 0", seconds)
    _check_rows(_rows_of(fields), WORLDS[fields["kind"]].ranges)


def _check_card(card: Any) -> None:
    _check(isinstance(card, dict), "card", "be an object", card)
    valid: Mapping[str, tuple[Callable[[Any], bool], str]] = {
        "summary": (lambda value: isinstance(value, str), "be a text"),
        "information": (lambda value: isinstance(value, str) and value.isprintable(), "be a printable text"),
        "requires": (_is_list_of_texts, "be a list of texts"),
        "tuning_steps": (lambda value: value is None or (_is_integer(value) and value >= 0), "be null or >= 0"),
    }
    for name, (is_valid, what) in valid.items():
        _check(name in card, f"card.{name}", "be there", None)
        _check(is_valid(card[name]), f"card.{name}", what, card[name])


def _check_rows(rows: Sequence[Mapping[str, Any]], ranges: Mapping[str, tuple[float, float]]) -> None:
    limits = {"length": (1.0, math.inf), "return": (-_LARGEST_RETURN, _LARGEST_RETURN), **ranges}
    seen: set[int] = set()
    for i, row in enumerate(rows):
        seed: Any = row.get("seed")
        if not _is_integer(seed) or seed < 0 or seed in seen:
            _check(False, f"rows[{i}].seed", "be an integer >= 0 that no other row has", seed)
        seen.add(seed)
        for name, value in row.items():
            if value is True or value is False:
                valid = name not in limits
            else:
                valid = name != "success" and isinstance(value, (int, float)) and math.isfinite(value)
            if not valid:
                must = "true or false" if name == "success" else "a finite number"
                _check(False, f"rows[{i}].{name}", f"be {must} (seed {seed})", value)
            low, high = limits.get(name, _UNLIMITED)
            if not low * (1.0 - _ROUNDING) <= value <= high * (1.0 + _ROUNDING):
                within = f"lie in {low:g} to {high:g} (seed {seed})"
                _check(False, f"rows[{i}].{name}", within, value)
        if "return" not in row or "length" not in row:
            _check(False, f"rows[{i}]", f"have a return and a length (seed {seed})", row)


def _rows_of(fields: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = fields["rows"]
    _check(isinstance(rows, list) and all(isinstance(row, dict) for row in rows), "rows", "be a list of objects", rows)
    return rows


def _check_names(document: Mapping[str, Any], expected: set[str]) -> None:
    if missing := sorted(expected - set(document)):
        raise ValueError(f"no {', '.join(missing)}")
    if unknown := sorted(set(document) - expected):
        raise ValueError(f"unknown field {_quoted(unknown[0])}")


def _check(valid: bool, name: str, must: str, value: Any) -> None:
    if not valid:
        raise ValueError(f"{name} must {must}, got {_quoted(value)}")


def _quoted(value: Any) -> str:
    # Only the beginning of a large list is turned into text.
    text = repr(value[:_LONGEST_VALUE] if isinstance(value, (str, list)) else value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_list_of_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(text, str) for text in value)
