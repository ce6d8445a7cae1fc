"""The README's examples run as they stand there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from servotrack.baselines.evaluation.results import ResultsError
from servotrack.baselines.reporting.embed import embed

README = Path(__file__).parents[1] / "README.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_example_runs(number: int, tmp_path: Path) -> None:
    script = tmp_path / "readme_agent.py"
    script.write_text(EXAMPLES[number].replace("200_050", "200_004"), encoding="utf-8")
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert not run.stderr


def test_readme_has_examples() -> None:
    assert len(EXAMPLES) >= 3


def test_embed_replaces_only_what_stands_between_the_marks(tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("before\n<!-- a:begin -->\nold\n<!-- a:end -->\nafter\n", encoding="utf-8")
    embed("new", document, "a")
    embed("newer", document, "a")
    assert document.read_text(encoding="utf-8") == "before\n<!-- a:begin -->\nnewer\n<!-- a:end -->\nafter\n"


def test_embed_refuses_a_document_without_marks(tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("nothing", encoding="utf-8")
    with pytest.raises(ResultsError, match="a:begin"):
        embed("new", document, "a")
    assert document.read_text(encoding="utf-8") == "nothing"
