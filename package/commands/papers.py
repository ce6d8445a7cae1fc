"""The command `reproduce`: tables, figures and claims of the papers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotrack.baselines.papers.reproduce import PAPERS, find_paper, reproduce_paper
from servotrack.baselines.papers.request import Recording
from servotrack.commands.terms import Backend, Scheduler, TableFormat, console


def reproduce(
    paper: Annotated[
        str,
        typer.Argument(help="; ".join(f"`{known.name}`: {known.summary}" for known in PAPERS.values()) + "."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables, figures and claims.")] = Path(
        "results/reproduce"
    ),
    runs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Runs per algorithm; more narrow the intervals. Default: "
            + ", ".join(f"{known.default_runs} for {known.name}" for known in PAPERS.values())
            + ".",
        ),
    ] = None,
    claims: Annotated[Path | None, typer.Option(help="Claims file to fill in. Default: a copy in OUTPUT.")] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(
            "--source",
            "-s",
            help="For " + " and ".join(f"`{known.name}`" for known in PAPERS.values() if known.takes_recordings) + ": "
            "your video or MOTChallenge folder. Repeatable.",
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
    backend: Backend = "processes",
    scheduler: Scheduler = None,
    table_format: TableFormat = "table",
) -> None:
    """Reproduce a paper: tables and figures beside the paper's own, and a verdict on each of its claims."""
    from servotrack.baselines.evaluation.provenance import code_version
    from servotrack.baselines.running.clusters import computing_on

    name = find_paper(paper).name
    sources = source or []
    truths: list[str | None] = [*truth] if truth else [None] * len(sources)
    if len(truths) != len(sources):
        raise ValueError(f"--truth goes with every --source or with none, got {len(truths)} for {len(sources)}")
    recordings = [Recording(s, t) for s, t in zip(sources, truths, strict=True)]
    with computing_on(backend, scheduler, code_version):
        reproduce_paper(name, output, runs, console(table_format), claims, recordings, into)
