"""Output of a reproduction: tables on the terminal and in files, the claims file, and the figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from servotrack.baselines.papers.claims import Claim, write_claims
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.figure import save_figure
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_sections
from servotrack.baselines.reporting.terminal import command_line, print_tables


def publish(
    request: Request,
    tables: Mapping[str, Grid],
    claims: Sequence[Claim],
    scope: str,
    note: str,
    figures: Mapping[str, Any],
) -> None:
    """Print the tables; write them, all claims and each figure as PNG and SVG; name the files.

    Args:
        request: The paper, the output folder and the console.
        tables: Tables, keyed by title.
        claims: All claims of the claims file, filled in.
        scope: Number of runs in words; follows the command in the introduction.
        note: Conditions and definitions that a reader of the tables needs.
        figures: Matplotlib figures, keyed by file name without suffix.
    """
    paper, output, console = request.paper, request.output, request.console
    print_tables(console, tables)
    console.print(note, style="dim")
    intro = f"Written by `{command_line()}`{scope}. {note}\n\n"
    written = [output / f"{paper.name}.md", request.claims or output / "claims.yaml"]
    with atomic_path(written[0]) as temporary:
        temporary.write_text(f"# {paper.title}\n\n{intro}{as_sections(tables, '##')}", encoding="utf-8")
    write_claims(claims, written[1])
    for name, figure in figures.items():
        for suffix in (".png", ".svg"):
            save_figure(figure, output / f"{name}{suffix}")
            written.append(output / f"{name}{suffix}")
    if request.into is not None:
        embed(intro + as_sections(tables, "###"), request.into, paper.name)
        written.append(request.into)
    for path in written:
        console.print(str(path), soft_wrap=True)
