"""Parameters of a filter of points, measured from the points themselves.

First guess: chains of three nearest neighbors that are too close to be chance; their departure from a straight line
gives the noise, their length the speed. Then rounds of tracking and counting: the likelihood of the tracks' own
measurements under a Kalman filter gives process and measurement noise, and counts give the others. All of it is
computed in units of the points' own, so that nanometers serve as well as nautical miles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.special import chdtri

from servotrack.envs.track.files.points import PointScans
from servotrack.envs.track.points.clutter_map import clutter_map, may_be_mapped
from servotrack.envs.track.points.point_extent import (
    check_scales,
    outlier_notes,
    period_of,
    region_of,
    side_of,
)
from servotrack.envs.track.points.point_model import LEAST_NOISE, PointModel, Units, position_noise, tracked
from servotrack.envs.track.points.rounding import rounding_noise
from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs import Trajectory
from servotrack.estimators.types import Array, Labels

_ROUNDS = 3
_FITTED_SCANS = 300
"""Scans that the parameters are measured on: the first ones in which tracks are found."""
_FITTED_POINTS = 20_000
"""Points after which a part ends, if it has a fifth of these scans."""
_PARTS = 20
"""Largest number of such parts that are tried."""
_CHANCE = 0.05
"""Largest probability that a neighbor so close is there by chance."""
_GATE = 1e-3
"""Share of a track's own measurements that its gate excludes when measurements are counted."""
_WINDOWS = (1, 2, 4, 8, 16, 30)
"""Numbers of scans in which the next measurement of a target is searched."""
_SPEEDS = (1e-6, 10.0)
"""Least and largest speed in sides of the region per scan."""
_EQUAL = 1e-3
"""Difference of log-likelihoods that decides nothing."""
_STRAY = 0.01
"""Probability that a measurement of a track belongs to another target."""
_LEAST_RATIO, _MOST_RATIOS, _AS_LIKELY = 4.0, 4, 2.0
"""Ratio of two position noises, how often it is tried, and the log-likelihood that tells them apart (95 %)."""
_LEAST_LENGTH = 4
"""Measurements of a track from which it is used."""
_MANEUVER, _AGILITIES, _MORE_AGILE = 0.05, (5.0, 20.0, 80.0), (1.0, 2.0, 4.0, 8.0, 16.0)
"""Probability of a maneuver in one period, and factors on its process noise that are tried first, and then."""
_EVIDENCE = 10.0
"""Log-likelihood by which maneuvers must explain the tracks better."""
_FIRST_SHARE = 0.1
"""Share of the scans whose new tracks are targets that were there before."""


def measured_model(points: PointScans) -> tuple[PointModel, list[str]]:
    """Measure the parameters of a filter from the points.

    Args:
        points: The points.

    Returns:
        The parameters, and notes on what could not be measured.

    Raises:
        SequenceError: Time steps or extent are so small, or differ so much, that rounding would decide.
    """
    check_scales(points)
    units = Units.of(points)
    scaled = units.points(points)
    guesses = []
    for few in _parts(scaled):
        guess, notes = _first_guess(few)
        guesses.append((guess, notes))
        model = _mapped(few, guess, _refined(few, guess))
        if model is not None:
            model = _maneuvering(few, model)
            notes = notes + _noise_notes(few, model, units.length)
            break
    else:
        model, notes = guesses[0]
        notes.append("no track of four measurements was found: noise and rates are guesses")
    notes += outlier_notes(points)
    # The tracker's region holds the points outside of the measured part, too.
    low, high = region_of(scaled)
    return units.model(model._replace(low=low, high=high), back=True), notes


