"""What every reproduction of a paper ends with: tables on the terminal and in files, claims, figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from servotrack.baselines.evaluation.results import atomic_path
from servotrack.baselines.leaderboard.figure import save_figure
from servotrack.baselines.leaderboard.table import Grid, as_rich, as_sections
from servotrack.baselines.papers.claims import Claim, write_claims
from servotrack.baselines.papers.reproduce import Request, command_line
from servotrack.baselines.reporting.embed import embed


def publish(
    request: Request,
    paper: str,
    tables: Mapping[str, Grid],
    claims: Sequence[Claim],
    scope: str,
    note: str,
    figures: Mapping[str, Any],
) -> None:
    """Print the tables; write them, all claims and each figure as PNG and SVG; name the files.

    Args:
        request: Where to.
        paper: Three digits.
        tables: By their titles.
        claims: All of the claims file, filled in.
        scope: How much was run; stands behind the command.
        note: What a reader of the tables has to know.
        figures: Matplotlib figures by the names of their files.
    """
    output, console = request.output, request.console
    for title, grid in tables.items():
        console.print(as_rich(grid, title))
    console.print(note, style="dim")
    intro = f"Written by `{command_line()}`{scope}. {note}\n\n"
    written = [output / f"paper{paper}.md", request.claims or output / "claims.yaml"]
    with atomic_path(written[0]) as temporary:
        temporary.write_text(f"# Paper {paper}\n\n{intro}{as_sections(tables, '##')}", encoding="utf-8")
    write_claims(claims, written[1])
    for name, figure in figures.items():
        for suffix in (".png", ".svg"):
            save_figure(figure, output / f"{name}{suffix}")
            written.append(output / f"{name}{suffix}")
    if request.into is not None:
        embed(intro + as_sections(tables, "###"), request.into, f"paper{paper}")
        written.append(request.into)
    for path in written:
        console.print(str(path), soft_wrap=True)
