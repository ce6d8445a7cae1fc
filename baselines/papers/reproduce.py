"""The papers by name: whose experiments to run again, with ours beside them, and their claims to audit."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from servotrack.baselines.leaderboard.table import Grid
from servotrack.baselines.papers.claims import Claim


class Recording(NamedTuple):
    """A real sequence of the user's.

    Attributes:
        source: What `servotrack.envs.track.files.frames.open_frames` takes.
        truth: File of its true tracks; None where the source is a MOTChallenge folder, which has them.
    """

    source: str
    truth: str | None


class Request(NamedTuple):
    """What is to be reproduced, and how.

    Attributes:
        output: Folder for the tables, figures and claims.
        runs: Runs per algorithm; in "servo" only the particle filter's differ, by its own random numbers.
        console: Where to print.
        claims: Claims file to fill in; None for a copy of the shipped one in `output`.
        recordings: The user's own sequences, for "phd" and "transfer".
        into: A Markdown file with marks that the tables go into, too, for `TAKE_INTO`.
    """

    output: Path
    runs: int
    console: Console
    claims: Path | None = None
    recordings: tuple[Recording, ...] = ()
    into: Path | None = None


def reproduce_paper(
    paper: str,
    output: Path,
    runs: int | None,
    console: Console,
    claims_path: Path | None = None,
    recordings: Sequence[Recording] = (),
    into: Path | None = None,
) -> None:
    """Reproduce one paper.

    Args:
        paper: One of `PAPERS`.
        output: Folder for the tables, figures and claims.
        runs: Runs per algorithm; None for as many as the paper has.
        console: Where to print.
        claims_path: Claims file to fill in; None for a copy of the shipped one in `output`.
        recordings: The user's own sequences, for "phd" and "transfer".
        into: A Markdown file with marks: for "color" `<!-- paper001:begin -->` and `<!-- paper001:end -->`, for "phd"
            likewise with paper000, for "sonar" with paper003, for "transfer" with transfer.

    Raises:
        ValueError: Another paper, or recordings or a file for one that takes none.
        ResultsError: `output` cannot be written.
    """
    if paper not in PAPERS:
        raise ValueError(f"paper must be one of {', '.join(PAPERS)}, got {paper!r}")
    if recordings and paper not in TAKE_RECORDINGS:
        raise ValueError(f"--source goes with {' and '.join(TAKE_RECORDINGS)}, got it with {paper!r}; leave it out")
    if into is not None and paper not in TAKE_INTO:
        raise ValueError(f"--into goes with {' and '.join(TAKE_INTO)}, got it with {paper!r}; leave it out")
    PAPERS[paper](
        Request(output, DEFAULT_RUNS[paper] if runs is None else runs, console, claims_path, tuple(recordings), into)
    )


def _reproduce_servo(request: Request) -> None:
    from servotrack.baselines.papers.unscented_jacobian.report import reproduce_servo

    reproduce_servo(request)


def _reproduce_phd(request: Request) -> None:
    from servotrack.baselines.papers.gm_phd_video.report import reproduce_phd

    reproduce_phd(request)


def _reproduce_transfer(request: Request) -> None:
    from servotrack.baselines.papers.transfer import reproduce_transfer

    reproduce_transfer(request)


def _reproduce_color(request: Request) -> None:
    from servotrack.baselines.papers.monte_carlo_color.report import reproduce_color

    reproduce_color(request)


def _reproduce_sonar(request: Request) -> None:
    from servotrack.baselines.papers.hmm_sonar.report import reproduce_sonar

    reproduce_sonar(request)


def _reproduce_pmm(request: Request) -> None:
    from servotrack.baselines.papers.pairwise_markov.report import reproduce_pmm

    reproduce_pmm(request.output, request.runs, request.console, request.claims)


PAPERS: dict[str, Callable[[Request], None]] = {
    "servo": _reproduce_servo,
    "phd": _reproduce_phd,
    "color": _reproduce_color,
    "sonar": _reproduce_sonar,
    "pmm": _reproduce_pmm,
    "transfer": _reproduce_transfer,
}
TAKE_RECORDINGS = ("phd", "transfer")
TAKE_INTO = ("phd", "color", "sonar", "transfer")
DEFAULT_RUNS = {"servo": 10, "phd": 20, "color": 20, "sonar": 50, "pmm": 500, "transfer": 8}
"""As many as the paper has; papers 000, 001 and 003 have one each, which would say nothing about others."""


def claims_grid(claims: Sequence[Claim]) -> Grid:
    """The claims audit as a table."""
    rows = []
    for claim in claims:
        effect = claim.effect
        shown = "" if effect is None else f"{effect['value']} [{effect['low']}, {effect['high']}] {effect['unit']}"
        rows.append([claim.claim, claim.verdict, shown, claim.finding or ""])
    return Grid(["claim", "verdict", "effect", "finding"], rows, 4)


def command_line() -> str:
    """The command that this process runs."""
    return shlex.join(["servotrack", *sys.argv[1:]])
