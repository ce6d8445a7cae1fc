"""Records of a reproduction: the paper, the user's recordings, and the request that combines them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rich.console import Console


class Paper(NamedTuple):
    """A paper that `servotrack reproduce` knows.

    Attributes:
        name: Argument of the command; also names the folder, the output file and the marks in a document.
        title: Title in English, authors and year; heading of the output file.
        summary: Experiment in a few words, for the help text.
        run: Reproduction as "module:callable", imported only when it runs. Takes a `Request`.
        default_runs: Runs per algorithm without `--runs`. More runs narrow the intervals.
        takes_recordings: True if it also runs on the user's own sequences.
    """

    name: str
    title: str
    summary: str
    run: str
    default_runs: int
    takes_recordings: bool = False

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
        into: Markdown file with the marks `<!-- NAME:begin -->` and `<!-- NAME:end -->` that also receives the tables.
    """

    paper: Paper
    output: Path
    runs: int
    console: Console
    claims: Path | None = None
    recordings: tuple[Recording, ...] = ()
    into: Path | None = None