def _noise_notes(points: PointScans, model: PointModel, length: float) -> list[str]:
    """Return a note if a much smaller or larger position noise explains the tracks as well with another motion.

    Args:
        points: The points.
        model: Measured parameters.
        length: Unit of length, m.
    """
    noise, own = model.measurement_noise, _own_measurements(points, model)
    if noise is None or not own.long:
        return []
    least = _most_likely(points, model, own, held=True)[2] - _AS_LIKELY
    limits = [noise, noise]
    for end, ratio in enumerate((1.0 / _LEAST_RATIO, _LEAST_RATIO)):
        for _ in range(_MOST_RATIOS):
            trial = model._replace(measurement_noise=limits[end] * ratio)
            if limits[end] * ratio < LEAST_NOISE * side_of(points):
                break
            if _most_likely(points, trial, own, held=True)[2] < least:
                break
            limits[end] *= ratio
    if limits[0] == limits[1]:
        return []
    return [
        f"the points tell position noise from process noise poorly: {limits[0] * length:.2g} to "
        f"{limits[1] * length:.2g} m explain them as well as {noise * length:.3g} m; give a known accuracy in columns "
        "cov_xx, cov_xy, cov_yy"
    ]


def _parts(points: PointScans) -> Iterator[PointScans]:
    """Parts of `_FITTED_SCANS` scans: the first with a point, then later ones, all or so many over the whole time."""
    first = next(k for k, scan in enumerate(points.scans) if len(scan))
    starts = np.arange(min(first, len(points.times) - 2), len(points.times) - 1, _FITTED_SCANS)
    # An hour without a target has nothing to measure.
    for start in starts[np.unique(np.linspace(0, len(starts) - 1, min(len(starts), _PARTS)).round().astype(int))]:
        size = np.cumsum([len(scan) for scan in points.scans[start : start + _FITTED_SCANS]])
        # A crowd says as much in fewer scans.
        part = slice(start, start + max(int(np.searchsorted(size, _FITTED_POINTS)) + 1, _FITTED_SCANS // 5))
        part = slice(start, min(part.stop, start + _FITTED_SCANS))
        if any(map(len, points.scans[part])):
            yield points._replace(
                times=points.times[part],
                scans=points.scans[part],
                covariances=None if points.covariances is None else points.covariances[part],
            )


def _refined(points: PointScans, model: PointModel) -> PointModel | None:
    """Parameters after rounds of tracking and counting; None if a round finds no track of four measurements."""
    for _ in range(_ROUNDS):
        own = _own_measurements(points, model)
        if not own.long:
            return None
        model = _fitted(points, model, own)
    return model


def _mapped(points: PointScans, guess: PointModel, found: PointModel | None) -> PointModel | None:
    """The model, or one whose clutter is denser in some places, whichever explains the points better."""
    everything = np.concatenate(points.scans)
    density = clutter_map(everything, guess.low, guess.high)
    if density is None or not may_be_mapped(everything, guess.low, guess.high):
        return found
    other = _refined(points, guess._replace(clutter_map=density))
    if other is None or other.clutter_map is None:
        return found
    if found is None:
        return other
    scores = [_score(points, one, _own_measurements(points, one)) for one in (found, other)]
    return other if scores[1] > scores[0] + _EVIDENCE else found


def _first_guess(points: PointScans) -> tuple[PointModel, list[str]]:
    """Parameters from chains of nearest neighbors."""
    (low, high), side, period = region_of(points), side_of(points), period_of(points)
    count = sum(map(len, points.scans)) / len(points.scans)
    # Where each scan holds few of the targets, such as that of one ship, chains span several scans.
    searched = {window: _chains(points, low, high, window) for window in _WINDOWS if window < len(points.scans)}
    chains, triples = max(searched.values(), key=lambda found: len(found[0]))
    notes = []
    if len(chains):
        bends, speeds, gaps = chains.T
        noise = max(float(np.median(bends)) / 0.6745, rounding_noise(triples), 1e-6 * side)
        speed = _bounded_speed(points, float(np.sqrt(np.mean(speeds**2))))
    else:
        noise, speed, gaps = 1e-3 * side, 1e-2 * side / period, np.ones(1)
        notes.append(
            "no three measurements in a row lie close enough together: the first guess is of the region's size"
        )
    if points.covariances is not None:
        covariances = np.concatenate([scan for scan in points.covariances if len(scan)])
        noise = float(np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2)) / points.dimensions))
        noise = max(noise, LEAST_NOISE * side)
    # A target that is detected in every third scan leaves gaps of three scans.
    gap = float(np.mean(gaps))
    return (
        PointModel(
            period=period,
            low=low,
            high=high,
            process_noise=noise / period**1.5,
            measurement_noise=None if points.covariances is not None else noise,
            detection=0.9 / gap,
            clutter_rate=max(0.3 * count, 0.01),
            births=0.1,
            survival=0.99 ** (1.0 / gap),
            speed=speed,
        ),
        notes,
    )


