"""Measurements of sets: scans for the set filters, detections for the trackers of boxes and for a person follower."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.follow import StillCamera
from servotrack.estimators.follow.follower import COLUMNS
from servotrack.estimators.rfs import Steering
from servotrack.estimators.testing.inputs import Arguments, Bad, Inputs, Sequence, magnitude
from servotrack.estimators.testing.values import Path
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import LIMITS


@dataclass(frozen=True)
class ScanInputs(Inputs):
    """Scans of targets that move nearly uniformly, in clutter.

    Args:
        size: Number m of entries of a measurement.
        targets: Number of targets.
        clutter: Mean number of false measurements per scan.
        area: Half-width of the region of interest, in the unit of the model.
        batch: Number of runs in one array with existence in column 0; 0 for single scans of shape (number, m).
        steered: True for `SteeredPHD`, whose steps also take a `Steering`.
        polar: True for range and bearing: the first entry is positive and the second is an angle.
    """

    size: int = 2
    targets: int = 3
    clutter: float = 3.0
    area: float = 100.0
    batch: int = 0
    steered: bool = False
    polar: bool = False

    open_axes: ClassVar[frozenset[str]] = frozenset({"steering"})
    not_rounded: ClassVar[frozenset[str]] = frozenset({"steering"})

    @property
    def rows(self) -> int:
        """Number of runs."""
        return max(self.batch, 1)

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw scans of drifting targets, or of points anywhere within the limits, some of them equal."""
        runs = [self._scans(rng, steps, extreme) for _ in range(self.rows)]
        scans: list[Any] = runs[0] if not self.batch else [_table(each) for each in zip(*runs, strict=True)]
        arguments = [self._arguments(rng, scan) for scan in scans]
        return Sequence({"measurement": scans[0]}, tuple(arguments))

    def _scans(self, rng: np.random.Generator, steps: int, extreme: bool) -> list[Array]:
        if extreme:
            reach = magnitude(rng, 1e-6, LIMITS.coordinates)
            pool = self._polar(rng.uniform(-reach, reach, (8, self.size)))
            return [pool[rng.integers(len(pool), size=rng.integers(0, 9))] for _ in range(steps)]
        place = rng.uniform(-self.area, self.area, (self.targets, self.size))
        motion = rng.normal(0.0, 2.0, place.shape)
        scans = []
        for _ in range(steps):
            seen = place[rng.random(self.targets) < 0.9]
            false = rng.uniform(-self.area, self.area, (rng.poisson(self.clutter), self.size))
            scans.append(self._polar(np.concatenate([seen + rng.normal(0.0, 1.0, seen.shape), false])))
            place = place + motion
        return scans

    def _polar(self, points: Array) -> Array:
        if self.polar:
            points[:, 0] = np.abs(points[:, 0])
            points[:, 1] = np.remainder(points[:, 1], 2.0 * np.pi) - np.pi
        return points

    def _arguments(self, rng: np.random.Generator, scan: Array) -> Arguments:
        if not self.steered:
            return {"measurement": scan}
        shape = (self.batch,) if self.batch else ()
        steering = Steering(
            np.asarray(rng.uniform(0.1, 0.99, shape)),
            np.asarray(rng.uniform(0.1, 10.0, shape)),
            np.asarray(rng.uniform(0.0, 1.0, shape)),
        )
        return {"measurement": scan, "steering": steering}

    def unread(self, arguments: Arguments) -> Mapping[Path, Mask]:
        """Entries of rows with existence 0."""
        if not self.batch:
            return {}
        empty = np.repeat(arguments["measurement"][..., :1] == 0.0, 1 + self.size, axis=-1)
        empty[..., 0] = False
        return {("measurement",): empty}

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield scans of wrong width, with or without rows, and values beyond the limits."""
        columns = self.size + (1 if self.batch else 0)
        head = (self.batch,) if self.batch else ()
        for shape in ((*head, 3, 0), (*head, 0, columns + 5), (*head, 3, columns + 1), (*head, 3, columns - 1)):
            yield Bad(f"a scan of shape {shape}", ("measurement",), {**arguments, "measurement": np.zeros(shape)})
        far = np.ones((*head, 1, columns))
        far[..., -1] = 1e300
        yield Bad("a measurement of 1e300", ("measurement",), {**arguments, "measurement": far})
        if self.batch:
            half = np.zeros((self.batch, 1, columns))
            half[..., 0] = 0.5
            yield Bad("a row that half exists", ("measurement",), {**arguments, "measurement": half})
        if self.steered and not first:
            good = arguments["steering"]
            wrong = good._replace(detection=good.detection + 2.0)
            yield Bad("a detection probability above 1", ("detection",), {**arguments, "steering": wrong})


@dataclass(frozen=True)
class BoxInputs(Inputs):
    """`Detections` of people who cross a frame.

    Args:
        people: Number of people.
        appearance: Length F of the appearance vectors, 0 for none.
        frame_size: Width and height of the frame, px.
    """

    people: int = 4
    appearance: int = 3
    frame_size: tuple[float, float] = (384.0, 288.0)

    # Trackers that use no appearance accept vectors of any length.
    open_lengths: ClassVar[frozenset[str]] = frozenset({"features"})

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw detections of walking people, or boxes of any place and size, some of them equal or without area."""
        frames = self._extreme(rng, steps) if extreme else self._ordinary(rng, steps)
        return Sequence({"detections": frames[0]}, tuple({"detections": each} for each in frames))

    def _ordinary(self, rng: np.random.Generator, steps: int) -> list[Detections]:
        height = rng.uniform(40.0, 90.0, self.people)
        corner = rng.uniform(0.0, 1.0, (self.people, 2)) * self.frame_size
        motion = rng.normal(0.0, 3.0, (self.people, 2))
        looks = np.abs(rng.normal(size=(self.people, self.appearance)))
        frames = []
        for _ in range(steps):
            seen = rng.random(self.people) < 0.9
            size = np.stack([0.4 * height, height], axis=1) * rng.normal(1.0, 0.05, (self.people, 2))
            boxes = np.concatenate([corner + rng.normal(0.0, 2.0, corner.shape), size], axis=1)[seen]
            share = rng.uniform(0.4, 1.0, len(boxes))
            frames.append(self._detections(boxes, looks[seen], share, rng.uniform(0.3, 1.0, len(boxes))))
            corner = corner + motion
        return frames

    def _extreme(self, rng: np.random.Generator, steps: int) -> list[Detections]:
        far, large = magnitude(rng, 1e-3, LIMITS.boxes), magnitude(rng, 1e-6, LIMITS.boxes)
        pool = np.concatenate([rng.uniform(-far, far, (6, 2)), rng.uniform(0.0, large, (6, 2))], axis=1)
        pool[rng.integers(6), 2:] = 0.0
        frames = []
        for _ in range(steps):
            chosen = rng.integers(6, size=rng.integers(0, 7))
            looks = rng.normal(size=(len(chosen), self.appearance)) * (rng.random((len(chosen), 1)) < 0.8)
            confidences = rng.uniform(-1.0, 1.0, len(chosen)) * magnitude(rng, 1e-6, LIMITS.scores)
            frames.append(self._detections(pool[chosen], looks, rng.uniform(0.0, 1.0, len(chosen)), confidences))
        return frames

    def _detections(self, boxes: Array, looks: Array, share: Array, confidences: Array) -> Detections:
        length = np.sqrt((looks * looks).sum(axis=1, keepdims=True))
        unit = np.divide(looks, length, out=np.zeros_like(looks), where=length > 0.0)
        centers = boxes[:, :2] + boxes[:, 2:] / 2.0
        return Detections(boxes, centers, share * boxes[:, 2] * boxes[:, 3], confidences, unit)

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield detections of wrong shapes, negative sizes and values beyond the limits."""
        good = arguments["detections"]
        one = self._detections(
            np.array([[5.0, 5.0, 10.0, 20.0]]), np.ones((1, self.appearance)), np.ones(1), np.ones(1)
        )
        for fault, name, detections in (
            ("boxes of three numbers", "boxes", good._replace(boxes=good.boxes[:, :3])),
            ("boxes of a negative width", "boxes", one._replace(boxes=one.boxes * [1.0, 1.0, -1.0, 1.0])),
            ("boxes at 1e300", "boxes", one._replace(boxes=one.boxes * 1e299)),
            ("centroids at 1e300", "centroids", one._replace(centroids=one.centroids * 1e299)),
            ("a confidence too many", "confidences", good._replace(confidences=np.ones(len(good.boxes) + 1))),
            ("an area too many", "areas", good._replace(areas=np.ones(len(good.boxes) + 1))),
            ("an appearance too many", "features", one._replace(features=np.ones((2, self.appearance)))),
        ):
            yield Bad(f"detections with {fault}", (name,), {"detections": detections})


@dataclass(frozen=True)
class FollowerInputs(Inputs):
    """Tables of detections from above, for a follower of one person; the camera is at rest.

    Args:
        batch: Number B of runs.
        people: Number of people in each.
        capacity: Number of rows of a table, at least `people`.
    """

    batch: int = 2
    people: int = 4
    capacity: int = 6

    start_names: ClassVar[tuple[str, ...]] = ("detections", "place", "color")

    @property
    def rows(self) -> int:
        """Number of runs."""
        return self.batch

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw tables of walking people, or of people who jump anywhere within the limits."""
        reach = magnitude(rng, 1e-3, LIMITS.pixels) if extreme else 240.0
        place = rng.uniform(-reach, reach, (self.batch, self.people, 2))
        color = rng.uniform(0.0, 255.0, (self.batch, self.people, 3))
        motion = rng.normal(0.0, 1.0, place.shape)
        tables = []
        for _ in range(steps):
            table = np.zeros((self.batch, self.capacity, COLUMNS))
            shown = table[:, : self.people]
            shown[..., 0] = rng.random(shown.shape[:2]) < 0.9
            shown[..., 1:3], shown[..., 3:5] = place + rng.normal(0.0, 2.0, place.shape), 20.0
            shown[..., 5:] = np.clip(color + rng.normal(0.0, 5.0, color.shape), 0.0, 255.0)
            tables.append(table * table[..., :1])
            place = rng.uniform(-reach, reach, place.shape) if extreme else place + motion
        joints = np.zeros((self.batch, 2))
        first = {"detections": tables[0], "place": tables[0][:, 0, 1:3].copy(), "color": color[:, 0].copy()}
        elapsed = np.full(self.batch, magnitude(rng, 1e-6, 1e3) if extreme else 0.05)
        return Sequence(
            first,
            tuple(
                {
                    "detections": table,
                    "fresh": rng.random(self.batch) < 0.9,
                    "elapsed": elapsed,
                    "ego_motion": StillCamera(),
                    "joints_before": joints,
                    "joints_after": joints,
                }
                for table in tables
            ),
        )

    def unread(self, arguments: Arguments) -> Mapping[Path, Mask]:
        """Entries of rows with existence 0, and everything about a run without a new frame."""
        empty = np.repeat(arguments["detections"][..., :1] == 0.0, COLUMNS, axis=-1)
        empty[..., 0] = False
        return {("detections",): empty}

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield tables of another width, half existing rows and values beyond the limits."""
        good = arguments["detections"]
        half, far = good.copy(), good.copy()
        half[:, 0, 0] = 0.5
        far[:, 0, 0], far[:, 0, 1] = 1.0, 1e300
        for fault, table in (
            ("another width", good[..., :5]),
            ("a row that half exists", half),
            ("a person at 1e300", far),
            ("another number of runs", good[:1]),
        ):
            yield Bad(f"detections with {fault}", ("detections", "place"), {**arguments, "detections": table})


def _table(scans: tuple[Array, ...]) -> Array:
    """Scans of several runs in one array with existence in column 0."""
    most = max(len(scan) for scan in scans) + 1
    out = np.zeros((len(scans), most, 1 + scans[0].shape[1]))
    for run, scan in enumerate(scans):
        out[run, : len(scan), 0], out[run, : len(scan), 1:] = 1.0, scan
    return out
