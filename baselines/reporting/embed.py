"""Puts a table into a document, between two marks, so that no figure there was typed by hand."""

from __future__ import annotations

from pathlib import Path

from servotrack.baselines.reporting.files import ResultsError, atomic_path


def embed(text: str, document: Path, name: str) -> None:
    """Replace what stands between `<!-- name:begin -->` and `<!-- name:end -->`.

    Args:
        text: Markdown.
        document: An existing file that has both marks, once each.
        name: The marks' name.

    Raises:
        ResultsError: No such file, or not the two marks in it.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    try:
        old = document.read_text(encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"{document} cannot be read ({error}); give an existing Markdown file") from error
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise ResultsError(f"{document} must have the marks {begin} and {end}, once each and in this order")
    head, rest = old.split(begin)
    tail = rest.split(end)[1]
    with atomic_path(document) as temporary:
        temporary.write_text(f"{head}{begin}\n{text.strip()}\n{end}{tail}", encoding="utf-8")


def show(text: str, document: Path | None, name: str) -> None:
    """Print a text, and `embed` it if a document is given; arguments and errors are those of `embed`."""
    print(text, flush=True)
    if document is not None:
        embed(text, document, name)
