"""Files of trajectories: CSV that keeps every bit, and GeoJSON for maps."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_bounded
from servotrack.estimators.rfs.trajectory import Trajectory
from servotrack.estimators.types import Array

LARGEST_FILE = 1 << 28
"""Largest accepted size of a file of trajectories, bytes."""
MOST_ENTRIES = 100
"""Largest accepted number of entries of a state."""
PLANAR = ("x", "vx", "y", "vy")
"""Names of the entries of a state in the plane."""
_FIRST = ("label", "time", "existence")


def write_trajectories(path: Path, trajectories: Iterable[Trajectory], names: Sequence[str] = PLANAR) -> None:
    """Write trajectories as CSV, one row per identity and scan, whole or not at all.

    Columns: label, time, existence, the state's entries by name, and the upper triangle of its covariance as
    cov_NAME_NAME. Numbers have all their digits, so that `read_trajectories` returns the same bits.

    Args:
        path: File to write.
        trajectories: Trajectories with states of n entries.
        names: Names of the n entries.

    Raises:
        ValueError: A trajectory has another number of entries.
        ResultsError: The file cannot be written.
    """
    n = len(names)
    rows, columns = np.triu_indices(n)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    covariance = [f"cov_{names[r]}_{names[c]}" for r in range(n) for c in range(r, n)]
    writer.writerow([*_FIRST, *names, *covariance])
    for one in trajectories:
        if one.states.shape[1] != n:
            raise ValueError(f"names must be of the {one.states.shape[1]} entries of a state, got {list(names)}")
        for k in range(len(one)):
            numbers = [one.times[k], one.existence[k], *one.states[k], *one.covariances[k][rows, columns]]
            writer.writerow([one.label, *(repr(float(number)) for number in numbers)])
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")


def read_trajectories(path: Path) -> list[Trajectory]:
    """Read trajectories that `write_trajectories` wrote.

    Raises:
        ResultsError: The file cannot be read, has other columns, or a row with other than finite numbers, a probability
            beyond 0 to 1 or a negative variance. The message names path and row.
    """
    rows_of_text = _rows(path)
    head = next(rows_of_text, [])
    names = [name for name in head[len(_FIRST) :] if not name.startswith("cov_")]
    n = len(names)
    fits = 0 < n <= MOST_ENTRIES and len(head) == len(_FIRST) + n + n * (n + 1) // 2
    if not fits or tuple(head[: len(_FIRST)]) != _FIRST:
        raise ResultsError(
            f"{path} must begin with the columns label, time, existence, a state of up to {MOST_ENTRIES} entries and "
            f"its covariance, got {','.join(head)[:80]!r}"
        )
    found: dict[int, list[tuple[float, float, Array, Array]]] = {}
    rows, columns = np.triu_indices(n)
    for number, line in enumerate(rows_of_text, start=2):
        try:
            label, values = int(line[0]), np.array([float(cell) for cell in line[1:]])
        except (ValueError, IndexError) as error:
            raise ResultsError(f"{path} row {number} must hold numbers, got {','.join(line)[:80]!r}") from error
        if len(values) != len(head) - 1 or not np.all(np.isfinite(values)):
            raise ResultsError(f"{path} row {number} must hold {len(head)} finite numbers, got {','.join(line)[:80]!r}")
        if not 0.0 <= values[1] <= 1.0:
            raise ResultsError(f"{path} row {number} must have an existence in [0, 1], got {line[2]!r}")
        covariance = np.zeros((n, n))
        covariance[rows, columns] = covariance[columns, rows] = values[2 + n :]
        if (np.diag(covariance) < 0.0).any():
            raise ResultsError(
                f"{path} row {number} must have variances of at least 0, got {np.diag(covariance).min():g}"
            )
        found.setdefault(label, []).append((values[0], values[1], values[2 : 2 + n], covariance))
    trajectories = []
    for label, parts in found.items():
        times, existence, states, covariances = map(np.array, zip(*parts, strict=True))
        try:
            trajectories.append(Trajectory(label, times, states, covariances, existence))
        except ValueError as error:
            raise ResultsError(f"{path}: {error}") from error
    return trajectories


def _rows(path: Path) -> Iterator[list[str]]:
    """Rows of a table of bounded size."""
    content = read_bounded(path, LARGEST_FILE)
    reader = csv.reader(io.TextIOWrapper(io.BytesIO(content), encoding="utf-8", newline=""), strict=True)
    try:
        yield from reader
    except (UnicodeDecodeError, csv.Error) as error:
        raise ResultsError(f"{path} row {reader.line_num + 1} is no row of a table of text ({error})") from error


def write_geojson(
    path: Path,
    trajectories: Iterable[Trajectory],
    position: Sequence[int] = (0, 2),
    transform: Callable[[Array], ArrayLike] | None = None,
    stamp: Callable[[float], str] | None = None,
) -> None:
    """Write trajectories as GeoJSON lines (RFC 7946), whole or not at all; one of a single scan is a point.

    Args:
        path: File to write.
        trajectories: The trajectories.
        position: Entries of the state that are the position, two or three.
        transform: Function of positions (T, 2 or 3) that returns longitude and latitude in degrees, and height in m.
            None: positions are written as they are, which maps can only show if they are degrees.
        stamp: Function of a time that returns its text, for example in ISO 8601; None: times are numbers.

    Raises:
        ValueError: The transform returns another shape, or values that are not finite.
        ResultsError: The file cannot be written.
    """
    features = []
    for one in trajectories:
        places = one.states[:, list(position)]
        if transform is not None:
            moved = np.asarray(transform(places), dtype=np.float64)
            if moved.shape != places.shape or not np.all(np.isfinite(moved)):
                raise ValueError(f"transform must return finite values of shape {places.shape}, got {moved.shape}")
            places = moved
        coordinates = places.tolist()
        single = len(coordinates) == 1
        times = [float(time) if stamp is None else stamp(float(time)) for time in one.times]
        features.append(
            {
                "type": "Feature",
                "id": one.label,
                "geometry": {
                    "type": "Point" if single else "LineString",
                    "coordinates": coordinates[0] if single else coordinates,
                },
                "properties": {
                    "label": one.label,
                    "times": times,
                    "existence": one.existence.tolist(),
                    # One number per scan that any map can draw as a circle.
                    "deviation": [math.sqrt(max(np.trace(P), 0.0)) for P in _positions(one, position)],
                },
            }
        )
    document = {"type": "FeatureCollection", "features": features}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")


def _positions(one: Trajectory, position: Sequence[int]) -> Array:
    """Covariances of the positions. Shape (T, d, d)."""
    entries = list(position)
    return one.covariances[:, entries][:, :, entries]