def _chains(points: PointScans, low: Array, high: Array, window: int) -> tuple[Array, Array]:
    """Chains of three nearest neighbors.

    Returns:
        Departure from a straight line, in measurement errors, speed, and scans per step; a row for each coordinate of
        each chain, shape (k d, 3). Positions, shape (k, 3, d).
    """
    d = points.dimensions
    size = [len(scan) for scan in points.scans]
    start = np.concatenate([[0], np.cumsum(size)])
    place, time = np.concatenate(points.scans), np.repeat(points.times, size)
    scan = np.repeat(np.arange(len(size)), size)
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
    found, chained = [], []
    for i, j in enumerate(later):
        last = later[j] if j >= 0 else -1
        if last < 0 or before[j] != i or before[last] != j:
            continue
        chained.append((i, j, last))
        first, second = time[j] - time[i], time[last] - time[j]
        ratio = second / first
        bend = (place[last] - place[j] - ratio * (place[j] - place[i])) / math.sqrt(1.0 + (1.0 + ratio) ** 2 + ratio**2)
        velocity = (place[last] - place[i]) / (first + second)
        gap = 0.5 * (scan[last] - scan[i])
        found += [(abs(a), v, gap) for a, v in zip(bend, velocity, strict=True)]
    return np.array(found).reshape(-1, 3), place[np.array(chained, dtype=np.int64).reshape(-1, 3)]


class _Own(NamedTuple):
    """The tracks that a model finds, and their own measurements.

    Attributes:
        trajectories: The tracks.
        sequences: Times and positions of the measurements of each track.
        free: Positions of all other points. Shape (k, d).
    """

    trajectories: list[Trajectory]
    sequences: list[list[tuple[float, Array]]]
    free: Array

    @property
    def long(self) -> list[list[tuple[float, Array]]]:
        """Sequences that are long enough to be used."""
        return [one for one in self.sequences if len(one) >= _LEAST_LENGTH]

    @property
    def triples(self) -> Array:
        """Positions of three measurements in a row of one track. Shape (k, 3, d)."""
        places = [np.array([place for _, place in one]) for one in self.long]
        return np.concatenate([np.stack([one[:-2], one[1:-1], one[2:]], axis=1) for one in places])


def _own_measurements(points: PointScans, model: PointModel) -> _Own:
    """Track the points, and assign to each track its own."""
    trajectories = tracked(points, model)
    d, scans = points.dimensions, len(points.times)
    entries = list(range(0, 2 * d, 2))
    row_of = {time: k for k, time in enumerate(points.times.tolist())}
    present: list[list[tuple[int, Array, Array]]] = [[] for _ in range(scans)]
    for t, one in enumerate(trajectories):
        for time, state, P in zip(one.times.tolist(), one.states, one.covariances, strict=True):
            present[row_of[time]].append((t, state[entries], P[np.ix_(entries, entries)]))
    own: list[list[tuple[float, Array]]] = [[] for _ in trajectories]
    R = np.eye(d) * position_noise(points, model) ** 2
    limit, free = float(chdtri(d, _GATE)), [np.ones(len(scan), np.bool_) for scan in points.scans]
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
                free[k][column] = False
    rest = np.concatenate([scan[left] for scan, left in zip(points.scans, free, strict=True)])
    return _Own(trajectories, own, rest)


