"""Conditions on the fields of a file of unknown origin; the message for a wrong value names field, value and bounds."""

from __future__ import annotations

import difflib
import math
import re
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol


class Rule(Protocol):
    """Condition that a value must meet."""

    @property
    def words(self) -> str:
        """The condition in words, behind "must be"."""

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for a value that does not meet the condition; `where` names it."""


def _refuse(where: str, words: str, value: Any) -> ValueError:
    return ValueError(f"{where} must be {words}, got {_QUOTES.repr(value)}")


_QUOTES = reprlib.Repr()
_QUOTES.maxstring, _QUOTES.maxother, _QUOTES.maxlist, _QUOTES.maxdict = 60, 60, 4, 4


@dataclass(frozen=True)
class Whole:
    """A whole number.

    Attributes:
        low, high: Bounds, included.
    """

    low: int
    high: int

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a whole number in {self.low} to {self.high}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise _refuse(where, self.words, value)


@dataclass(frozen=True)
class Number:
    """A finite number.

    Attributes:
        low, high: Bounds.
        open: True excludes the bounds.
    """

    low: float
    high: float
    open: bool = False

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a number {'between' if self.open else 'in'} {self.low:g} {'and' if self.open else 'to'} {self.high:g}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if type(value) not in (int, float) or not math.isfinite(value):
            raise _refuse(where, self.words, value)
        inside = self.low < value < self.high if self.open else self.low <= value <= self.high
        if not inside:
            raise _refuse(where, self.words, value)


@dataclass(frozen=True)
class Text:
    """A printable text.

    Attributes:
        longest: Largest number of characters.
        pattern: Regular expression that the whole text must match.
        form: The condition in words; "" for any printable text.
    """

    longest: int
    pattern: str = ".*"
    form: str = ""

    @property
    def words(self) -> str:
        """The condition in words."""
        return self.form or f"a printable text of at most {self.longest} characters"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        valid = isinstance(value, str) and len(value) <= self.longest and value.isprintable()
        if not valid or not re.fullmatch(self.pattern, value):
            raise _refuse(where, self.words, value)


@dataclass(frozen=True)
class Choice:
    """One of several texts.

    Attributes:
        choices: The texts.
        form: The condition in words; "" lists the texts.
    """

    choices: tuple[str, ...]
    form: str = ""

    @property
    def words(self) -> str:
        """The condition in words."""
        return self.form or f"one of {', '.join(self.choices)}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value; the message suggests the nearest choice."""
        if not isinstance(value, str) or value not in self.choices:
            raise ValueError(f"{_refuse(where, self.words, value)}{_suggestion(value, self.choices)}")


@dataclass(frozen=True)
class Many:
    """A list.

    Attributes:
        of: Condition on its items.
        least, most: Bounds of its length.
        ascending: True if each item must exceed the one before it.
    """

    of: Rule
    least: int
    most: int
    ascending: bool = False

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a list of {self.least} to {self.most} items{', ascending' * self.ascending}, each {self.of.words}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if not isinstance(value, (list, tuple)) or not self.least <= len(value) <= self.most:
            raise _refuse(where, self.words, value)
        for k, item in enumerate(value):
            self.of.check(item, f"{where}[{k}]")
        if self.ascending and any(b <= a for a, b in pairwise(value)):
            raise _refuse(where, self.words, value)


@dataclass(frozen=True)
class Plain:
    """A mapping of texts to plain values: numbers, texts, booleans, None, and lists and mappings of them.

    Attributes:
        most: Largest number of values in it.
        names: Condition on the keys of the mapping itself.
    """

    most: int
    names: Rule

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a mapping of names to plain values, at most {self.most}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if not isinstance(value, Mapping):
            raise _refuse(where, self.words, value)
        for name in value:
            self.names.check(name, f"a name in {where}")
        waiting: list[Any] = [value]
        count = 0
        while waiting:
            outer = waiting.pop()
            inner = list(outer.values()) if isinstance(outer, Mapping) else list(outer)
            count += len(inner)
            if count > self.most:
                raise ValueError(f"{where} must be {self.words}, got more")
            for item in inner:
                if isinstance(item, (Mapping, list, tuple)):
                    waiting.append(item)
                elif not (item is None or isinstance(item, (bool, int, str)) or _is_finite(item)):
                    raise _refuse(where, self.words, item)


def _is_finite(value: Any) -> bool:
    return isinstance(value, float) and math.isfinite(value)


@dataclass(frozen=True)
class Record:
    """A mapping with known keys.

    Attributes:
        fields: Condition on each value by its key.
        required: Keys that must be there.
    """

    fields: Mapping[str, Rule]
    required: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The condition in words."""
        return f"a mapping with {', '.join(self.fields)}"

    def check(self, value: Any, where: str) -> None:
        """Raise ValueError for another value."""
        if not isinstance(value, Mapping):
            raise _refuse(where, self.words, value)
        prefix = f"{where}." if where else ""
        for name in value:
            if name not in self.fields:
                near = _suggestion(name, self.fields) or f"; known are {', '.join(self.fields)}"
                raise ValueError(f"{prefix}{_QUOTES.repr(name).strip(chr(39))} is not a known field{near}")
        if missing := [name for name in self.required if name not in value]:
            raise ValueError(f"{prefix}{missing[0]} is missing")
        for name, found in value.items():
            self.fields[name].check(found, f"{prefix}{name}")


def _suggestion(name: Any, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(name)[:60], list(known), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
