"""Parameters of a filter of points, measured from the points themselves.

First guess: chains of three nearest neighbors that are too close to be chance; their departure from a straight line
gives the noise, their length the speed. Then rounds of tracking and counting: the likelihood of the tracks' own
measurements under a Kalman filter gives process and measurement noise, and counts give the others. All of it is
computed in units of the points' own, so that nanometers serve as well as nautical miles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.special import chdtri

from servotrack.envs.track.files.points import PointScans
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs import (
    Birth,
    HiddenMarkovModel,
    Reduction,
    Trajectory,
    TrajectoryPMB,
    constant_velocity,
    track_scans,
)
from servotrack.estimators.types import Array

_LAGS = (10, 30)
"""Shortest and longest smoothing lag, scans."""
_LAG_DETECTIONS = 5.0
"""Detections of a target that the lag should hold."""
_ROUNDS = 3
_FITTED_SCANS = 300
"""Scans that the parameters are measured on, from the first one."""
_CHANCE = 0.05
"""Largest probability that a neighbor so close is there by chance."""
_GATE = 1e-3
"""Share of a track's own measurements that its gate excludes when measurements are counted."""
LEAST_EXISTENCE = 1e-5
"""Tracks of less probability are dropped. A first detection in much clutter is less than 0.001 probable."""
_MARGIN = 0.02
_CUTOFF_SHARE = 0.025
_WINDOWS = (1, 2, 4, 8, 16, 30)
"""Numbers of scans in which the next measurement of a target is searched."""
_LEAST_NOISE = 1e-7
"""Least standard deviation of a measurement as a share of the region's side: below it rounding decides."""
_SPEEDS = (1e-6, 10.0)
"""Least and largest speed in sides of the region per scan."""
_RESOLUTION = 1e-9
"""Least side of the region as a share of the largest coordinate."""
_FAR, _MOST = 30.0, 0.95
"""Distance of a far point in distances within which this share of the points lies."""
_SMALLEST = 1e-15
"""Smallest median time step, s, and extent of all points, m."""
_STEPS = (1e-6, 1e9)
"""Least time step and longest time of a file, in median steps."""
_FIRST_SHARE = 0.1
"""Share of the scans whose new tracks are targets that were there before."""


class PointModel(NamedTuple):
    """Parameters of a filter of points; everything per scan is per `period`.

    Attributes:
        period: Median interval between scans, s.
        low, high: Corners of the region. Shape (d,), m.
        process_noise: Square root of the spectral density of the acceleration, m/s^1.5.
        measurement_noise: Standard deviation of a coordinate, m; None if the file has covariances.
        detection: Probability that a scan contains a measurement of a target.
        clutter_rate: Mean number of measurements of no target in a scan.
        births: Mean number of new targets per scan.
        survival: Probability that a target survives one scan.
        speed: Root mean square of a coordinate of the velocity, m/s.
    """

    period: float
    low: Array
    high: Array
    process_noise: float
    measurement_noise: float | None
    detection: float
    clutter_rate: float
    births: float
    survival: float
    speed: float


