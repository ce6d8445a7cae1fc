"""Python blocks of a Markdown page, each with the check that stands behind it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

BLOCK = re.compile(
    r"(?:<!-- file: (?P<file>\S+) -->\n)?"
    r"^```python\n(?P<code>.*?)^```\n"
    r"(?:\n?<!-- check: (?P<check>.*?) -->)?",
    re.DOTALL | re.MULTILINE,
)


class Snippet(NamedTuple):
    """One Python block.

    Attributes:
        line: First line of the code in the page.
        code: Text of the block.
        check: Expression that must be true after the block has run; None without one.
        file: File that the block is saved as before it runs; None without one.
    """

    line: int
    code: str
    check: str | None
    file: str | None


def snippets(page: Path) -> list[Snippet]:
    """Return the Python blocks of a page in their order."""
    text = page.read_text(encoding="utf-8")
    return [
        Snippet(text[: found.start("code")].count("\n") + 1, found["code"], found["check"], found["file"])
        for found in BLOCK.finditer(text)
    ]


def run_page(page: Path, folder: Path, namespace: dict[str, object]) -> None:
    """Run all blocks of a page in one namespace and assert their checks.

    Args:
        page: Markdown file.
        folder: Folder for the files that blocks are saved as.
        namespace: Names that the first block finds, such as the path of a film. Changed by the blocks.
    """
    for snippet in snippets(page):
        place = f"{page.name}:{snippet.line}"
        assert snippet.check, f"{place}: a Python block needs <!-- check: EXPRESSION --> behind it"
        if snippet.file:
            (folder / snippet.file).write_text(snippet.code, encoding="utf-8")
        exec(compile("\n" * (snippet.line - 1) + snippet.code, str(page), "exec"), namespace)
        assert eval(snippet.check, namespace), f"{place}: not true after the block: {snippet.check}"
