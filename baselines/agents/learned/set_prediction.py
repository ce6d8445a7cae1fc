"""Observer without a filter: a network classifies each recent measurement and regresses its target's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.baselines.agents.learned.card_fields import check_encoding
from servotrack.baselines.agents.memory import remembered
from servotrack.baselines.agents.row_reservation import RESERVED_SCANS, ReservedRows, allocate_rows, no_rows
from servotrack.baselines.agents.set_observer import POSITION
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs import RangeBearingModel, RowAllocation, SetEstimate
from servotrack.estimators.rfs.sets import read_measurements
from servotrack.estimators.types import Array, FloatArray, Labels, Mask

NEIGHBOR, ANCHOR = 8, 7
"""Entries of a neighbor, and of the measurement itself, in a row."""
ANSWERS = 5
"""Length of the network's answer: log odds, velocity (2), correction of the position (2)."""
LENGTH = 10.0
"""Unit of velocity and correction, m/s and m."""
NEIGHBOR_DISTANCE, NEIGHBOR_SPEED = 30.0, 40.0
"""Unit of the distance to a neighbor: a constant, m, and an increment for each scan between, m."""
NEIGHBOR_LIMIT = 2.5
"""Largest distance of a neighbor, in these units."""
ASSIGNMENT_GATE = 60.0
"""Gate: a detection farther than this from a track's predicted position is not assigned to it, m."""
POSITION_UNIT, COUNT_UNIT, CROSS_RANGE_UNIT = 2000.0, 4.0, 25.0
"""Units of positions, m, of the log number of measurements, and of the cross-range error, m."""


@dataclass(frozen=True)
class SetWindow:
    """Measurements that the network classifies, and the neighbors that it sees of each.

    Attributes:
        scans: Number of newest scans in which neighbors are searched.
        `asked`: Number of newest scans whose measurements are classified.
        neighbors: Largest number of neighbors of a measurement.
        merge: Two answers closer than this are one target, m.
        report: Smallest probability of a reported target.
    """

    scans: int = 12
    asked: int = 4
    neighbors: int = 20
    merge: float = 30.0
    report: float = 0.5

    def __post_init__(self) -> None:
        """Raise ValueError for values out of range."""
        if not 1 <= self.asked <= self.scans or self.neighbors < 1:
            raise ValueError(
                f"scans, `asked` and neighbors must be whole numbers with 1 <= `asked` <= scans, got {asdict(self)}"
            )
        if not (self.merge > 0.0 and 0.0 < self.report < 1.0):
            raise ValueError(f"merge must be > 0 m and report in (0, 1), got {asdict(self)}")

    @property
    def size(self) -> int:
        """Length of a measurement's row."""
        return self.neighbors * NEIGHBOR + ANCHOR

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> SetWindow:
        """Create the window that a card or a file of hyper-parameters describes.

        Raises:
            ValueError: An unknown field, or a value out of bounds.
        """
        check_encoding(settings)
        return cls(**{key: value for key, value in settings.items() if key != "kind"})


class ScanHistory(NamedTuple):
    """The last scans of N scenes, the newest first.

    Attributes:
        places: Measurements in the plane. Shape (N, scans, M, 2), m.
        number: Number of measurements in each scan. Shape (N, scans).
        seen: Number of scans so far. Shape (N,).
    """

    places: Array
    number: Labels
    seen: Labels

    @classmethod
    def none(cls, window: SetWindow, scenes: int, rows: int) -> ScanHistory:
        """Return the history before the first scan."""
        return cls(
            np.zeros((scenes, window.scans, rows, 2)),
            np.zeros((scenes, window.scans), np.int64),
            np.zeros(scenes, np.int64),
        )

    def with_scan(self, scan: Array, sensor: Array | None) -> ScanHistory:
        """Return the history with one more scan, shape (N, M, 3).

        Raises:
            ValueError: A wrong shape, an existence other than 0 or 1, or a used row that is not finite.
        """
        measurements, count, _ = read_measurements(scan, 2)
        places, number = np.roll(self.places, 1, axis=1), np.roll(self.number, 1, axis=1)
        places[:, 0], number[:, 0] = in_plane(measurements, sensor), count
        return ScanHistory(places, number, self.seen + 1)


class QueryBatch(NamedTuple):
    """Measurements to classify, A of them over all scenes.

    Attributes:
        rows: Inputs of the network. Shape (A, size).
        scene, age, row: Indices of each measurement in `ScanHistory`. Shape (A,).
        places: Positions. Shape (A, 2), m.
    """

    rows: FloatArray
    scene: Labels
    age: Labels
    row: Labels
    places: Array


def in_plane(measurements: Array, sensor: Array | None) -> Array:
    """Convert measurements to positions; with a sensor they are ranges and bearings. Shape (*, 2), m."""
    if sensor is None:
        return measurements
    distance, bearing = measurements[..., 0], measurements[..., 1]
    return sensor + np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)


