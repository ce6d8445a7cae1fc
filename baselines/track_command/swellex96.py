"""Bearings from the horizontal arrays of the SWellEx-96 experiment, for users who have its files.

`scripts/swellex96 HLA.sio POSITIONS` runs this module. The experiment's pages (swellex96.ucsd.edu; Marine Physical
Laboratory, Scripps Institution of Oceanography) offer the recordings of the events S5 and S59 as SIO files, and the
element positions as text tables. In S5 a ship tows a source past the arrays; in S59 a loud interferer passes too.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.running.stopping import program
from servotrack.baselines.track_command.recording_command import (
    RecordingRequest,
    checked_beamformer,
    frequency_band,
    run_recording,
)
from servotrack.envs.track.files.bounded import read_bounded
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Array

RATE = 3276.8
"""Sampling frequency of the horizontal arrays, Hz."""
MOST_BYTES = 1 << 20
"""Largest accepted size of a table of positions, bytes."""


def read_table(path: Path, columns: tuple[int, int] = (2, 3)) -> Array:
    """Read element positions from a text table of numbers, one element per line.

    Args:
        path: Table with columns set apart by blanks, tabs or commas; lines that do not begin with a number are skipped.
        columns: Numbers of the columns, from 1, that hold x and y, m. The first column is the element's number.

    Returns:
        Places in the order of the lines. Shape (N, 2).

    Raises:
        SequenceError: The file cannot be read, or a line has too few numbers.
    """
    places = []
    text = read_bounded(path, MOST_BYTES, "give a table of positions").decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.replace(",", " ").split()
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            continue
        if not values:
            continue
        if len(values) < max(columns) or not np.isfinite(values).all():
            raise SequenceError(
                f"{path} row {number} must hold finite numbers in {max(columns)} columns, got {line[:60]!r}"
            )
        places.append([values[column - 1] for column in columns])
    if len(places) < 2:
        raise SequenceError(f"{path} must hold the positions of at least two elements, got {len(places)}")
    return np.array(places)


def main(arguments: Sequence[str] | None = None) -> None:
    """Track the bearings of a recording and write tracks, figure and scores."""
    parser = argparse.ArgumentParser(prog="scripts/swellex96", description=__doc__)
    parser.add_argument("recording", type=Path, help="SIO file of HLA North or South")
    parser.add_argument("positions", type=Path, help="text table of the element positions: element, x, y in m")
    parser.add_argument("--columns", default="2,3", help="columns of x and y, from 1 (default 2,3)")
    parser.add_argument("--band", default="50,400", help="band, Hz (default 50,400)")
    parser.add_argument("--rate", type=float, default=RATE, help=f"sampling frequency, Hz (default {RATE})")
    parser.add_argument("--period", type=float, help="duration of a row, s (default: from the array)")
    parser.add_argument("--beamformer", default="conventional", help="conventional or mvdr")
    parser.add_argument("--truth", type=Path, help="CSV of true bearings: time, id, bearing")
    parser.add_argument("--out", type=Path, default=Path("results/swellex96"), help="output folder")
    given = parser.parse_args(arguments)
    with program("run the same command again"):
        try:
            x, y = (int(part) for part in given.columns.split(","))
            request = RecordingRequest(
                given.recording,
                read_table(given.positions, (x, y)),
                frequency_band(given.band),
                given.rate,
                given.period,
                checked_beamformer(given.beamformer),
                given.truth,
            )
            run_recording(request, given.out, Console())
        except (ValueError, SequenceError, ResultsError) as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