class _Units(NamedTuple):
    """Units in which the points are tracked, powers of two: an interval is 1 to 2, the region's side 1,024 to 2,048.

    Attributes:
        time: s.
        length: m.
        origin: Middle of the bounds of all points. Shape (d,), m.
    """

    time: float
    length: float
    origin: Array

    @classmethod
    def of(cls, points: PointScans) -> _Units:
        """Units of a file of points."""
        time, length = (2.0 ** math.floor(math.log2(one)) for one in (_period(points), _side(points) / 1024.0))
        low, high = _bounds(points)
        return cls(time, length, low + 0.5 * (high - low))

    def points(self, points: PointScans) -> PointScans:
        """Points in these units."""
        covariances = points.covariances
        return points._replace(
            times=points.times / self.time,
            scans=[(scan - self.origin) / self.length for scan in points.scans],
            covariances=None if covariances is None else [one / self.length / self.length for one in covariances],
        )

    def model(self, model: PointModel, *, back: bool = False) -> PointModel:
        """Model in these units, or from them back in s and m."""
        time, length = (1.0 / self.time, 1.0 / self.length) if back else (self.time, self.length)
        noise = model.measurement_noise
        shift = self.origin if back else -self.origin / self.length
        return model._replace(
            period=model.period / time,
            low=model.low / length + shift,
            high=model.high / length + shift,
            process_noise=model.process_noise / length * time**1.5,
            measurement_noise=None if noise is None else noise / length,
            speed=model.speed / length * time,
        )

    def back(self, trajectory: Trajectory) -> Trajectory:
        """Trajectory in s and m."""
        scale = np.tile([self.length, self.length / self.time], trajectory.states.shape[1] // 2)
        return Trajectory(
            trajectory.label,
            trajectory.times * self.time,
            trajectory.states * scale + np.stack([self.origin, np.zeros_like(self.origin)], axis=1).reshape(-1),
            trajectory.covariances * scale[:, None] * scale,
            trajectory.existence,
        )


def scores_cutoff(low: Array, high: Array) -> float:
    """Cut-off of scores in a region, m: a fortieth of its longest side."""
    return _CUTOFF_SHARE * float((high - low).max())


def track_points(points: PointScans, model: PointModel) -> list[Trajectory]:
    """Track points with the parameters of a model; smoothed over `smoothing_lag` scans."""
    units = _Units.of(points)
    return [units.back(one) for one in _tracked(units.points(points), units.model(model))]


def measured_model(points: PointScans) -> tuple[PointModel, list[str]]:
    """Measure the parameters of a filter from the points.

    Args:
        points: The points.

    Returns:
        The parameters, and notes on what could not be measured.

    Raises:
        SequenceError: Time steps or extent are so small, or differ so much, that rounding would decide.
    """
    _check_scales(points)
    units = _Units.of(points)
    scaled = units.points(points)
    # An hour without a target has nothing to measure.
    first = next(k for k, scan in enumerate(scaled.scans) if len(scan))
    part = slice(max(min(first, len(scaled.times) - 2), 0), first + _FITTED_SCANS)
    few = scaled._replace(
        times=scaled.times[part],
        scans=scaled.scans[part],
        covariances=None if scaled.covariances is None else scaled.covariances[part],
    )
    model, notes = _first_guess(few)
    for _ in range(_ROUNDS):
        found = _counted(few, model)
        if found is None:
            notes.append("no track of four measurements was found: noise and rates are guesses")
            break
        model = found
    notes += _outliers(points)
    # The tracker's region holds the points outside of the measured part, too.
    low, high = region_of(scaled)
    return units.model(model._replace(low=low, high=high), back=True), notes


def _outliers(points: PointScans) -> list[str]:
    """Return a note on points so far from the others that they make the region too large."""
    everything = np.concatenate(points.scans)
    middle = np.median(everything, axis=0)
    away = np.abs(everything - middle)
    usual = np.maximum(np.quantile(away, _MOST, axis=0), 1e-3 * _side(points))
    far = (away > _FAR * usual).any(axis=1)
    if not far.any():
        return []
    return [
        f"{int(far.sum())} points are more than {_FAR:g} times as far out as {100 * _MOST:g} % of all and make the "
        "region large, so that much else looks like a target; leave them out if they are faults"
    ]


def _check_scales(points: PointScans) -> None:
    steps, median, side = np.diff(points.times), _period(points), _side(points)
    if min(median, side) < _SMALLEST:
        raise SequenceError(
            f"the median time step and the extent of all points must be at least {_SMALLEST:g}, got {median:g} s and "
            f"{side:g} m; give seconds and meters"
        )
    if steps.min() < _STEPS[0] * median:
        at = float(points.times[int(steps.argmin())])
        raise SequenceError(
            f"times must be at least {_STEPS[0]:g} of the median step of {median:g} s apart, got {steps.min():g} s "
            f"after time {at!r}; give the points of one scan one time"
        )
    span = points.times[-1] - points.times[0]
    if span > _STEPS[1] * median:
        raise SequenceError(
            f"times must span at most {_STEPS[1]:g} median steps, got {span:g} s and a median of {median:g} s; split "
            "the file"
        )


def _period(points: PointScans) -> float:
    return float(np.median(np.diff(points.times)))


def _side(points: PointScans) -> float:
    """Longest side of the bounds of all points, m; some width if they are all at one place."""
    low, high = _bounds(points)
    return max(float((high - low).max()), _RESOLUTION * float(np.abs([low, high]).max())) or 1.0


def _bounds(points: PointScans) -> tuple[Array, Array]:
    everything = np.concatenate(points.scans)
    return everything.min(axis=0), everything.max(axis=0)


def region_of(points: PointScans) -> tuple[Array, Array]:
    """Corners of the bounds of all points with a margin. Shapes (d,)."""
    low, high = _bounds(points)
    # A region without extent along an axis would have no volume.
    margin = np.maximum(_MARGIN * (high - low), 1e-3 * _side(points))
    return low - margin, high + margin


def _first_guess(points: PointScans) -> tuple[PointModel, list[str]]:
    """Parameters from chains of nearest neighbors."""
    (low, high), side, period = region_of(points), _side(points), _period(points)
    count = sum(map(len, points.scans)) / len(points.scans)
    # Where each scan holds few of the targets, such as that of one ship, chains span several scans.
    searched = {window: _chains(points, low, high, window) for window in _WINDOWS if window < len(points.scans)}
    window = max(searched, key=lambda one: len(searched[one]))
    chains = searched[window]
    notes = []
    if len(chains):
        bends, speeds = chains[:, 0], chains[:, 1]
        noise = max(float(np.median(bends)) / 0.6745, 1e-6 * side)
        speed = _bounded_speed(points, float(np.sqrt(np.mean(speeds**2))))
    else:
        noise, speed = 1e-3 * side, 1e-2 * side / period
        notes.append(
            "no three measurements in a row lie close enough together: the first guess is of the region's size"
        )
    if points.covariances is not None:
        covariances = np.concatenate([scan for scan in points.covariances if len(scan)])
        noise = float(np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2)) / points.dimensions))
        noise = max(noise, _LEAST_NOISE * side)
    return (
        PointModel(
            period=period,
            low=low,
            high=high,
            process_noise=noise / period**1.5,
            measurement_noise=None if points.covariances is not None else noise,
            detection=0.9 / window,
            clutter_rate=max(0.3 * count, 0.01),
            births=0.1,
            survival=0.99 ** (1.0 / window),
            speed=speed,
        ),
        notes,
    )


