"""Parsers of JSON and YAML for files of unknown origin: bounded in depth and size, and without ambiguity.

Python's own parsers accept repeated keys and NaN, and end in a traceback on deep nesting.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

LARGEST_DEPTH = 32
"""Largest accepted nesting of lists and mappings."""
MOST_YAML_VALUES = 20_000
"""Largest accepted number of values in a YAML file. A few lines of aliases can stand for more than a memory holds."""
_LARGEST_INTEGER = 2**64
_TOO_DEEP = f"nested deeper than {LARGEST_DEPTH} levels"
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
_LONGEST_REASON = 500
_SHOWN = 60
"""Characters of a file that a message quotes at most."""


def parse_json(content: bytes) -> Any:
    """Parse a JSON document that says one thing only.

    Args:
        content: UTF-8 text. The parsed document takes up to 25 times as much memory.

    Returns:
        Dictionaries, lists, texts, finite floats, integers below 2^64 in size, booleans and None.

    Raises:
        ValueError: Not UTF-8 or not JSON; nested deeper than 32 levels; a repeated key, NaN, an infinite or an
            oversized number, or half a surrogate pair.
    """
    try:
        document = json.loads(
            content.decode("utf-8"),
            object_pairs_hook=_object,
            parse_constant=_constant,
            parse_float=_float,
            parse_int=_integer,
        )
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error
    _check_depth(document)
    if _SURROGATE.search(content):
        for text in _texts(document):
            text.encode("utf-8")
    return document


def parse_yaml(content: bytes) -> Any:
    """Parse a YAML document of plain values. Aliases are followed as long as they do not multiply.

    Args:
        content: UTF-8 text.

    Raises:
        ValueError: Not UTF-8 or not YAML; nested deeper than 32 levels; a tag that is not YAML's own, a repeated key,
            or more than 20,000 values, those behind aliases counted each time.
    """
    import yaml

    try:
        return yaml.load(content.decode("utf-8"), _strict_loader())
    except yaml.YAMLError as error:
        # The library quotes tags and anchors in full.
        reason = str(error)
        raise ValueError(reason if len(reason) <= _LONGEST_REASON else f"{reason[:_LONGEST_REASON]}...") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{_quoted(repeated)} appears twice")
    return found


def _constant(text: str) -> float:
    raise ValueError(f"{text} is not a number of JSON")


def _float(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{_quoted(text)} is too large for a number")
    return number


def _integer(text: str) -> int:
    # Python's own limit is 4300 digits, and longer ones take quadratic time.
    if len(text) > 21 or abs(int(text)) >= _LARGEST_INTEGER:
        raise ValueError(f"{_quoted(text)} is too large for an integer")
    return int(text)


def _quoted(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def _check_depth(document: Any) -> None:
    """Raises ValueError for deep nesting. Level by level, because recursion is what deep nesting breaks."""
    level, depth = [document], 0
    while level := [value for value in level if isinstance(value, (dict, list))]:
        depth += 1
        if depth > LARGEST_DEPTH:
            raise ValueError(_TOO_DEEP)
        level = [inner for outer in level for inner in (outer.values() if isinstance(outer, dict) else outer)]


def _texts(document: Any) -> Iterator[str]:
    if isinstance(document, str):
        yield document
    elif isinstance(document, dict):
        yield from document
        for value in document.values():
            yield from _texts(value)
    elif isinstance(document, list):
        for value in document:
            yield from _texts(value)


def _strict_loader() -> Any:
    import yaml

    class StrictLoader(yaml.SafeLoader):
        """SafeLoader without repeated keys, and with a bound on the values that aliases write out."""

        def __init__(self, stream: str) -> None:
            super().__init__(stream)
            self._written_out = self._depth = 0
            self._sizes: dict[int, int] = {}

        def compose_node(self, parent: Any, index: Any) -> Any:
            before, is_alias = self._written_out, self.check_event(yaml.AliasEvent)
            line = self.peek_event().start_mark.line + 1
            if self._depth > LARGEST_DEPTH:
                raise ValueError(f"line {line}: {_TOO_DEEP}")
            self._depth += 1
            node = super().compose_node(parent, index)
            self._depth -= 1
            if is_alias and id(node) not in self._sizes:
                raise ValueError(f"line {line}: an alias stands inside the value that it repeats")
            self._written_out += self._sizes[id(node)] if is_alias else 1
            if self._written_out > MOST_YAML_VALUES:
                raise ValueError(f"line {line}: more than {MOST_YAML_VALUES} values, with aliases written out")
            if not is_alias:
                self._sizes[id(node)] = self._written_out - before
            return node

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)
            seen = set()
            for key, _ in node.value:
                name = (key.tag, key.value) if isinstance(key.value, str) else id(key)
                if name in seen:
                    raise ValueError(f"line {key.start_mark.line + 1}: {_quoted(str(key.value))} appears twice")
                seen.add(name)
            return node

    return StrictLoader
