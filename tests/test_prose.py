"""Docstrings, argument entries and messages are plain English, as in CONTRIBUTING's house style.

`python tests/test_prose.py FILE...` prints the violations of single files.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted(
    path for room in ("package", "envs", "estimators", "baselines", "examples", "scripts", "docs")
    for path in (ROOT / room).rglob("*.py")
)  # fmt: skip
OPENING = re.compile(r"(What|Where|Whether|How|As|Who|Whose|Whom|Of|In|For|By|Its|Their|Every so)\b(?!-)")
PERSON = re.compile(r"\b(told|asked|nobody|whoever|whom|somebody|everybody|anybody)\b", re.IGNORECASE)
ENTRY = re.compile(r"\s+([\w*`, .]+?)( \([^)]*\))?: (.*)")
SECTIONS = ("Args:", "Attributes:", "Returns:", "Raises:", "Yields:")


def violations(source: str) -> Iterator[tuple[int, str]]:
    """Lines and what is wrong with them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            # Identifiers between backticks are names, not words.
            found = PERSON.search(re.sub("`[^`]*`", "", node.value))
            if found:
                line = node.lineno + node.value[: node.value.find(found.group())].count("\n")
                yield line, f"{found.group()!r} stands for a person; write known, given, passed, computed, reported"
        if not isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        text = ast.get_docstring(node, clean=False)
        if text is None:
            continue
        first = node.body[0].lineno
        if OPENING.match(text):
            yield first, f"docstring begins with {text.split()[0]!r}; begin with the thing or the verb"
        section = ""
        for offset, line in enumerate(text.splitlines()):
            if line.strip() in SECTIONS:
                section = line.strip()
            elif not line.strip():
                section = "" if section not in SECTIONS[:2] else section
            elif section in SECTIONS[:2] and (entry := ENTRY.match(line)) and OPENING.match(entry.group(3)):
                yield first + offset, f"entry {entry.group(1)!r} begins with {entry.group(3).split()[0]!r}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_prose_is_plain(path: Path) -> None:
    found = [f"{path.name}:{line}: {what}" for line, what in violations(path.read_text(encoding="utf-8"))]
    assert not found, "\n".join(found)


def test_the_check_finds_what_it_is_for() -> None:
    bad = '''def f(a, b):
    """What a caller is told.

    Args:
        a: Of the sequence.
        b: Number of rows.
    """
    raise ValueError("nobody can read this")
'''
    assert [line for line, _ in sorted(violations(bad))] == [2, 2, 5, 8]


if __name__ == "__main__":
    for name in sys.argv[1:]:
        for line, what in violations(Path(name).read_text(encoding="utf-8")):
            print(f"{name}:{line}: {what}")
