"""Reader of points in time: measurements of a radar, AIS messages or any other positions, as CSV, gzip too."""

from __future__ import annotations

import csv
import gzip
import io
import math
import zlib
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.files.bounded import parse_number, read_bounded
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Array, Labels

POINT_SUFFIXES = (".csv", ".csv.gz")
"""Endings of files of points."""
EARTH_RADIUS = 6_371_008.8
"""Mean radius of the earth (IUGG), m."""
MOST_BYTES = 1 << 30
"""Largest accepted size of a file of points, unpacked, bytes."""
_TIMES = ("time", "timestamp", "basedatetime", "t")
_LATITUDES, _LONGITUDES = ("lat", "latitude"), ("lon", "longitude", "lng")
_IDENTITIES = ("id", "label", "track", "target", "mmsi")
_AXES = ("x", "y", "z")
_REMEDY = "split the file"


class GeographicOrigin(NamedTuple):
    """Origin of the local plane of geographic positions: x to the east, y to the north, m.

    The plane is equirectangular about the origin; its error grows with the square of the distance from it, to about
    1 % of a distance at 100 km and latitudes up to 60 deg.

    Attributes:
        latitude: deg.
        longitude: deg.
    """

    latitude: float
    longitude: float

    def to_plane(self, degrees: Array) -> Array:
        """Positions in the plane, m, of latitudes and longitudes in degrees. Shapes (k, 2)."""
        turn = (degrees[:, 1] - self.longitude + 180.0) % 360.0 - 180.0
        east = EARTH_RADIUS * math.cos(math.radians(self.latitude)) * np.radians(turn)
        return np.stack([east, EARTH_RADIUS * np.radians(degrees[:, 0] - self.latitude)], axis=1)

    def to_map(self, positions: Array) -> Array:
        """Longitudes and latitudes in degrees of positions in the plane, m. Shapes (k, 2)."""
        scale = EARTH_RADIUS * math.cos(math.radians(self.latitude))
        longitude = self.longitude + np.degrees(positions[:, 0] / scale)
        latitude = self.latitude + np.degrees(positions[:, 1] / EARTH_RADIUS)
        return np.stack([(longitude + 180.0) % 360.0 - 180.0, latitude], axis=1)


class PointScans(NamedTuple):
    """Points in time, scan by scan.

    Attributes:
        times: Time of each scan, increasing, s. Shape (K,).
        scans: Positions, one array (Z, d) per scan, m; Z may be 0.
        covariances: Covariances of the positions, one array (Z, d, d) per scan; None without such columns.
        identities: Text of the identity column for each row, one list per scan; None without such a column.
        origin: Origin of geographic positions; None for Cartesian ones.
        dated: True if times are dates: then they are seconds since 1970, UTC.
    """

    times: Array
    scans: list[Array]
    covariances: list[Array] | None
    identities: list[list[str]] | None
    origin: GeographicOrigin | None
    dated: bool

    @property
    def dimensions(self) -> int:
        """Number of axes, d."""
        return int(self.scans[0].shape[1])


class PointTruth(NamedTuple):
    """True tracks at the times of scans.

    Attributes:
        tracks: Positions, NaN while a target does not exist. Shape (n, K, d), m.
        known: Scans at which the truth says which targets exist. Shape (K,), bool.
    """

    tracks: Array
    known: Labels


def is_points_file(source: str) -> bool:
    """Return True if a source's name is that of a file of points."""
    return "://" not in source and source.lower().endswith(POINT_SUFFIXES)


