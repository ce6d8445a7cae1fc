"""The command `reproduce`: tables, figures and claims of the papers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotrack.commands.terms import (
    console,
)


def reproduce(
    paper: Annotated[
        str,
        typer.Argument(
            help="`gm_phd_video`: GM-PHD filter on video; `monte_carlo_color`: Monte-Carlo color tracking; "
            "`unscented_jacobian`: unscented Kalman filter of the image Jacobian; `hmm_sonar`: hidden Markov models on "
            "bearing-time records; `pairwise_markov`: PHD and CBMeMBer filters under pairwise Markov models; "
            "`transfer`: rank correlation of trackers between rendered people and your sequences."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables, figures and claims.")] = Path(
        "results/reproduce"
    ),
    runs: Annotated[
        int | None,
        typer.Option(min=1, help="Runs per algorithm; more narrow the intervals. Default: 8 to 500, by paper."),
    ] = None,
    claims: Annotated[Path | None, typer.Option(help="Claims file to fill in. Default: a copy in OUTPUT.")] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(
            "--source",
            "-s",
            help="For `gm_phd_video` and `transfer`: your video or MOTChallenge folder. Repeatable.",
        ),
    ] = None,
    truth: Annotated[
        list[str] | None,
        typer.Option("--truth", "-t", help="CAVIAR XML or MOTChallenge gt.txt of each SOURCE, in the same order."),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            help="Markdown file that also receives the tables, between the marks <!-- PAPER:begin --> and "
            "<!-- PAPER:end -->."
        ),
    ] = None,
) -> None:
    """Reproduce a paper: tables and figures beside the paper's own, and a verdict on each of its claims."""
    from servotrack.baselines.papers.reproduce import find_paper, reproduce_paper
    from servotrack.baselines.papers.request import Recording

    name = find_paper(paper).name
    sources = source or []
    truths: list[str | None] = [*truth] if truth else [None] * len(sources)
    if len(truths) != len(sources):
        raise ValueError(f"--truth goes with every --source or with none, got {len(truths)} for {len(sources)}")
    recordings = [Recording(s, t) for s, t in zip(sources, truths, strict=True)]
    reproduce_paper(name, output, runs, console(), claims, recordings, into)
