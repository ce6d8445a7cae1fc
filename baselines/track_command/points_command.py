"""`servotrack track points.csv`: read points in time, measure the filter's parameters, track, report and score."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from rich.console import Console

from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.figure import save_figure
from servotrack.baselines.reporting.files import ResultsError, storage_error, temporary_folder_in
from servotrack.baselines.reporting.grid import Grid
from servotrack.baselines.reporting.terminal import print_tables
from servotrack.baselines.reporting.trajectory_figure import draw_trajectories
from servotrack.baselines.reporting.trajectory_files import write_geojson, write_trajectories
from servotrack.baselines.running.stopping import undisturbed
from servotrack.baselines.track_command.claim import claim_folder
from servotrack.baselines.track_command.set_scores import SCORE_FILES, SetScoring, write_set_scores
from servotrack.envs.track.files.points import MOST_TRUE_PLACES, PointScans, PointTruth, read_point_truth, read_points
from servotrack.envs.track.points.measured_model import measured_model
from servotrack.envs.track.points.point_extent import scores_cutoff
from servotrack.envs.track.points.point_model import PointModel, smoothing_lag, track_points
from servotrack.estimators.rfs import Trajectory
from servotrack.estimators.types import Array

TRACKS, MAP, FIGURE = "tracks.csv", "tracks.geojson", "tracks.png"
"""Names of the files that every run writes."""
OUTPUTS = (TRACKS, MAP, FIGURE, *SCORE_FILES)
"""Names of all files that a run may write."""
_PROJECTION_ERROR = 0.05
"""Largest error of distances in the plane of geographic positions that needs no note, as a share."""


def run_points(source: Path, out: Path, truth_file: Path | None, console: Console) -> None:
    """Track the points of a file, and write the tracks, a map, a figure and, with a truth, scores.

    Args:
        source: File of points; see `read_points`.
        out: Folder for all output.
        truth_file: File of true tracks; see `read_point_truth`. None: no scores.
        console: Console for the report.

    Raises:
        SequenceError: A file cannot be used.
        ResultsError: The folder cannot be written, holds files of these names that are not of an earlier run, or an
            input would be replaced.
    """
    inputs = [source] if truth_file is None else [source, truth_file]
    if own := [one for one in inputs for name in OUTPUTS if _is_same_file(one, out / name)]:
        raise ResultsError(f"{own[0]} would be replaced by this run's output; choose another --out, or copy the file")
    points = read_points(source)
    truth = None if truth_file is None else read_point_truth(truth_file, points)
    ResultsFolder(out).check_writable()
    claim_folder(out, OUTPUTS, {"source": str(source), "tracker": "trajectory-pmb"})
    model, notes = measured_model(points)
    trajectories = track_points(points, model)
    print_tables(console, {f"{source.name}: measured from {len(points.times)} scans": _model_grid(points, model)})
    with temporary_folder_in(out) as folder:
        _write_tracks(points, trajectories, folder)
        if truth is not None:
            _score(source, points, model, trajectories, truth, folder, console)
        written = [name for name in OUTPUTS if (folder / name).exists()]
        # Files of two runs must not stand side by side.
        with undisturbed():
            try:
                for name in OUTPUTS:
                    if name in written:
                        (folder / name).replace(out / name)
                    else:
                        (out / name).unlink(missing_ok=True)
            except OSError as error:
                raise storage_error(out / name, error) from error
    for name in written:
        console.print(str(out / name), soft_wrap=True)
    for note in [*notes, *_projection_notes(points), *_row_notes(points)]:
        console.print(f"note: {note}", style="cyan", soft_wrap=True)
    count = sum(map(len, points.scans))
    console.print(f"{len(points.times)} scans, {count} points, {len(trajectories)} tracks")


def _is_same_file(one: Path, other: Path) -> bool:
    try:
        return other.exists() and other.samefile(one)
    except OSError:
        return False


def _write_tracks(points: PointScans, trajectories: list[Trajectory], folder: Path) -> None:
    """Write the tracks, the map and the figure."""
    d, origin = points.dimensions, points.origin
    position = range(0, 2 * d, 2)
    names = [name for axis in "xyz"[:d] for name in (axis, f"v{axis}")]
    write_trajectories(folder / TRACKS, trajectories, names)
    transform = None if origin is None else origin.to_map
    write_geojson(folder / MAP, trajectories, position, transform, _date if points.dated else None)
    everything = np.concatenate(points.scans)[:, :2]
    axes = ("x, m", "y, m") if origin is None else ("east, m", "north, m")
    save_figure(draw_trajectories(trajectories, position, everything, axes), folder / FIGURE)


def _projection_notes(points: PointScans) -> list[str]:
    """Return a note where the plane of geographic positions is too large for its distances."""
    if points.origin is None:
        return []
    latitudes = points.origin.to_map(np.concatenate(points.scans))[:, 1]
    scale = np.cos(np.radians(latitudes)) / math.cos(math.radians(points.origin.latitude))
    worst = float(np.abs(scale - 1.0).max())
    if worst <= _PROJECTION_ERROR:
        return []
    return [
        f"the points reach over {latitudes.max() - latitudes.min():.1f} deg of latitude, and distances to the east are "
        f"off by up to {100.0 * worst:.0f} %; split the file by region"
    ]


def _row_notes(points: PointScans) -> list[str]:
    """Return notes where rows were sorted, left out because they repeat others, or of several sensors at one time."""
    notes = []
    if points.unsorted:
        notes.append(f"the rows were sorted by time: {points.unsorted} of them were before the row above")
    if points.shared:
        notes.append(
            f"{points.shared} times have points of several sensors, and a target that two of them see at one time "
            "becomes two tracks; give each sensor's rows a time of their own, such as 0.001 of the time step later"
        )
    if points.repeated:
        notes.append(
            f"{points.repeated} rows repeat another one of the same time and were left out; if two targets may have "
            "one position, tell them apart by a column id"
        )
    return notes


def _model_grid(points: PointScans, model: PointModel) -> Grid:
    """Table of the parameters and of how each was measured."""
    extent = " x ".join(f"{side:.4g}" for side in model.high - model.low)
    given = model.measurement_noise is None
    maneuvers = f"one step in {1.0 / model.maneuver:.0f}, noise x {model.agility:.3g}" if model.maneuver else "none"
    densest = 1.0 if model.clutter_map is None else float(model.clutter_map.density.max())
    clutter = "uniform" if densest == 1.0 else f"up to {densest:.2g} times as dense"
    rows = [
        ["interval", f"{model.period:.4g} s", "nine of ten time steps are at most as long"],
        ["region", f"{extent} m", "bounds of all points and 2 %"],
        [
            "position noise",
            "columns" if given else f"{model.measurement_noise:.4g} m",
            "covariances of the file" if given else "likelihood of the tracks' points",
        ],
        ["process noise", f"{model.process_noise:.4g} m/s^1.5", "likelihood of the tracks' points"],
        ["speed", f"{model.speed:.4g} m/s", "root mean square of the tracks' velocities, per axis"],
        ["detection", f"{model.detection:.3f}", "share of the scans inside tracks with a point in the gate"],
        ["maneuvers", maneuvers, "ends and beginnings of tracks"],
        ["clutter", f"{model.clutter_rate:.4g} per scan, {clutter}", "points that belong to no track"],
        ["births", f"{model.births:.4g} per interval", "tracks that start after the first tenth of the scans"],
        ["survival", f"{model.survival:.4g} per interval", "ends of tracks"],
        ["smoothing lag", f"{smoothing_lag(points, model)} scans", "five detections of a target, 10 to 30 scans"],
    ]
    return Grid(["parameter", "measured by", "value"], [[name, how, value] for name, value, how in rows], 2)


def _score(
    source: Path,
    points: PointScans,
    model: PointModel,
    trajectories: list[Trajectory],
    truth: PointTruth,
    folder: Path,
    console: Console,
) -> None:
    """Score the tracks, print the table and write it."""
    if len(trajectories) * len(points.times) > MOST_TRUE_PLACES:
        console.print(
            f"note: {len(trajectories)} tracks at {len(points.times)} scans are too many to score", style="cyan"
        )
        return
    estimate = _stacked(points, trajectories)[:, truth.known]
    scoring = SetScoring(
        "servotrack-point-scores", "trajectory-pmb", "scans", "m", scores_cutoff(model.low, model.high)
    )
    write_set_scores(source.name, truth.tracks[:, truth.known], estimate, scoring, folder, console)


def _stacked(points: PointScans, trajectories: list[Trajectory]) -> Array:
    """Positions of the tracks at all scans, NaN where absent. Shape (k, K, d)."""
    d = points.dimensions
    tracks = np.full((len(trajectories), len(points.times), d), np.nan)
    for track, one in zip(tracks, trajectories, strict=True):
        track[np.searchsorted(points.times, one.times)] = one.states[:, 0 : 2 * d : 2]
    return tracks


def _date(time: float) -> str:
    """Date in ISO 8601 of seconds since 1970."""
    return datetime.fromtimestamp(time, timezone.utc).isoformat()