def _chains(points: PointScans, low: Array, high: Array, window: int) -> Array:
    """Departure from a straight line per coordinate, in measurement errors, and speed, of chains of three. (k, 2)."""
    d = points.dimensions
    size = [len(scan) for scan in points.scans]
    start = np.concatenate([[0], np.cumsum(size)])
    place, time = np.concatenate(points.scans), np.repeat(points.times, size)
    density = len(place) / len(size) * window / float(np.prod(high - low))
    # Volume of a ball in which a neighbor by chance has the probability _CHANCE.
    ball = {1: 2.0, 2: math.pi, 3: 4.0 * math.pi / 3.0}[d]
    reach = (_CHANCE / (density * ball)) ** (1.0 / d)
    later, before = np.full(len(place), -1), np.full(len(place), -1)
    for k in range(len(size)):
        own = slice(start[k], start[k + 1])
        for link, a, b in ((later, k + 1, k + 1 + window), (before, k - window, k)):
            others = slice(start[max(a, 0)], start[min(max(b, 0), len(size))])
            if own.start == own.stop or others.start >= others.stop:
                continue
            distance, nearest = cKDTree(place[others]).query(place[own], distance_upper_bound=reach)
            link[own] = np.where(distance < reach, nearest + others.start, -1)
    found = []
    for i, j in enumerate(later):
        last = later[j] if j >= 0 else -1
        if last < 0 or before[j] != i or before[last] != j:
            continue
        first, second = time[j] - time[i], time[last] - time[j]
        ratio = second / first
        bend = (place[last] - place[j] - ratio * (place[j] - place[i])) / math.sqrt(1.0 + (1.0 + ratio) ** 2 + ratio**2)
        velocity = (place[last] - place[i]) / (first + second)
        found += [(abs(a), v) for a, v in zip(bend, velocity, strict=True)]
    return np.array(found).reshape(-1, 2)