def query_measurements(
    window: SetWindow, recent: ScanHistory, sensor: Array | None, bearing_noise: float
) -> QueryBatch:
    """Return the rows of all measurements to classify.

    Args:
        window: Measurements to classify, and their neighbors.
        recent: The last scans.
        sensor: Position of a sensor of range and bearing, shape (2,), m; None if positions are measured.
        bearing_noise: Standard deviation of that sensor's bearings, rad.
    """
    number = recent.number[:, : window.asked]
    scene, age = np.nonzero(number)
    counts = number[scene, age]
    scene, age = np.repeat(scene, counts), np.repeat(age, counts)
    row = np.concatenate([np.arange(count) for count in counts]) if len(counts) else np.zeros(0, np.int64)
    rows = np.zeros((len(scene), window.size), np.float32)
    _gather(recent.places, recent.number, scene, age, row, window.neighbors, rows)
    places = recent.places[scene, age, row]
    own = rows[:, window.neighbors * NEIGHBOR :]
    own[:, 0] = age / window.asked
    own[:, 1] = np.log1p(recent.number[scene, 0]) / COUNT_UNIT
    own[:, 2:4] = places / POSITION_UNIT
    if sensor is not None:
        own[:, 4:6] = bearing_noise * (places - sensor) / CROSS_RANGE_UNIT
    own[:, 6] = np.minimum(recent.seen[scene] / window.scans, 1.0)
    return QueryBatch(rows, scene, age, row, places)


def present_positions(queries: QueryBatch, answers: Array) -> tuple[Array, Array]:
    """Return present positions, m, and velocities, m/s, of the measurements' targets, each of shape (A, 2)."""
    velocity = LENGTH * answers[:, 1:3]
    return queries.places + queries.age[:, None] * velocity + LENGTH * answers[:, 3:5], velocity


class Tracks(NamedTuple):
    """Identities of N scenes.

    Attributes:
        labels: Identity of each row, 0 for a free one. Shape (N, R).
        states: States x, vx, y, vy. Shape (N, R, 4), m and m/s.
        existence: Probability of each in the newest scan, 0 if it was not predicted. Shape (N, R).
        absent: Scans since each was last predicted. Shape (N, R).
        next_label: Label of the next new identity. Shape (N,).
    """

    labels: Labels
    states: Array
    existence: Array
    absent: Labels
    next_label: Labels

    def estimate(self) -> SetEstimate:
        """Return the identities predicted in the newest scan."""
        shown = (self.labels > 0) & (self.absent == 0)
        empty = np.zeros((len(self.labels), 0))
        return SetEstimate(
            self.states,
            np.where(shown, self.labels, 0),
            self.existence,
            np.zeros((*self.states.shape, 4)),
            self.existence.sum(axis=1),
            empty.astype(np.int64),
            empty[..., None] * np.zeros(4),
            empty,
        )


class SetState(NamedTuple):
    """Memory of a `SetPredictor`.

    Attributes:
        recent: The last scans.
        tracks: Identities predicted in them.
        rows: Owners of the rows of the answer.
    """

    recent: ScanHistory
    tracks: Tracks
    rows: ReservedRows


class SetPredictor:
    """A network behind `predict`: the newest scans in, the set of targets out.

    Identities are assigned to the predictions nearest to their expected positions; this step is not learned.

    Args:
        network: Maps rows (A, size) to answers (A, 5).
        window: Window of the training.
        scene: Parameters of the scene that agents receive.
        rows: Number of rows of an answer.
        low: Lowest answer, shape (rows, 3).
        high: Highest answer, shape (rows, 3).
    """

    def __init__(
        self,
        network: Callable[[FloatArray], FloatArray],
        window: SetWindow,
        scene: SceneModel,
        rows: int,
        low: Array,
        high: Array,
    ) -> None:
        self._network, self._window = network, window
        self._sensor, self._bearing_noise = sensor_of(scene)
        self._rows, self._low, self._high = rows, low, high
        self._allocation = RowAllocation(rows, POSITION)

    def predict(
        self,
        observation: Any,
        state: SetState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, SetState]:
        """Answer a scan; arguments, results and errors as in `SetObserver.predict`."""
        scan = np.asarray(observation[OBSERVATION_KEY] if isinstance(observation, Mapping) else observation, np.float64)
        single = scan.ndim == 2
        scan = scan[None] if single else scan
        if scan.ndim != 3:
            raise ValueError(f"a scan must have shape (rows, 3) or (batch, rows, 3), got {scan.shape}")
        state = remembered(state, episode_start, (len(scan),), lambda: self._initial(scan))
        recent = state.recent.with_scan(scan, self._sensor)
        queries = query_measurements(self._window, recent, self._sensor, self._bearing_noise)
        answers = self._network(queries.rows).astype(np.float64)
        probability = 1.0 / (1.0 + np.exp(-answers[:, 0]))
        places, velocities = present_positions(queries, answers)
        found = np.concatenate([places, velocities], axis=1)[:, [0, 2, 1, 3]]
        tracks = _advanced(state.tracks)
        for scene in range(len(scan)):
            mine = np.flatnonzero((queries.scene == scene) & (probability >= self._window.report))
            chosen = _distinct(places[mine], probability[mine], self._window.merge)[: self._rows]
            _identify(tracks, scene, found[mine[chosen]], probability[mine[chosen]])
        rows, answer = allocate_rows(self._allocation, state.rows, tracks.estimate())
        answer = np.clip(answer, self._low, self._high)
        return (answer[0] if single else answer), SetState(recent, tracks, rows)

    def _initial(self, scan: Array) -> SetState:
        scenes, rows = len(scan), self._rows
        tracks = Tracks(
            np.zeros((scenes, rows), np.int64),
            np.zeros((scenes, rows, 4)),
            np.zeros((scenes, rows)),
            np.zeros((scenes, rows), np.int64),
            np.ones(scenes, np.int64),
        )
        return SetState(
            ScanHistory.none(self._window, scenes, scan.shape[1]), tracks, no_rows(self._allocation, scenes, 4)
        )


