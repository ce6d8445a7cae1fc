"""The scripts for other libraries stay short, and scripts/libraries knows each of them."""

from __future__ import annotations

import ast
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "examples" / "libraries").glob("*.py"))
RUNNER = runpy.run_path(str(ROOT / "scripts" / "libraries.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_has_at_most_20_lines_besides_imports(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    body = [node for node in ast.parse(text).body if not isinstance(node, (ast.Import, ast.ImportFrom))]
    first = next(node for node in body if not isinstance(getattr(node, "value", None), ast.Constant)).lineno
    lines = [line for line in text.splitlines()[first - 1 :] if line.strip() and not line.strip().startswith('"""')]
    assert len(lines) <= 20


def test_every_script_is_run_and_stands_in_the_page() -> None:
    run = {name for library in RUNNER["LIBRARIES"].values() for name in library.scripts}
    assert {name.split()[0] for name in run} == {path.name for path in SCRIPTS}
    page = (ROOT / "docs" / "libraries.md").read_text(encoding="utf-8")
    assert not [name for name in run if f"| `{name}` |" not in page]