def read_points(path: Path, origin: GeographicOrigin | None = None) -> PointScans:
    """Read points in time from a CSV file with a header.

    Columns, in any order and case: `time` (or timestamp, BaseDateTime; seconds, or dates in ISO 8601) and `x`, `y`[,
    `z`] in m, or `lat` and `lon` in degrees. Optional: the position's covariance as `cov_xx`, `cov_xy`, `cov_yy`[,
    `cov_xz`, `cov_yz`, `cov_zz`] in m^2, all of them, and an identity (`id`, `label`, `mmsi`). Further columns are
    ignored. Rows of one time are one scan; a row without position stands for a scan without detections.

    Args:
        path: The file, ending in .csv or .csv.gz.
        origin: Origin of the plane of geographic positions; None: the first one.

    Raises:
        SequenceError: The file cannot be read, has wrong columns, or no two scans; a number is missing or not finite; a
            latitude or longitude is out of range; a covariance is not positive definite; times run backward. The
            message names path and row.
    """
    lines = csv_rows(path)
    if not lines:
        raise SequenceError(f"{path} is empty; it must begin with a header such as time,x,y")
    head = [cell.strip().lower() for cell in lines[0][1]]
    columns = {name: at for at, name in enumerate(head)}
    if len(columns) < len(head):
        raise SequenceError(f"{path} row 1 must name each column once, got {','.join(head)}")
    time_at = _first(columns, _TIMES)
    latitude, longitude = _first(columns, _LATITUDES), _first(columns, _LONGITUDES)
    places = [columns[name] for name in _AXES if name in columns] if "x" in columns and "y" in columns else []
    geographic = not places and latitude is not None and longitude is not None
    if latitude is not None and longitude is not None and geographic:
        places = [latitude, longitude]
    if time_at is None or not places:
        raise SequenceError(
            f"{path} row 1 must name the columns time, x, y[, z], or time, lat, lon, got {','.join(head)}"
        )
    d = len(places)
    names = [f"cov_{_AXES[r]}{_AXES[c]}" for r in range(d) for c in range(r, d)]
    given = [name for name in names if name in columns]
    if given and len(given) < len(names):
        raise SequenceError(f"{path} row 1 must name all of {', '.join(names)} or none, got {', '.join(given)}")
    identity = _first(columns, _IDENTITIES)
    times: list[float] = []
    scans: list[list[Array]] = []
    covariances: list[list[Array]] = []
    identities: list[list[str]] = []
    dated: bool | None = None
    for number, row in lines[1:]:
        where = f"{path} row {number}"
        if len(row) != len(head):
            raise SequenceError(f"{where} must have {len(head)} columns as the header, got {len(row)}")
        time, is_date = _time(row[time_at], where)
        if dated is not None and is_date != dated:
            raise SequenceError(f"{where} must have a time of the kind of the first row, got {row[time_at]!r}")
        dated = is_date
        if times and time < times[-1]:
            raise SequenceError(
                f"{where}: time {row[time_at].strip()} is before that of the row above; sort the rows by time"
            )
        if not times or time > times[-1]:
            times.append(time)
            scans.append([])
            covariances.append([])
            identities.append([])
        cells = [row[at].strip() for at in places]
        if not any(cells):
            continue
        place = np.array([csv_number(cell, head[at], where) for cell, at in zip(cells, places, strict=True)])
        if geographic:
            if not (abs(place[0]) <= 90.0 and -180.0 <= place[1] <= 360.0):
                raise SequenceError(
                    f"{where} must have a latitude in [-90, 90] and a longitude in [-180, 360], got {', '.join(cells)}"
                )
            origin = origin or GeographicOrigin(float(place[0]), float(place[1]))
        scans[-1].append(place)
        identities[-1].append(row[identity].strip() if identity is not None else "")
        if given:
            covariance = np.zeros((d, d))
            upper = np.triu_indices(d)
            covariance[upper] = [csv_number(row[columns[name]], name, where) for name in names]
            covariance = covariance + np.triu(covariance, 1).T
            if np.linalg.eigvalsh(covariance).min() <= 0.0:
                raise SequenceError(f"{where} must have a positive definite covariance, got {covariance.tolist()}")
            covariances[-1].append(covariance)
    if len(times) < 2:
        raise SequenceError(f"{path} must have scans at two times or more, got {len(times)}; tracks need motion")
    if not any(scans):
        raise SequenceError(f"{path} has no row with a position")
    arrays = [np.array(scan, dtype=np.float64).reshape(-1, d) for scan in scans]
    if geographic and origin is not None:
        arrays = [origin.to_plane(scan) for scan in arrays]
    return PointScans(
        np.array(times),
        arrays,
        [np.array(scan).reshape(-1, d, d) for scan in covariances] if given else None,
        identities if identity is not None else None,
        origin if geographic else None,
        bool(dated),
    )