def sensor_of(scene: SceneModel) -> tuple[Array | None, float]:
    """Return position, m, and bearing noise, rad, of a range-bearing sensor; None and 0 if positions are measured."""
    if not isinstance(scene.model, RangeBearingModel):
        return None, 0.0
    return np.asarray(scene.model.sensor, np.float64), float(np.sqrt(scene.model.measurement_noise[1, 1]))


def _advanced(tracks: Tracks) -> Tracks:
    """Return copies of the tracks predicted to the next scan, all of them absent."""
    states = tracks.states.copy()
    states[..., [0, 2]] += states[..., [1, 3]]
    return tracks._replace(
        labels=tracks.labels.copy(), states=states, existence=np.zeros_like(tracks.existence),
        absent=tracks.absent + 1, next_label=tracks.next_label.copy(),
    )  # fmt: skip


def _distinct(places: Array, probability: Array, merge: float) -> Labels:
    """Return indices of the most probable places farther than `merge` from any more probable one, in that order."""
    order = np.argsort(-probability, kind="stable")
    chosen: list[int] = []
    for i in order.tolist():
        if all(np.hypot(*(places[i] - places[j])) >= merge for j in chosen):
            chosen.append(i)
    return np.array(chosen, np.int64)


def _identify(tracks: Tracks, scene: int, found: Array, probability: Array) -> None:
    """Assign detections to tracks within the gate and the others to free rows with new labels; writes `tracks`."""
    labels, states = tracks.labels[scene], tracks.states[scene]
    labels[tracks.absent[scene] > RESERVED_SCANS] = 0
    known = np.flatnonzero(labels > 0)
    apart = np.hypot(*(states[known][:, None, [0, 2]] - found[None, :, [0, 2]]).transpose(2, 0, 1))
    cost = np.where(apart < ASSIGNMENT_GATE, apart, 1e6)
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    taken = {int(j): int(known[i]) for i, j in pairs if cost[i, j] < ASSIGNMENT_GATE}
    free = [row for row in range(len(labels)) if labels[row] == 0]
    for j in range(len(found)):
        row = taken.get(j)
        if row is None:
            if not free:
                continue
            row = free.pop(0)
            labels[row] = tracks.next_label[scene]
            tracks.next_label[scene] += 1
        states[row], tracks.existence[scene, row], tracks.absent[scene, row] = found[j], probability[j], 0


@njit(cache=True, nogil=True)
def _gather(places, number, scene, age, index, most, rows):  # type: ignore[no-untyped-def]
    """Write the nearest measurements of other scans into rows; the unit of distance grows with the time between."""
    near = np.empty(most)
    which = np.empty((most, 2), np.int64)
    for row in range(len(scene)):
        b, a = scene[row], age[row]
        x, y = places[b, a, index[row], 0], places[b, a, index[row], 1]
        count = 0
        for other in range(places.shape[1]):
            if other == a:
                continue
            scale = NEIGHBOR_DISTANCE + NEIGHBOR_SPEED * abs(other - a)
            for j in range(number[b, other]):
                dx, dy = places[b, other, j, 0] - x, places[b, other, j, 1] - y
                distance = np.sqrt(dx * dx + dy * dy) / scale
                if distance > NEIGHBOR_LIMIT or (count == most and distance >= near[most - 1]):
                    continue
                at = min(count, most - 1)
                while at > 0 and near[at - 1] > distance:
                    near[at] = near[at - 1]
                    which[at] = which[at - 1]
                    at -= 1
                near[at] = distance
                which[at, 0], which[at, 1] = other, j
                count = min(count + 1, most)
        for k in range(count):
            other, j = which[k]
            dx, dy = places[b, other, j, 0] - x, places[b, other, j, 1] - y
            steps = a - other
            scale = NEIGHBOR_DISTANCE + NEIGHBOR_SPEED * abs(steps)
            out = rows[row, k * NEIGHBOR : (k + 1) * NEIGHBOR]
            out[0], out[1] = dx / scale, dy / scale
            out[2], out[3] = dx / steps / NEIGHBOR_DISTANCE, dy / steps / NEIGHBOR_DISTANCE
            out[4], out[5] = min(max(dx / NEIGHBOR_DISTANCE, -3.0), 3.0), min(max(dy / NEIGHBOR_DISTANCE, -3.0), 3.0)
            out[6], out[7] = steps / 6.0, 1.0
