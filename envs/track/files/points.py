"""Reader of points in time: measurements of a radar, AIS messages or any other positions, as CSV, gzip too."""

from __future__ import annotations

import csv
import gzip
import io
import math
import re
import zlib
from array import array
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.files.bounded import parse_number, read_bounded
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Array, Labels, Mask
from servotrack.estimators.validation import LIMITS

POINT_SUFFIXES = (".csv", ".csv.gz")
"""Endings of files of points."""
EARTH_RADIUS = 6_371_008.8
"""Mean radius of the earth (IUGG), m."""
MOST_BYTES = 1 << 28
"""Largest accepted size of a file of points, packed or unpacked, bytes: some ten million points."""
MOST_IN_SCAN = 5000
"""Largest accepted number of points of one time. The tracker compares all of them with all tracks."""
MOST_TRUE_PLACES = 20_000_000
"""Largest accepted number of true targets times scans."""
_LONGEST_LINE = 1 << 20
"""Largest accepted length of a line, characters."""
_MOST_LINES_OF_ROW = 100
"""Largest accepted number of lines of a row, whose quoted cells may hold line ends."""
_MOST_BLANK = 1000
"""Largest accepted number of blank rows."""
_LARGEST_CONDITION = 1e12
"""Ratio of the eigenvalues of a covariance above which rounding decides whether it is definite."""
_HIGHEST_LATITUDE = 85.0
"""Latitude beyond which a plane with an axis to the east is of no use, deg."""
_TIMES = ("time", "timestamp", "basedatetime", "datetime", "t")
_LATITUDES, _LONGITUDES = ("lat", "latitude"), ("lon", "longitude", "lng")
_IDENTITIES = ("id", "label", "track", "target", "mmsi")
_SENSORS = ("sensor", "sensor_id", "radar", "camera")
_AXES = ("x", "y", "z")
_MISSING = ("", "nan", "na", "n/a", "null", "none")
"""Cells that hold no number, in lower case."""
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+([eE][+-]?[0-9]+)?")
_REMEDY = "split the file"
_BLANKS = " \t"
"""Characters that count as nothing around a cell. Python's own list has control characters, too."""
_QUOTED = 80
"""Number of characters of a cell that a message quotes."""


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
        repeated: Number of rows that were left out because they repeat another one of the same time.
        unsorted: Number of rows of a time before that of the row above; all rows were sorted by time.
        shared: Number of times with points of several sensors, by the column of sensors.
    """

    times: Array
    scans: list[Array]
    covariances: list[Array] | None
    identities: list[list[str]] | None
    origin: GeographicOrigin | None
    dated: bool
    repeated: int = 0
    unsorted: int = 0
    shared: int = 0

    @property
    def dimensions(self) -> int:
        """Number of axes, d."""
        return int(self.scans[0].shape[1])


class PointTruth(NamedTuple):
    """True tracks at the times of scans.

    Attributes:
        names: Identity of each target, as in the file.
        tracks: Positions, NaN while a target does not exist. Shape (n, K, d), m.
        known: Scans at which the truth says which targets exist. Shape (K,), bool.
    """

    names: list[str]
    tracks: Array
    known: Mask


def is_points_file(source: str) -> bool:
    """Return True if a source's name is that of a file of points."""
    return "://" not in source and source.lower().endswith(POINT_SUFFIXES)


