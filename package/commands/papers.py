"""The papers' tables, figures and claims."""

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
            help="`servo`: paper 002, the UKF of the image Jacobian; `phd`: paper 000, GM-PHD on video; `color`: paper "
            "001, Monte-Carlo color tracking; `sonar`: paper 003, bearing-time records; `pmm`: paper 004, set filters; "
            "`transfer`: do rankings on rendered people predict those on your sequences?"
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables, figures and claims.")] = Path(
        "results/reproduce"
    ),
    runs: Annotated[int | None, typer.Option(min=1, help="Runs per algorithm; default: as many as the paper.")] = None,
    claims: Annotated[Path | None, typer.Option(help="Claims file to fill in; default: a copy in OUTPUT.")] = None,
    source: Annotated[
        list[str] | None,
        typer.Option("--source", "-s", help="For `phd` and `transfer`: your video or MOTChallenge folder; repeatable."),
    ] = None,
    truth: Annotated[
        list[str] | None,
        typer.Option("--truth", "-t", help="CAVIAR XML or MOTChallenge gt.txt of each SOURCE, in their order."),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            help="For `phd`, `color`, `sonar`, `transfer`: also put the tables between the marks of a Markdown file."
        ),
    ] = None,
) -> None:
    """A paper's tables and figures, ours beside the paper's, and its claims with a verdict each."""
    from servotrack.baselines.papers.reproduce import Recording, reproduce_paper

    sources = source or []
    truths: list[str | None] = [*truth] if truth else [None] * len(sources)
    if len(truths) != len(sources):
        raise ValueError(f"--truth goes with every --source or with none, got {len(truths)} for {len(sources)}")
    recordings = [Recording(s, t) for s, t in zip(sources, truths, strict=True)]
    reproduce_paper(paper, output, runs, console(), claims, recordings, into)
