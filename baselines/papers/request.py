"""Records of a reproduction: the paper, the user's recordings, and the request that combines them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rich.console import Console


class Paper(NamedTuple):
    """A paper that `servotrack reproduce` knows.

    Attributes:
        name: Argument of the command. Also the paper's folder, its output file and its marks in a document.
        title: Title in English, authors and year; heading of the output file.
        summary: Experiment in a few words, for the help text.
        run: Reproduction as "module:callable", imported only when it runs. Takes a `Request`.
        default_runs: Runs per algorithm without `--runs`. More runs narrow the intervals.
        takes_recordings: True if it also runs on the user's own sequences.
        takes_into: True if its tables can be put into a Markdown document.
    """

    name: str
    title: str
    summary: str
    run: str
    default_runs: int
    takes_recordings: bool = False
    takes_into: bool = False

    @property
    def command(self) -> str:
        """Command that reproduces the paper."""
        return f"servotrack reproduce {self.name}"


class Recording(NamedTuple):
    """A real sequence of the user.

    Attributes:
        source: Source that `servotrack.envs.track.files.frames.open_frames` accepts.
        truth: File of its true tracks; None if the source is a MOTChallenge folder, which contains them.
    """

    source: str
    truth: str | None


class Request(NamedTuple):
    """One reproduction: the paper, the number of runs, and where the results go.

    Attributes:
        paper: Paper to reproduce.
        output: Folder for the tables, figures and claims.
        runs: Runs per algorithm. In `unscented_jacobian` they differ only for the particle filter, by its random
            numbers.
        console: Console for the tables and the paths of the written files.
        claims: Claims file to fill in; None for a copy of the shipped one in `output`.
        recordings: Sequences of the user, for papers with `takes_recordings`.
        into: Markdown file with marks that also receives the tables, for papers with `takes_into`.
    """

    paper: Paper
    output: Path
    runs: int
    console: Console
    claims: Path | None = None
    recordings: tuple[Recording, ...] = ()
    into: Path | None = None