def _maneuvering(points: PointScans, model: PointModel) -> PointModel:
    """The model with maneuvers, if tracks that may maneuver are so much more likely with them; else as it is."""
    most, best = _EVIDENCE, None
    tracks = tracked(points, model)
    # A track that breaks at a maneuver ends, and another one begins.
    if not tracks or min(one.times[-1] for one in tracks) >= max(one.times[0] for one in tracks):
        return model
    for agility in _AGILITIES:
        trial = model._replace(maneuver=_MANEUVER, agility=agility)
        own = _own_measurements(points, trial)
        if not own.long:
            continue
        gain = _most_likely(points, trial, own)[2] - _most_likely(points, model, own)[2]
        if gain > most:
            most, best = gain, _fitted(points, trial, own)
    if best is None:
        return model
    # Tracks that break at a maneuver do not show it, so that it is the breaks that say how agile the targets are.
    score, chosen = -math.inf, best
    for factor in _MORE_AGILE:
        trial = best._replace(agility=factor * best.agility)
        own = _own_measurements(points, trial)
        if not own.long:
            continue
        trial = _fitted(points, trial, own)
        explained = _score(points, trial, own)
        if explained > score:
            score, chosen = explained, trial
    return chosen


def _score(points: PointScans, model: PointModel, own: _Own) -> float:
    """Log-probability of the points if the tracks are the targets and the rest is clutter, with births and ends."""
    volume = float(np.prod(model.high - model.low))
    scans = sum(round((one.times[-1] - one.times[0]) / model.period) for one in own.trajectories)
    taken = sum(map(len, own.long))
    rest = sum(map(len, points.scans)) - taken
    return (
        _likelihood(points, model, own)
        + len(own.long) * (math.log(model.births / volume) + math.log(1.0 - model.survival))
        + taken * math.log(model.detection)
        + max(scans - taken, 0) * math.log(1.0 - model.detection)
        + rest * math.log(model.clutter_rate / volume)
        + (0.0 if model.clutter_map is None else float(np.log(model.clutter_map(own.free)).sum()))
    )


def _fitted(points: PointScans, model: PointModel, own: _Own) -> PointModel:
    """Parameters that fit the tracks that a model has found."""
    scans, trajectories = len(points.times), own.trajectories
    # The first and the last scan of a track are detections, since tracks are made of them.
    inside = sum(max(len(one) - 2, 0) for one in trajectories)
    detected = sum(max(len(sequence) - 2, 0) for sequence in own.sequences)
    # Per interval, not per scan: sensors that follow one another closely do not make targets die sooner.
    alive = sum(float(one.times[-1] - one.times[0]) / model.period + 1.0 for one in trajectories)
    begin = float(points.times[int(_FIRST_SHARE * scans)])
    watched = max((float(points.times[-1]) - begin) / model.period, 1.0)
    late = sum(one.times[0] > begin for one in trajectories)
    deaths = sum(one.times[-1] < points.times[-1] for one in trajectories)
    process, measurement, _ = _most_likely(points, model, own)
    velocities = np.concatenate([one.states[:, 1::2] for one in trajectories])
    return model._replace(
        agility=max(model.agility * model.process_noise / process, 1.0) if model.maneuver > 0.0 else 1.0,
        process_noise=process,
        measurement_noise=None if model.measurement_noise is None else max(measurement, LEAST_NOISE * side_of(points)),
        detection=float(np.clip((detected + 1.0) / (inside + 2.0), 0.02, 0.99)),
        clutter_rate=max(len(own.free) / scans, 0.01),
        clutter_map=model.clutter_map and clutter_map(own.free, model.low, model.high),
        births=float(np.clip((late + 0.5) / watched, 1e-3, 10.0)),
        survival=float(np.clip(1.0 - (deaths + 0.5) / (alive + 1.0), 0.5, 0.9999)),
        speed=_bounded_speed(points, float(np.sqrt(np.mean(velocities**2)))),
    )


def _bounded_speed(points: PointScans, speed: float) -> float:
    least, most = (share * side_of(points) / period_of(points) for share in _SPEEDS)
    return min(max(speed, least), most)