def _tracked(points: PointScans, model: PointModel) -> list[Trajectory]:
    tracker = _tracker(points, model)
    return track_scans(tracker, points.scans, points.times, noises=_noises(points, _position_noise(points, model)))


def _tracker(points: PointScans, model: PointModel) -> TrajectoryPMB:
    center, covariance = birth_place(model)
    return TrajectoryPMB(
        motion_of(points, model),
        Birth(np.array([min(model.births, 1.0)]), center[None], covariance),
        clutter_intensity=model.clutter_rate / float(np.prod(model.high - model.low)),
        survival=model.survival,
        detection=model.detection,
        reduction=Reduction(components=5, existence=LEAST_EXISTENCE),
        lag=smoothing_lag(points, model),
    )


def motion_of(points: PointScans, model: PointModel) -> HiddenMarkovModel:
    """Motion and measurement of one target with measured parameters."""
    noise = _position_noise(points, model)
    return constant_velocity(model.process_noise, noise, period=model.period, dimensions=points.dimensions)


def birth_place(model: PointModel) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the states of new targets: one Gaussian as wide as the region.

    Births at measurements would also take place where targets already are.
    """
    deviation = np.stack([(model.high - model.low) / math.sqrt(12.0), np.full(len(model.low), model.speed)], axis=1)
    center = np.stack([0.5 * (model.low + model.high), np.zeros(len(model.low))], axis=1)
    return center.reshape(-1), np.diag(deviation.reshape(-1) ** 2)


def smoothing_lag(points: PointScans, model: PointModel) -> int:
    """Smoothing lag of the tracker, scans; longer where targets are detected rarely."""
    return min(int(np.clip(math.ceil(_LAG_DETECTIONS / model.detection), *_LAGS)), len(points.times) - 1)


def _position_noise(points: PointScans, model: PointModel) -> float:
    if model.measurement_noise is not None:
        return model.measurement_noise
    return float(np.sqrt(np.mean([np.trace(R) / len(R) for scan in points.covariances or [] for R in scan])))


def _noises(points: PointScans, usual: float) -> list[Array] | None:
    """Covariance of each measurement's noise, none so small that rounding would decide.

    Args:
        points: The points.
        usual: Standard deviation of a usual measurement, m.
    """
    if points.covariances is None:
        return None
    found = []
    for scan in points.covariances:
        # Beyond many times the region a covariance says nothing, however large.
        scan = (
            scan
            * np.minimum(1.0, (1e4 * _side(points)) ** 2 / np.maximum(np.trace(scan, axis1=1, axis2=2), 1e-300))[
                :, None, None
            ]
        )
        largest = np.abs(scan).max(axis=(1, 2), initial=0.0)
        least = np.maximum((_LEAST_NOISE * _side(points)) ** 2, 1e-8 * np.maximum(largest, usual**2))
        values = np.linalg.eigvalsh(scan)[:, 0] if len(scan) else largest
        found.append(scan + np.maximum(least - values, 0.0)[:, None, None] * np.eye(points.dimensions))
    return found


def _counted(points: PointScans, model: PointModel) -> PointModel | None:
    """Parameters from the tracks that a model finds; None without tracks of four measurements."""
    trajectories = _tracked(points, model)
    d, scans = points.dimensions, len(points.times)
    entries = list(range(0, 2 * d, 2))
    row_of = {time: k for k, time in enumerate(points.times.tolist())}
    present: list[list[tuple[int, Array, Array]]] = [[] for _ in range(scans)]
    for t, one in enumerate(trajectories):
        for time, state, P in zip(one.times.tolist(), one.states, one.covariances, strict=True):
            present[row_of[time]].append((t, state[entries], P[np.ix_(entries, entries)]))
    own: list[list[tuple[float, Array]]] = [[] for _ in trajectories]
    R = np.eye(d) * _position_noise(points, model) ** 2
    limit, taken = float(chdtri(d, _GATE)), 0
    for k, scan in enumerate(points.scans):
        if not len(scan) or not present[k]:
            continue
        noise = points.covariances[k] if points.covariances is not None else np.broadcast_to(R, (len(scan), d, d))
        cost = np.empty((len(present[k]), len(scan)))
        for i, (_, mean, P) in enumerate(present[k]):
            error = scan - mean
            cost[i] = np.einsum("zr,zr->z", error, np.linalg.solve(P + noise, error[:, :, None])[:, :, 0])
        rows, columns = linear_sum_assignment(np.minimum(cost, 2.0 * limit))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            if cost[row, column] <= limit:
                own[present[k][row][0]].append((float(points.times[k]), scan[column]))
                taken += 1
    long = [sequence for sequence in own if len(sequence) >= 4]
    if not long:
        return None
    # The first and the last scan of a track are detections, since tracks are made of them.
    inside = sum(max(len(one) - 2, 0) for one in trajectories)
    detected = sum(max(len(sequence) - 2, 0) for sequence in own)
    alive = sum(len(one) for one in trajectories)
    late = sum(one.times[0] > points.times[int(_FIRST_SHARE * scans)] for one in trajectories)
    deaths = sum(one.times[-1] < points.times[-1] for one in trajectories)
    size = np.array([len(sequence) for sequence in long])
    process, measurement = _most_likely(
        np.array([time for sequence in long for time, _ in sequence]),
        np.array([place for sequence in long for _, place in sequence]),
        np.concatenate([[0], np.cumsum(size)]),
        model,
        _position_noise(points, model),
    )
    velocities = np.concatenate([one.states[:, 1::2] for one in trajectories])
    return model._replace(
        process_noise=process,
        measurement_noise=None if model.measurement_noise is None else max(measurement, _LEAST_NOISE * _side(points)),
        detection=float(np.clip((detected + 1.0) / (inside + 2.0), 0.02, 0.99)),
        clutter_rate=max((sum(map(len, points.scans)) - taken) / scans, 0.01),
        births=float(np.clip((late + 0.5) / ((1.0 - _FIRST_SHARE) * scans), 1e-3, 10.0)),
        survival=float(np.clip(1.0 - (deaths + 0.5) / (alive + 1.0), 0.5, 0.9999)),
        speed=_bounded_speed(points, float(np.sqrt(np.mean(velocities**2)))),
    )


def _bounded_speed(points: PointScans, speed: float) -> float:
    least, most = (share * _side(points) / _period(points) for share in _SPEEDS)
    return min(max(speed, least), most)


def _most_likely(times: Array, places: Array, start: Array, model: PointModel, noise: float) -> tuple[float, float]:
    """Process and measurement noise of greatest likelihood, on a grid of factors that is refined twice."""
    best = np.log2([model.process_noise, noise])
    fixed = model.measurement_noise is None
    for width, step in ((6.0, 2.0), (2.0, 0.5), (0.5, 0.125)):
        factors = np.arange(-width, width + 0.5 * step, step)
        center, most = best, -np.inf
        for a in factors:
            for b in (0.0,) if fixed else factors:
                trial = center + np.array([a, b])
                value = _log_likelihood(times, places, start, 2.0 ** trial[0], 2.0 ** trial[1], model.speed)
                if value > most:
                    best, most = trial, value
    return float(2.0 ** best[0]), float(2.0 ** best[1])


@njit(cache=True, nogil=True)
def _log_likelihood(times, places, start, process, noise, speed):  # type: ignore[no-untyped-def]
    """Log-likelihood of measurement sequences under nearly constant velocity, axis by axis."""
    total = 0.0
    R = noise * noise
    for sequence in range(start.shape[0] - 1):
        for axis in range(places.shape[1]):
            first = start[sequence]
            x, v = places[first, axis], 0.0
            a, b, c = R, 0.0, speed * speed
            for k in range(first + 1, start[sequence + 1]):
                t = times[k] - times[k - 1]
                x += t * v
                a += 2.0 * t * b + t * t * c + process * process * t**3 / 3.0
                b += t * c + process * process * t**2 / 2.0
                c += process * process * t
                S = a + R
                error = places[k, axis] - x
                total -= 0.5 * (math.log(2.0 * math.pi * S) + error * error / S)
                x += a / S * error
                v += b / S * error
                c -= b * b / S
                b -= a * b / S
                a -= a * a / S
    return total
