"""`servotrack track recording.wav`: beamform hydrophone channels, track bearings, report and score."""

from __future__ import annotations

import csv
import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console

from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.bearing_figure import draw_bearings
from servotrack.baselines.reporting.figure import save_figure
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid
from servotrack.baselines.reporting.terminal import print_tables, progress_bars
from servotrack.baselines.track_command.claim import claim_folder
from servotrack.baselines.track_command.set_scores import SCORE_FILES, SetScoring, write_set_scores
from servotrack.envs.track.files.recordings import BearingTruth, read_bearing_truth, read_recording
from servotrack.estimators.sonar import BearingRecord, BearingTrack, ElementArray, bearing_record
from servotrack.estimators.sonar.beamforming import Beamformer
from servotrack.estimators.types import Array

TRACKS, FIGURE = "tracks.csv", "tracks.png"
"""Names of the files that every run writes."""
OUTPUTS = (TRACKS, FIGURE, *SCORE_FILES)
"""Names of all files that a run may write."""
CUTOFF = 5.0
"""Cut-off of the scores, deg."""


@dataclass(frozen=True)
class RecordingRequest:
    """A recording and how to beamform it.

    Attributes:
        source: .wav, .npy or .sio file.
        positions: Places of the elements, m. Shape (N, 2) or (N, 3).
        band: Lowest and highest frequency, Hz.
        rate: Sampling frequency, Hz; None: that of the file.
        period: Duration of a row, s; None: from the array.
        beamformer: `conventional` or `mvdr`.
        truth: CSV file of true bearings; None: no scores.
    """

    source: Path
    positions: Array
    band: tuple[float, float]
    rate: float | None = None
    period: float | None = None
    beamformer: Beamformer = "conventional"
    truth: Path | None = None


def frequency_band(text: str) -> tuple[float, float]:
    """Return the limits of a band given as LOW,HIGH in Hz."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"band must be LOW,HIGH in Hz such as 200,400, got {text!r}") from None
    return low, high


def checked_beamformer(name: str) -> Beamformer:
    """Return the name of a beamformer, checked."""
    known: tuple[Beamformer, ...] = get_args(Beamformer)
    for beamformer in known:
        if beamformer == name:
            return beamformer
    raise ValueError(f"beamformer must be one of {', '.join(known)}, got {name!r}")


def run_recording(request: RecordingRequest, out: Path, console: Console) -> None:
    """Track the bearings in a recording, and write the tracks, a figure and, with a truth, scores.

    Args:
        request: The recording.
        out: Folder for all output.
        console: Console for the report.

    Raises:
        SequenceError: A file cannot be used.
        ValueError: Positions, band or rate do not fit the recording.
        ResultsError: The folder cannot be written, or holds files of these names that are not of an earlier run.
    """
    array = ElementArray(request.positions)
    recording = read_recording(request.source, request.rate)
    ResultsFolder(out).check_writable()
    claim_folder(out, OUTPUTS, {"source": str(request.source), "tracker": "hmm-row"})
    with progress_bars() as progress:
        task = progress.add_task("beamforming")
        record = bearing_record(
            recording.samples,
            recording.rate,
            array,
            request.band,
            period=request.period,
            beamformer=request.beamformer,
            progress=lambda done, rows: progress.update(task, completed=done, total=rows),
        )
    truth = None if request.truth is None else read_bearing_truth(request.truth, record.times)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RuntimeWarning)
        tracks = record.tracker.track(record.powers)
    notes = [*record.notes, *(str(one.message) for one in caught if issubclass(one.category, RuntimeWarning))]
    print_tables(console, {f"{request.source.name}: {len(record.times)} rows": _array_grid(record)})
    write_bearings(out / TRACKS, record, tracks)
    save_figure(draw_bearings(record, tracks, None if truth is None else truth.bearings), out / FIGURE)
    written = [TRACKS, FIGURE]
    if truth is not None:
        written += _score(request.source, record, tracks, truth, out, console)
    for name in OUTPUTS:
        # Files of an earlier run would be mistaken for this one's.
        if name not in written:
            (out / name).unlink(missing_ok=True)
    for name in written:
        console.print(str(out / name), soft_wrap=True)
    for note in notes:
        console.print(f"note: {note}", style="cyan", soft_wrap=True)
    console.print(f"{len(record.times)} rows, {len(tracks)} tracks")


def write_bearings(path: Path, record: BearingRecord, tracks: list[BearingTrack]) -> None:
    """Write tracks as CSV, one row per identity and row of the record, whole or not at all.

    Columns: label, time (s), presence, bearing (deg), rate (deg/s), deviation (deg).
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["label", "time", "presence", "bearing", "rate", "deviation"])
    for track in tracks:
        columns = track.presence, track.bearings, track.rates, track.deviations
        for k, values in enumerate(zip(*columns, strict=True)):
            writer.writerow([track.label, *(repr(float(v)) for v in (record.times[track.first + k], *values))])
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")


def _array_grid(record: BearingRecord) -> Grid:
    """Table of the receiver as it was derived."""
    tracker = record.tracker
    array, band = tracker.array, tracker.band
    assert isinstance(array, ElementArray)
    sides = (
        f"0 to 180 deg from the axis at {array.heading % 360.0:.4g} deg; both sides look the same"
        if array.is_line
        else "0 to 360 deg from x towards y"
    )
    low, high = tracker.patterns.widths
    rows = [
        ["elements", f"{array.elements}", "on a line" if array.is_line else "in a plane"],
        ["bearings", f"{len(tracker.beam_bearings)} beams", sides],
        ["beam width", f"{tracker.patterns.width:.3g} deg", f"half power; {low:.3g} to {high:.3g} deg within the band"],
        ["band", f"{band.frequencies[0]:.4g} to {band.frequencies[-1]:.4g} Hz", f"bins of {band.step:.3g} Hz"],
        ["row", f"{tracker.period:.4g} s", f"{tracker.snapshots} windows, {tracker.averages:.4g} averages"],
        [
            "beamformer",
            tracker.beamformer,
            "loading from the scatter of the snapshots" if tracker.beamformer == "mvdr" else "",
        ],
    ]
    return Grid(["receiver", "from", "value"], [[name, how, value] for name, value, how in rows], 2)


def _score(
    source: Path, record: BearingRecord, tracks: list[BearingTrack], truth: BearingTruth, out: Path, console: Console
) -> list[str]:
    """Score the tracks, print the table and write it; return the names of the files."""
    estimate = np.full((len(tracks), len(record.times)), np.nan)
    for row, track in zip(estimate, tracks, strict=True):
        row[track.first : track.last + 1] = track.bearings
    true, found = (_on_circle(bearings[:, truth.known]) for bearings in (truth.bearings, estimate))
    scoring = SetScoring("servotrack-bearing-scores", "hmm-row", "rows", "deg", CUTOFF)
    return write_set_scores(source.name, true, found, scoring, out, console)


def _on_circle(bearings: Array) -> Array:
    """Points on a circle of circumference 360, so that 359 and 1 deg are near each other. Shape (n, T, 2)."""
    angle = np.radians(bearings)
    return np.degrees(np.stack([np.cos(angle), np.sin(angle)], axis=-1))
