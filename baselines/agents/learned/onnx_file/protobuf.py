"""Strict reader of protobuf messages, within bounds of time and memory.

Protobuf lets writers say one thing in several ways, and readers skip what they do not know. This reader refuses unknown
fields, fields that occur more often than they may, and numbers that are longer than needed, so that no other reader can
find anything else in a message.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Encodings of fields."""
LONGEST_TEXT = 300
"""Largest length of a text, bytes."""


class Field(NamedTuple):
    """A field of a message.

    Attributes:
        name: Name in the schema.
        kind: "int", "float" (32 bits), "text", "bytes", "ignored" (skipped), "refused", or the table of a message.
        most: Largest number of occurrences; 1 for a field that is not repeated.
    """

    name: str
    kind: str | Table
    most: int = 1


Table = Mapping[int, Field]
"""Fields of a message by number."""


@dataclass
class Budget:
    """Number of fields and packed numbers that may still be read, which bounds the time of reading.

    Attributes:
        fields: That number.
    """

    fields: int

    def take(self, count: int = 1) -> None:
        """Subtract fields.

        Raises:
            ValueError: None are left.
        """
        self.fields -= count
        if self.fields < 0:
            raise ValueError("the file has too many fields")


def read_message(table: Table, data: memoryview, what: str, budget: Budget) -> dict[str, Any]:
    """Read a message.

    Args:
        table: Fields by number.
        data: The message without its length.
        what: Name of the message, for errors.
        budget: Fields that may still be read.

    Returns:
        Values by name; lists for repeated fields, views of the data for bytes.

    Raises:
        ValueError: Data that is not such a message; the message names the field.
    """
    found: dict[str, Any] = {}
    seen: dict[int, int] = {}
    for number, encoding, value in iterate_fields(data, budget):
        field = table.get(number)
        if field is None:
            raise ValueError(f"{what} has an unknown field {number}: it is not ONNX, or its version is not supported")
        if field.kind == "refused":
            raise ValueError(f"{what} has {field.name}, which is not allowed")
        seen[number] = seen.get(number, 0) + 1
        if seen[number] > field.most:
            times = "twice" if field.most == 1 else f"more than {field.most} times"
            raise ValueError(f"{what} has {field.name} {times}")
        if field.kind == "ignored":
            continue
        where = f"{field.name} of {what}"
        if field.most > 1:
            many: list[Any] = found.setdefault(field.name, [])
            if field.kind in ("int", "float") and encoding == _BYTES:
                many.extend(_packed(field.kind, value, where, budget))
            else:
                many.append(_value(field, encoding, value, where, budget))
            if len(many) > field.most:
                raise ValueError(f"{what} has {field.name} more than {field.most} times")
        else:
            found[field.name] = _value(field, encoding, value, where, budget)
    return found


def _value(field: Field, encoding: int, value: Any, where: str, budget: Budget) -> Any:
    """Convert the value of a field."""
    if not isinstance(field.kind, str):
        if encoding != _BYTES:
            raise ValueError(f"{where} is encoded as another type")
        return read_message(field.kind, value, field.name, budget)
    if encoding != {"int": _VARINT, "float": _FIXED32}.get(field.kind, _BYTES):
        raise ValueError(f"{where} is encoded as another type")
    if field.kind == "int":
        return value - 2**64 if value >= 2**63 else value
    if field.kind == "float":
        return float(np.frombuffer(value, "<f4")[0])
    if field.kind == "bytes":
        return value
    if len(value) > LONGEST_TEXT:
        raise ValueError(f"{where} has {len(value)} bytes, more than {LONGEST_TEXT}")
    try:
        return bytes(value).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{where} is not UTF-8") from error


def _packed(kind: str, data: memoryview, where: str, budget: Budget) -> list[Any]:
    """Read numbers that are packed into one field."""
    if kind == "float":
        budget.take(len(data) // 4)
        if len(data) % 4:
            raise ValueError(f"{where} is truncated")
        return [float(value) for value in np.frombuffer(data, "<f4")]
    numbers, at = [], 0
    while at < len(data):
        budget.take()
        value, at = _varint(data, at)
        numbers.append(value - 2**64 if value >= 2**63 else value)
    return numbers


def iterate_fields(data: memoryview, budget: Budget) -> Iterator[tuple[int, int, Any]]:
    """Split a message into number, encoding and raw value of each field."""
    at, end = 0, len(data)
    while at < end:
        budget.take()
        key, at = _varint(data, at)
        number, encoding = key >> 3, key & 7
        if encoding == _VARINT:
            value, at = _varint(data, at)
            yield number, encoding, value
            continue
        if encoding == _BYTES:
            size, at = _varint(data, at)
        elif encoding in (_FIXED32, _FIXED64):
            size = 4 if encoding == _FIXED32 else 8
        else:
            raise ValueError("the file is not ONNX: it has a field of unknown encoding")
        if number == 0 or size > end - at:
            raise ValueError("the file is not ONNX, or it is truncated")
        yield number, encoding, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Read a number of 1 to 10 bytes; return it and the position behind it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise ValueError("the file is not ONNX, or it is truncated")
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            if value >= 2**64 or (byte == 0 and shift):
                break
            return value, at
    raise ValueError("the file is not ONNX: it has a number that is longer than needed")