def _most_likely(points: PointScans, model: PointModel, own: _Own, *, held: bool = False) -> tuple[float, float, float]:
    """Process and measurement noise of greatest likelihood, on a grid of factors that is refined twice, and its log.

    Args:
        points: The points.
        model: Start of the search.
        own: The tracks' own measurements.
        held: True keeps the measurement noise.
    """
    arrays = _arrays(own)
    # The noise of a maneuver stays.
    most_noise = model.agility * model.process_noise
    best, most = np.log2([model.process_noise, position_noise(points, model)]), -np.inf
    fixed = held or model.measurement_noise is None
    # Rounded coordinates repeat or lie on a line exactly, which is no sign of an exact sensor.
    least = 0.0 if fixed else rounding_noise(own.triples)
    for width, step in ((6.0, 2.0), (2.0, 0.5), (0.5, 0.125)):
        factors = np.arange(-width, width + 0.5 * step, step)
        center, most = best, -np.inf
        # Where the likelihood does not change any more, rounding must not choose: the larger noise stays.
        for a in factors[::-1]:
            for b in (0.0,) if fixed else factors[::-1]:
                trial = center + np.array([a, b])
                process, noise = 2.0 ** trial[0], max(2.0 ** trial[1], least)
                agility = max(most_noise / process, 1.0)
                value = _log_likelihood(*arrays, process, noise, model.speed, model.maneuver, agility, model.period)
                if value > most + _EQUAL:
                    best, most = trial, value
    return float(2.0 ** best[0]), max(float(2.0 ** best[1]), least), most


def _likelihood(points: PointScans, model: PointModel, own: _Own) -> float:
    """Log-likelihood of the tracks' measurements with the noises of a model."""
    noises = model.process_noise, position_noise(points, model)
    motion = model.speed, model.maneuver, model.agility, model.period
    return float(_log_likelihood(*_arrays(own), *noises, *motion))


def _arrays(own: _Own) -> tuple[Array, Array, Labels]:
    """Times and positions of the tracks' measurements, sequence by sequence, and the start of each sequence."""
    times = np.array([time for sequence in own.long for time, _ in sequence])
    places = np.array([place for sequence in own.long for _, place in sequence])
    return times, places, np.concatenate([[0], np.cumsum([len(sequence) for sequence in own.long])])


@njit(cache=True, nogil=True)
def _log_likelihood(  # type: ignore[no-untyped-def]
    times, places, start, process, noise, speed, maneuver, agility, period
):
    """Log-likelihood of measurement sequences under nearly constant velocity, axis by axis.

    Both cases of a step, with a maneuver and without, are summed over; the likelier one goes on. A measurement is an
    outlier with the probability `_STRAY`, with Cauchy's density on the scale of the prediction: one that belongs to
    another target must not pass for noise. After two in a row the sequence begins anew.
    """
    total = 0.0
    R = noise * noise
    for sequence in range(start.shape[0] - 1):
        for axis in range(places.shape[1]):
            first = start[sequence]
            x, v = places[first, axis], 0.0
            a, b, c = R, 0.0, speed * speed
            strays = 0
            for k in range(first + 1, start[sequence + 1]):
                t = times[k] - times[k - 1]
                x += t * v
                a += 2.0 * t * b + t * t * c + process * process * t**3 / 3.0
                b += t * c + process * process * t**2 / 2.0
                c += process * process * t
                S = a + R
                error = places[k, axis] - x
                square = error * error / S
                own = (1.0 - _STRAY) * math.exp(-0.5 * square) / math.sqrt(2.0 * math.pi)
                other = _STRAY / (math.pi * (1.0 + square))
                if maneuver > 0.0:
                    turns = 1.0 - (1.0 - maneuver) ** (t / period)
                    extra = (agility * agility - 1.0) * process * process
                    wide = S + extra * t**3 / 3.0
                    agile = math.exp(-0.5 * error * error / wide) / math.sqrt(2.0 * math.pi * wide / S)
                    agile *= (1.0 - _STRAY) * turns
                    own = own * (1.0 - turns) + agile
                    # A mean of both cases would be too wide after every step.
                    if agile > 0.5 * own:
                        a += extra * t**3 / 3.0
                        b += extra * t**2 / 2.0
                        c += extra * t
                total += math.log(own + other) - 0.5 * math.log(S)
                S = a + R
                if other > own:
                    strays += 1
                    if strays == 2:
                        x, v = places[k, axis], 0.0
                        a, b, c, strays = R, 0.0, speed * speed, 0
                    continue
                strays = 0
                x += a / S * error
                v += b / S * error
                c -= b * b / S
                b -= a * b / S
                a -= a * a / S
    return total