def read_points(path: Path, origin: GeographicOrigin | None = None) -> PointScans:
    """Read points in time from a CSV file with a header.

    Columns, in any order and case: `time` (or timestamp, datetime, BaseDateTime; seconds, or dates in ISO 8601) and
    `x`, `y`[, `z`] in m, or `lat` and `lon` in degrees. Optional: the position's covariance as `cov_xx`, `cov_xy`,
    `cov_yy`[, `cov_xz`, `cov_yz`, `cov_zz`] in m^2, all of them, an identity (`id`, `label`, `mmsi`), and a sensor
    (`sensor`, `radar`, `camera`), which is only counted. Further columns are ignored. Rows are sorted by time.
    Those of one time are one scan; a row without position (empty cells, or nan) stands for a scan without
    detections. Of rows of one time with the same position and identity the first one is kept: a receiver that
    stores a message twice has not seen two targets. Semicolons and tabs separate cells too; then a number may have
    a decimal comma.

    Args:
        path: The file, ending in .csv or .csv.gz.
        origin: Origin of the plane of geographic positions; None: the first one.

    Raises:
        SequenceError: The file cannot be read or is too large, has wrong columns, no two scans, or more than
            `MOST_IN_SCAN` points of one time; a number is missing, not finite or beyond the limits of all estimators; a
            latitude or longitude is out of range; a covariance is not positive definite. The message names path and
            row.
    """
    rows = csv_rows(path)
    first = next(rows, None)
    if first is None:
        raise SequenceError(f"{path} is empty; it must begin with a header such as time,x,y")
    head = [cell.strip(_BLANKS).lower() for cell in first[1]]
    columns = _Columns.of(path, head)
    d, names = len(columns.places), columns.covariance_names
    every, times, places, covariances = array("d"), array("d"), array("d"), array("d")
    texts, numbers, sensors = array("q"), array("q"), array("q")
    names_of: dict[str, int] = {}
    sensors_of: dict[str, int] = {}
    dated: bool | None = None
    for number, row in rows:
        where = f"{path} row {number}"
        if len(row) != len(head):
            raise SequenceError(f"{where} must have {len(head)} columns as the header, got {len(row)}")
        time, is_date = _time(row[columns.time], where)
        if dated is not None and is_date != dated:
            raise SequenceError(
                f"{where} must have a time of the kind of the first row, got {_short(row[columns.time])}"
            )
        dated = is_date
        every.append(time)
        cells = [row[at].strip(_BLANKS) for at in columns.places]
        if all(cell.lower() in _MISSING for cell in cells):
            continue
        place = [csv_number(cell, head[at], where) for cell, at in zip(cells, columns.places, strict=True)]
        if columns.geographic:
            _check_degrees(place, cells, where)
            origin = origin or GeographicOrigin(place[0], place[1])
        text = "" if columns.identity is None else row[columns.identity].strip(_BLANKS)
        times.append(time)
        places.extend(place)
        texts.append(names_of.setdefault(text, len(names_of)))
        numbers.append(number)
        if columns.sensor is not None:
            sensors.append(sensors_of.setdefault(row[columns.sensor].strip(_BLANKS), len(sensors_of)))
        if names:
            covariances.extend(csv_number(row[at], head[at], where, LIMITS.coordinates**2) for at in columns.covariance)
    scan_times = np.unique(np.array(every))
    if len(scan_times) < 2:
        raise SequenceError(f"{path} must have scans at two times or more, got {len(scan_times)}; tracks need motion")
    if not places:
        raise SequenceError(f"{path} has no row with a position")
    scan, positions = np.searchsorted(scan_times, np.array(times)), np.array(places).reshape(-1, d)
    identities, own_rows = np.array(texts), np.array(numbers)
    _, first_of = np.unique(np.column_stack([scan, identities, positions]), axis=0, return_index=True)
    kept = np.sort(first_of)
    kept = kept[np.argsort(scan[kept], kind="stable")]
    sizes = np.bincount(scan[kept], minlength=len(scan_times))
    if sizes.max() > MOST_IN_SCAN:
        full = int(sizes.argmax())
        row_number = own_rows[kept[scan[kept] == full][MOST_IN_SCAN]]
        raise SequenceError(
            f"{path} row {row_number} must have at most {MOST_IN_SCAN} points of one time, got {sizes[full]} at "
            f"{scan_times[full]:g} s; give each scan its own time, or leave out weak points"
        )
    if columns.geographic and origin is not None:
        positions = origin.to_plane(positions)
    ends = np.cumsum(sizes)[:-1]
    matrices = _covariances(path, np.array(covariances), own_rows, d) if names else None
    words = list(names_of)
    return PointScans(
        scan_times,
        np.split(positions[kept], ends),
        None if matrices is None else np.split(matrices[kept], ends),
        None if columns.identity is None else [[words[k] for k in own] for own in np.split(identities[kept], ends)],
        origin if columns.geographic else None,
        bool(dated),
        len(positions) - len(kept),
        int((np.diff(np.array(every)) < 0.0).sum()),
        _shared(scan[kept], np.array(sensors)[kept]) if sensors else 0,
    )


def _shared(scan: Labels, sensors: Labels) -> int:
    """Number of scans with points of several sensors."""
    pairs = np.unique(np.column_stack([scan, sensors]), axis=0)
    return int((np.bincount(pairs[:, 0]) > 1).sum())


def _check_degrees(place: list[float], cells: list[str], where: str) -> None:
    """Raise a SequenceError unless latitude and longitude are in range and the plane has an axis to the east."""
    if not (abs(place[0]) <= 90.0 and -180.0 <= place[1] <= 360.0):
        raise SequenceError(
            f"{where} must have a latitude in [-90, 90] and a longitude in [-180, 360], got {', '.join(cells)}"
        )
    if abs(place[0]) > _HIGHEST_LATITUDE:
        raise SequenceError(
            f"{where}: latitude must be at most {_HIGHEST_LATITUDE:g} in magnitude, got {cells[0]}; near a "
            "pole give x and y in a plane of your own"
        )


