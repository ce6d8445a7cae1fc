"""Counts of `servotrack track`: people in the frame and in zones, and crossings of lines, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from servotrack.baselines.reporting.grid import Grid
from servotrack.baselines.track_command.growing_file import GrowingFile
from servotrack.baselines.track_command.inputs import Step
from servotrack.envs.track.people.place_paint import PlaceMark
from servotrack.estimators.boxes import Count, LineCount, ZoneCount, people_count
from servotrack.estimators.boxes.counting import UNDETECTED
from servotrack.estimators.rfs.sets import SetEstimate

COUNTS = "counts.csv"
"""Name of the file."""
COLUMNS = ("frame", "time", "place", "count", "expected", "low", "high")
"""Columns of the file: frame from 0, time in s, name, `people`, `forward` or `backward`, and the 90 % interval."""
EVERYWHERE = "frame"
"""Name of the whole frame as a place."""


@dataclass(frozen=True)
class Places:
    """Zones and lines in which people are counted, besides the frame.

    Attributes:
        zones: Zones by name.
        lines: Lines by name.
        undetected: Expected number of people without a track for each one with a track; see `people_count`.
    """

    zones: dict[str, ZoneCount]
    lines: dict[str, LineCount]
    undetected: float = UNDETECTED


class PlaceCount(NamedTuple):
    """A count of a frame.

    Attributes:
        place: Name.
        what: `people`; or `forward` or `backward`, crossings so far.
        number: The number with its interval.
    """

    place: str
    what: str
    number: Count


def parse_places(zones: Sequence[str] = (), lines: Sequence[str] = (), missed: float | None = None) -> Places:
    """Return zones and lines from their text.

    Args:
        zones: `x1,y1,x2,y2,x3,y3,...` in px of the source, with `NAME=` before it on request.
        lines: `x1,y1,x2,y2`, the same.
        missed: Expected number of people that are not found for each one that is, in frames, zones and crossings;
            None: the defaults of `people_count` and `LineCount`.

    Raises:
        ValueError: Another form, a name that is given twice, or a place that cannot be.
    """
    undetected = UNDETECTED if missed is None else missed
    named_zones = _named("zone", zones)
    named_lines = _named("line", lines)
    if twice := ({EVERYWHERE, *named_zones} & set(named_lines)) | ({EVERYWHERE} & set(named_zones)):
        raise ValueError(f"places must have different names, got {min(twice)!r} twice ({EVERYWHERE!r} is taken)")
    for name, points in named_lines.items():
        if len(points) != 2:
            raise ValueError(f"--line takes two points x1,y1,x2,y2, got {len(points)} for {name!r}")
    found_zones: dict[str, ZoneCount] = {}
    found_lines: dict[str, LineCount] = {}
    for name in (*named_zones, *named_lines):
        try:
            if name in named_zones:
                found_zones[name] = ZoneCount(named_zones[name], undetected=undetected)
            else:
                start, end = named_lines[name]
                found_lines[name] = LineCount(start, end, missed=LineCount.missed if missed is None else missed)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return Places(found_zones, found_lines, undetected)


def check_places(places: Places, size: tuple[int, int] | None) -> None:
    """Refuse places that no person in the frame can reach.

    Args:
        places: Zones and lines.
        size: Width and height of the frames, px; None if unknown.

    Raises:
        ValueError: A zone or a line lies outside the frame.
    """
    if size is None:
        return
    shapes = {name: tuple(zone.corners) for name, zone in places.zones.items()}
    shapes |= {name: (line.start, line.end) for name, line in places.lines.items()}
    for name, points in shapes.items():
        for axis, side in enumerate(size):
            values = [point[axis] for point in points]
            if max(values) < 0.0 or min(values) > side:
                raise ValueError(
                    f"{name} lies outside the frame of {size[0]}x{size[1]} px, its {'xy'[axis]} is from "
                    f"{min(values):g} to {max(values):g}; give px of the source"
                )


class Counter:
    """Counts frame by frame.

    Args:
        places: Zones and lines.
        size: Width and height of the frames, px; None if unknown.
    """

    def __init__(self, places: Places, size: tuple[int, int] | None = None) -> None:
        self._places, self._size = places, size
        self._lines = {name: line.initial() for name, line in places.lines.items()}
        self._largest: dict[str, tuple[int, PlaceCount]] = {}
        self._now: list[PlaceCount] = []
        self._time: float | None = None

    def step(self, frame: int, estimate: SetEstimate, time: float | None = None) -> list[PlaceCount]:
        """Count the people of a frame.

        Args:
            frame: Number of the frame, from 0.
            estimate: Boxes in the source's px.
            time: Time of the frame, s; None for the nominal one.
        """
        places = self._places
        now = [PlaceCount(EVERYWHERE, "people", people_count(estimate, places.undetected, frame_size=self._size))]
        now += [PlaceCount(name, "people", zone.count(estimate)) for name, zone in places.zones.items()]
        for found in now:
            before = self._largest.get(found.place)
            if before is None or found.number.expected > before[1].number.expected:
                self._largest[found.place] = frame, found
        last, self._time = self._time, time
        dt = None if time is None or last is None else time - last
        for name, line in places.lines.items():
            self._lines[name], crossings = line.step(self._lines[name], estimate, dt)
            now.append(PlaceCount(name, "forward", crossings.forward))
            now.append(PlaceCount(name, "backward", crossings.backward))
        self._now = now
        return now

    @property
    def people(self) -> Count:
        """Number of people in the frame."""
        return self._now[0].number

    def grid(self) -> Grid:
        """Table of crossings so far, and of the largest number of people in the frame and in each zone."""
        rows = [
            [place, f"most people, in frame {frame}", *_cells(found.number)]
            for place, (frame, found) in self._largest.items()
        ]
        rows += [[place, what, *_cells(number)] for place, what, number in self._now if what != "people"]
        return Grid(["place", "count", "expected", "90 % interval"], rows, 2)

    def marks(self) -> list[PlaceMark]:
        """Zones and lines with their present counts, for pictures."""
        of = {(found.place, found.what): found.number for found in self._now}
        marks = [
            PlaceMark(tuple(zone.corners), True, f"{name} {_short(of[name, 'people'])}")
            for name, zone in self._places.zones.items()
        ]
        for name, line in self._places.lines.items():
            text = f"{name}  forward {_short(of[name, 'forward'])} / backward {_short(of[name, 'backward'])}"
            marks.append(PlaceMark((line.start, line.end), False, text))
        return marks


class CountsFile(GrowingFile):
    """Table of counts; a row is a count of a frame."""

    def write(self, step: Step, counts: Sequence[PlaceCount]) -> None:
        """Append one frame's counts.

        Args:
            step: The frame.
            counts: Counts of the frame.

        Raises:
            OSError: The disk is full, or a file size limit is reached.
        """
        head = ",".join(COLUMNS) + "\n" if not self.rows else ""
        rows = [
            f"{step.number},{step.time:.6g},{place},{what},{number.expected:.3f},{number.low},{number.high}\n"
            for place, what, number in counts
        ]
        self.append(head + "".join(rows), len(rows))


def _named(kind: str, texts: Sequence[str]) -> dict[str, tuple[tuple[float, float], ...]]:
    """Points by name; places without a name are numbered."""
    named: dict[str, tuple[tuple[float, float], ...]] = {}
    for number, text in enumerate(texts, 1):
        name, equals, places = text.rpartition("=")
        name = name.strip() if equals else f"{kind} {number}"
        if not (name and name.isprintable()) or set(name) & set(',"='):
            raise ValueError(f"the name of a {kind} must be printable, without commas and quotes, got {name!r}")
        if name in named:
            raise ValueError(f"places must have different names, got {name!r} twice")
        try:
            numbers = [float(word) for word in places.split(",")]
        except ValueError:
            numbers = []
        if not numbers or len(numbers) % 2:
            raise ValueError(f"--{kind} takes x1,y1,x2,y2{',...' if kind == 'zone' else ''} in px, got {text!r}")
        named[name] = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    return named


def _cells(count: Count) -> list[str]:
    return [f"{count.expected:.1f}", f"{count.low} to {count.high}"]


def _short(count: Count) -> str:
    return f"{count.expected:.0f} : {count.low}-{count.high}"