def read_point_truth(path: Path, points: PointScans) -> PointTruth:
    """Read true tracks, a file of points with an identity column, at the times of scans.

    Between two of its rows a target moves on a straight line.

    Args:
        path: The file; columns as in `read_points`.
        points: The scans.

    Raises:
        SequenceError: The file is invalid, has no identity column, another number of axes, or no time in common.
    """
    truth = read_points(path, points.origin)
    if truth.identities is None:
        raise SequenceError(f"{path} must have a column of identities, such as id")
    d = points.dimensions
    if truth.dimensions != d or (truth.origin is None) != (points.origin is None):
        raise SequenceError(f"{path} must have the same coordinates as the points, got {truth.dimensions} axes of {d}")
    found: dict[str, list[tuple[float, Array]]] = {}
    for time, scan, names in zip(truth.times, truth.scans, truth.identities, strict=True):
        for name, place in zip(names, scan, strict=True):
            if name in found and found[name][-1][0] == time:
                raise SequenceError(f"{path} must have one row of target {name!r} at time {time:g}, got two")
            found.setdefault(name, []).append((float(time), place))
    known = (points.times >= truth.times[0]) & (points.times <= truth.times[-1])
    if not known.any():
        raise SequenceError(
            f"{path} must overlap the points in time, got {truth.times[0]:g} to {truth.times[-1]:g} s of "
            f"{points.times[0]:g} to {points.times[-1]:g} s"
        )
    tracks = np.full((len(found), len(points.times), d), np.nan)
    for track, rows in zip(tracks, found.values(), strict=True):
        own = np.array([time for time, _ in rows])
        inside = (points.times >= own[0]) & (points.times <= own[-1])
        for axis in range(d):
            track[inside, axis] = np.interp(points.times[inside], own, [place[axis] for _, place in rows])
    return PointTruth(tracks, known)


def csv_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Rows that are not blank, with their numbers from 1."""
    content = read_bounded(path, MOST_BYTES, _REMEDY)
    if content[:2] == b"\x1f\x8b":
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
                content = stream.read(MOST_BYTES + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise SequenceError(f"{path} is a damaged gzip file ({error}); download it again") from error
        if len(content) > MOST_BYTES:
            raise SequenceError(f"{path} unpacks to more than {MOST_BYTES} bytes; {_REMEDY}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SequenceError(f"{path} must be text in UTF-8 ({error})") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows = []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append((reader.line_num, row))
    except csv.Error as error:
        raise SequenceError(f"{path} row {reader.line_num} is no row of a CSV file ({error})") from error
    return rows


def _first(columns: dict[str, int], names: tuple[str, ...]) -> int | None:
    return next((columns[name] for name in names if name in columns), None)


def csv_number(cell: str, name: str, where: str) -> float:
    """Return the finite number in a cell; SequenceError names place and column of anything else."""
    try:
        value = parse_number(cell.strip())
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SequenceError(f"{where}: {name} must be a finite number, got {cell.strip()[:40]!r}; leave the row out")
    return value


def _time(cell: str, where: str) -> tuple[float, bool]:
    """Seconds, and True for a date."""
    text = cell.strip()
    try:
        value = parse_number(text)
    except ValueError:
        try:
            date = datetime.fromisoformat(text.replace("Z", "+00:00"))
        except ValueError:
            raise SequenceError(f"{where}: time must be seconds or a date in ISO 8601, got {text[:40]!r}") from None
        return (date if date.tzinfo else date.replace(tzinfo=timezone.utc)).timestamp(), True
    if not math.isfinite(value):
        raise SequenceError(f"{where}: time must be finite, got {text!r}; leave the row out")
    return value, False