class _Columns(NamedTuple):
    """Places of the columns in a row.

    Attributes:
        time, identity, sensor: Places of these columns; no identity, no sensor: None.
        places: Places of x, y[, z], or of latitude and longitude.
        geographic: True for latitude and longitude.
        covariance: Places of the upper triangle of the covariance, row by row; empty without one.
        covariance_names: Names of these columns.
    """

    time: int
    identity: int | None
    sensor: int | None
    places: list[int]
    geographic: bool
    covariance: list[int]
    covariance_names: list[str]

    @classmethod
    def of(cls, path: Path, head: list[str]) -> _Columns:
        """Find the columns by their names in lower case."""
        columns = {name: at for at, name in enumerate(head)}
        if len(columns) < len(head):
            twice = next(name for at, name in enumerate(head) if columns[name] != at)
            raise SequenceError(f"{path} row 1 must name each column once, got {_short(twice)} twice")
        time = _first(columns, _TIMES)
        latitude, longitude = _first(columns, _LATITUDES), _first(columns, _LONGITUDES)
        places = [columns[name] for name in _AXES if name in columns] if "x" in columns and "y" in columns else []
        geographic = not places and latitude is not None and longitude is not None
        if latitude is not None and longitude is not None and geographic:
            places = [latitude, longitude]
        if time is None or not places:
            raise SequenceError(
                f"{path} row 1 must name the columns time, x, y[, z], or time, lat, lon, got {_short(','.join(head))}"
            )
        d = len(places)
        names = [f"cov_{_AXES[r]}{_AXES[c]}" for r in range(d) for c in range(r, d)]
        given = [name for name in names if name in columns]
        if given and len(given) < len(names):
            raise SequenceError(f"{path} row 1 must name all of {', '.join(names)} or none, got {', '.join(given)}")
        identity, sensor = _first(columns, _IDENTITIES), _first(columns, _SENSORS)
        return cls(time, identity, sensor, places, geographic, [columns[name] for name in given], given)


def _covariances(path: Path, upper: Array, rows: Labels, d: int) -> Array:
    """Covariances of all points, checked. Shape (Z, d, d)."""
    above = np.triu_indices(d)
    matrices = np.zeros((len(rows), d, d))
    matrices[:, above[0], above[1]] = matrices[:, above[1], above[0]] = upper.reshape(len(rows), -1)
    values = np.linalg.eigvalsh(matrices)
    bad = ~(values[:, 0] * _LARGEST_CONDITION > values[:, -1])
    if bad.any():
        at = int(bad.argmax())
        raise SequenceError(
            f"{path} row {rows[at]} must have a positive definite covariance, not nearly singular, got "
            f"{matrices[at].tolist()}; its eigenvalues may differ by a factor of {_LARGEST_CONDITION:g}"
        )
    return matrices


def read_point_truth(path: Path, points: PointScans) -> PointTruth:
    """Read true tracks, a file of points with an identity column, at the times of scans.

    Between two of its rows a target moves on a straight line. Rows without an identity belong to no target, so that the
    file of the scans can be the truth too, if its identities are those of targets.

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
            if not name:
                continue
            if name in found and found[name][-1][0] == time:
                raise SequenceError(f"{path} must have one row of target {_short(name)} at time {time:g}, got two")
            found.setdefault(name, []).append((float(time), place))
    if not found:
        raise SequenceError(f"{path} must have identities in its column, got empty cells only")
    known = (points.times >= truth.times[0]) & (points.times <= truth.times[-1])
    if not known.any():
        raise SequenceError(
            f"{path} must overlap the points in time, got {truth.times[0]:g} to {truth.times[-1]:g} s of "
            f"{points.times[0]:g} to {points.times[-1]:g} s"
        )
    if len(found) * len(points.times) > MOST_TRUE_PLACES:
        raise SequenceError(
            f"{path} must have at most {MOST_TRUE_PLACES} true targets times scans, got {len(found)} targets at "
            f"{len(points.times)} scans; {_REMEDY}s of points and truth"
        )
    tracks = np.full((len(found), len(points.times), d), np.nan)
    for track, rows in zip(tracks, found.values(), strict=True):
        own = np.array([time for time, _ in rows])
        inside = (points.times >= own[0]) & (points.times <= own[-1])
        for axis in range(d):
            track[inside, axis] = np.interp(points.times[inside], own, [place[axis] for _, place in rows])
    return PointTruth(list(found), tracks, known)


def csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not blank, with the numbers of their last lines from 1.

    Cells are separated by commas, or by the semicolons or tabs of a header without commas; then numbers with a decimal
    comma get a point.
    """
    content = read_bounded(path, MOST_BYTES, _REMEDY)
    packed = content[:2] == b"\x1f\x8b"
    stream = gzip.GzipFile(fileobj=io.BytesIO(content)) if packed else io.BytesIO(content)
    lines = _Lines(path, io.TextIOWrapper(stream, encoding="utf-8-sig", newline=""))
    blank = 0
    try:
        separator = lines.separator()
        reader = csv.reader(lines, strict=True, delimiter=separator)
        for row in reader:
            lines.of_row = 0
            if any(cell.strip(_BLANKS) for cell in row):
                yield reader.line_num, row if separator == "," else [_with_point(cell) for cell in row]
                continue
            blank += 1
            if blank > _MOST_BLANK:
                raise SequenceError(f"{path} has more than {_MOST_BLANK} blank rows; is it a CSV file?")
    except csv.Error as error:
        raise SequenceError(f"{path} row {lines.number} is no row of a CSV file ({error})") from error
    except (OSError, EOFError, zlib.error) as error:
        raise SequenceError(f"{path} is a damaged gzip file ({error}); download it again") from error
    except UnicodeDecodeError as error:
        raise SequenceError(f"{path} must be text in UTF-8 ({error.reason} after row {lines.number})") from error


