"""Commands of the public board: submit, verify."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servotrack.commands.terms import TableFormat, console

if TYPE_CHECKING:
    from servotrack.baselines.board.submit import Candidate
    from servotrack.baselines.board.verification import Verdict
    from servotrack.baselines.reporting.terminal import Screen

DEFAULT_SUITE = "2027a"


def submit(
    agent: Annotated[
        str | None, typer.Argument(help="Name of an agent, or a learned agent's file (.onnx or .json).")
    ] = None,
    suite: Annotated[str, typer.Option(help="Name of a suite, or the path of its .yaml file.")] = DEFAULT_SUITE,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to write. Default: leaderboard/SUITE/NAME.")
    ] = None,
    command: Annotated[
        str | None,
        typer.Option(help='Program that reads observations and writes actions, such as "./agent" or "node agent.js".'),
    ] = None,
    file: Annotated[
        list[Path] | None, typer.Option(help="Further file that the program needs. Repeatable.", exists=True)
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name on the board. Required for programs.")] = None,
    authors: Annotated[str, typer.Option(help="Authors, as the board shows them.")] = "",
    summary: Annotated[str, typer.Option(help="One line about a program.")] = "",
    information: Annotated[
        str,
        typer.Option(help="Information that a program uses: model-free, structure, prior, calibrated or undeclared."),
    ] = "undeclared",
    tuning_steps: Annotated[
        int | None, typer.Option(min=0, help="Environment steps of a program's tuning or training.")
    ] = None,
    cells: Annotated[
        list[str] | None,
        typer.Option("--cell", help="Cell to record, such as UncalibServo-v0,level=3. Repeatable. Default: all."),
    ] = None,
) -> None:
    """Run an agent in a frozen suite and write a submission: its files, rows and action traces."""
    from servotrack.baselines.board import submit as making
    from servotrack.baselines.board.suites import load_suite
    from servotrack.baselines.reporting.terminal import progress_bars
    from servotrack.baselines.running.stopping import keeping

    if (agent is None) == (command is None):
        raise ValueError("give either an agent or --command, not both")
    frozen = load_suite(suite)
    candidate: Candidate
    if command is not None:
        if name is None:
            raise ValueError("--name must be given with --command; it is the agent's name on the board")
        claims: dict[str, Any] = {"summary": summary, "information": information, "tuning_steps": tuning_steps}
        candidate = making.command_candidate(command, name, authors, file or (), claims)
    elif agent is not None and agent.endswith((".json", ".onnx")):
        candidate = making.network_candidate(Path(agent), name, authors)
    else:
        candidate = making.registered_candidate(str(agent), authors)
    chosen = making.chosen_cells(candidate, frozen, cells or ())
    folder = output or Path("leaderboard") / frozen.name / candidate.name
    with progress_bars() as progress, keeping(lambda: "nothing was written; run the same command again"):
        bar = progress.add_task(candidate.name, total=len(chosen))
        making.submit(candidate, frozen, folder, chosen, lambda cell: progress.advance(bar))
    screen = console()
    screen.print(str(folder), soft_wrap=True, markup=False)
    screen.print(f"Next: servotrack verify {folder} --agent", style="dim", soft_wrap=True, markup=False)


def verify(
    folders: Annotated[list[Path], typer.Argument(help="Folders of submissions, or folders that hold some.")],
    agent: Annotated[
        bool,
        typer.Option(
            "--agent", help="Also run each agent again, twice, inside limits, and once more on seeds drawn just now."
        ),
    ] = False,
    suite: Annotated[
        str | None, typer.Option(help="Suite that the submissions must be for, or its .yaml file.")
    ] = None,
    fresh: Annotated[int, typer.Option(min=0, help="Episodes per cell on seeds drawn just now, with --agent.")] = 25,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Replay only so many cells of each submission, drawn at random.")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Also write the verdicts to this file.")] = None,
    table_format: TableFormat = "table",
) -> None:
    """Recompute every row of submissions from their action traces. No foreign code runs without --agent.

    Exits with 1 if a submission is refused or differs.
    """
    from servotrack.baselines.board import verify as verification

    screen = console(table_format)
    found = verification.submission_folders(folders)
    verdicts = verification.verify(found, suite, run=agent, fresh=fresh, sample=sample)
    if output is not None:
        verification.write_verdicts(verdicts, output)
    _show(verdicts, screen)
    if not all(verdict.is_confirmed for verdict in verdicts):
        raise typer.Exit(1)


def _show(verdicts: list[Verdict], screen: Screen) -> None:
    from servotrack.baselines.board.report import problems, verdict_grids
    from servotrack.baselines.reporting.terminal import print_tables

    print_tables(screen, verdict_grids(verdicts))
    for line in problems(verdicts):
        screen.print(line, style="yellow", soft_wrap=True, markup=False)