def _with_point(cell: str) -> str:
    return cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell.strip(_BLANKS)) else cell


class _Lines:
    """Lines of a text, whose length, number in a row and total size are limited.

    Args:
        path: Path for error messages.
        stream: The text.

    Attributes:
        of_row: Number of lines since the reader set it to 0.
        number: Number of lines so far.
    """

    def __init__(self, path: Path, stream: io.TextIOWrapper) -> None:
        self._path, self._stream = path, stream
        self.number = self._size = self.of_row = 0
        self._first: str | None = None

    def separator(self) -> str:
        """Separator of cells by the first line, which is read again."""
        self._first = self._stream.readline(_LONGEST_LINE + 1)
        return "," if "," in self._first else next((mark for mark in ";\t" if mark in self._first), ",")

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        line, self._first = self._stream.readline(_LONGEST_LINE + 1) if self._first is None else self._first, None
        if not line:
            raise StopIteration
        self.number, self._size, self.of_row = self.number + 1, self._size + len(line), self.of_row + 1
        if len(line) > _LONGEST_LINE:
            raise SequenceError(
                f"{self._path} row {self.number} has more than {_LONGEST_LINE} characters; is it a CSV file?"
            )
        if self.of_row > _MOST_LINES_OF_ROW:
            raise SequenceError(
                f"{self._path} row {self.number}: a row must have at most {_MOST_LINES_OF_ROW} lines; is a quotation "
                "mark missing?"
            )
        if self._size > MOST_BYTES:
            raise SequenceError(f"{self._path} unpacks to more than {MOST_BYTES} characters; {_REMEDY}")
        return line


def _first(columns: dict[str, int], names: tuple[str, ...]) -> int | None:
    return next((columns[name] for name in names if name in columns), None)


def csv_number(cell: str, name: str, where: str, limit: float = LIMITS.coordinates) -> float:
    """The number in a cell; raises SequenceError with place and column unless it is finite and within the limit."""
    try:
        value = parse_number(cell.strip(_BLANKS))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SequenceError(f"{where}: {name} must be a finite number, got {_short(cell)}; leave the row out")
    if abs(value) > limit:
        raise SequenceError(
            f"{where}: {name} must be at most {limit:g} in magnitude, got {_short(cell)}; check its unit, or leave the "
            "row out"
        )
    return value


def _time(cell: str, where: str) -> tuple[float, bool]:
    """Seconds, and True for a date."""
    text = cell.strip(_BLANKS)
    is_date = False
    try:
        value = parse_number(text)
    except ValueError:
        try:
            date = datetime.fromisoformat(text.replace("Z", "+00:00"))
        except ValueError:
            raise SequenceError(f"{where}: time must be seconds or a date in ISO 8601, got {_short(text)}") from None
        value, is_date = (date if date.tzinfo else date.replace(tzinfo=timezone.utc)).timestamp(), True
    if not math.isfinite(value):
        raise SequenceError(f"{where}: time must be finite, got {_short(text)}; leave the row out")
    if abs(value) > LIMITS.times:
        raise SequenceError(
            f"{where}: time must be at most {LIMITS.times:g} s from 0 or from 1970, got {_short(text)}; give seconds, "
            "milliseconds divided by 1000"
        )
    return value, is_date


def _short(cell: str) -> str:
    """Begin of a text from a file, in quotes."""
    return repr(cell.strip(_BLANKS)[:_QUOTED])
