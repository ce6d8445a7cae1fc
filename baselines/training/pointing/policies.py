"""Policies that point the sensor: fixed scans, myopic rules, planning on the filter's belief, and oracles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from servotrack.baselines.training.pointing.planning import LOST_ERROR, NEW_VARIANCE, plan_center, relative_errors
from servotrack.baselines.training.pointing.scene import PointedEpisode, PointedScene
from servotrack.estimators.rfs.pmb import PMBState
from servotrack.estimators.types import Array

_CELLS = 20
"""Cells of the map of unseen targets along each axis."""
_BLOCK = 4
"""Cells along each axis that planning joins into one possible target."""
_NEAR = 2.0
"""Largest distance of a target from its track, cut-offs."""
_LEAST = 0.01
"""Least expected number of unseen targets in such a block for planning to count it."""


class Belief(NamedTuple):
    """Targets that the filter knows, one Gaussian each, and the map of unseen ones, after a scan.

    Attributes:
        existence: Probability of existence of each track, shape (k,).
        states: Mean states, shape (k, 4), m and m/s.
        spread: Mean covariance per axis: position, both, velocity, shape (k, 3).
        unseen: Expected number of unseen targets in each cell of a map, shape (_CELLS, _CELLS).
    """

    existence: Array
    states: Array
    spread: Array
    unseen: Array


def belief_of(state: PMBState, unseen: Array) -> Belief:
    """Return the belief of a filter's state and a map of unseen targets."""
    tracks, pool = state.tracks, state.pool
    number = int(tracks.number[0])
    owner = np.repeat(np.arange(number), tracks.size[0, :number])
    used = len(owner)
    weight, mean, covariance = pool.weight[0, :used], pool.mean[0, :used, :4], pool.covariance[0, :used, :4, :4]
    states = np.zeros((number, 4))
    np.add.at(states, owner, weight[:, None] * mean)
    away = mean - states[owner]
    second = covariance + away[:, :, None] * away[:, None, :]
    joint = np.zeros((number, 4, 4))
    np.add.at(joint, owner, weight[:, None, None] * second)
    spread = 0.5 * np.stack(
        [joint[:, 0, 0] + joint[:, 2, 2], joint[:, 0, 1] + joint[:, 2, 3], joint[:, 1, 1] + joint[:, 3, 3]], axis=1
    )
    return Belief(tracks.existence[0, :number].copy(), states, spread, unseen)


class UnseenMap:
    """Expected number of targets that no track stands for, per cell of a map.

    Args:
        scene: The scene, whose births and field of view are known.

    Attributes:
        weights: Expected number of unseen targets in each cell, shape (_CELLS, _CELLS).
    """

    def __init__(self, scene: PointedScene) -> None:
        config, self.scene = scene.config, scene
        share = np.full((_CELLS, _CELLS), _CELLS**-2.0)
        if config.births == "sites":
            share[:] = 0.0
            row, column = np.floor((config.sites + config.half_width) / _side(scene)).astype(int).T
            np.add.at(share, (row, column), 1.0 / len(row))
        self._births, self.weights = share * config.birth_rate, share * config.initial_targets
        # Share of a cell's targets that cross one of its sides in a scan.
        speed = np.hypot(config.birth_speed, 2.0 * config.acceleration_noise)
        self._leak = min(0.2, 0.4 * speed * config.period / _side(scene))

    def advance(self, center: Array) -> None:
        """Advance the map by one scan with the sensor at `center`."""
        config = self.scene.config
        # Targets that leave the region disappear.
        field = np.pad(self.weights, 1)
        around = field[:-2, 1:-1] + field[2:, 1:-1] + field[1:-1, :-2] + field[1:-1, 2:]
        field = (1.0 - 4.0 * self._leak) * field[1:-1, 1:-1] + self._leak * around
        east, north = (_cells_inside(self.scene, axis, center[axis : axis + 1])[0] for axis in (0, 1))
        seen = config.detection_probability * np.outer(east, north)
        self.weights = (config.survival_probability * field + self._births) * (1.0 - seen)


def _side(scene: PointedScene) -> float:
    return 2.0 * scene.config.half_width / _CELLS


def _middles(scene: PointedScene) -> Array:
    """Coordinates of the middles of the cells along an axis, shape (_CELLS,), m."""
    return np.asarray(_side(scene) * (np.arange(_CELLS) + 0.5) - scene.config.half_width)


def _cells_inside(scene: PointedScene, axis: int, centers: Array) -> Array:
    """Share of each cell that the field of view covers along an axis, shape (g, _CELLS)."""
    return scene.inside(axis, centers, _middles(scene), np.full(_CELLS, _side(scene) / np.sqrt(12.0)))


class Policy(Protocol):
    """A rule that points the sensor."""

    def center(self, scene: PointedScene, k: int, center: Array, belief: Belief, episode: PointedEpisode) -> Array:
        """Return the center wanted at scan k, given the belief after scan k - 1."""


@dataclass(frozen=True)
class FixedScan:
    """Drive along places one after the other, whatever is seen.

    Attributes:
        places: Places, shape (n, 2), shares of the limit of the center; one place is a sensor at rest.
        dwell: Scans for which the sensor rests at each place.
    """

    places: tuple[tuple[float, float], ...]
    dwell: int = 0

    def center(self, scene: PointedScene, k: int, center: Array, belief: Belief, episode: PointedEpisode) -> Array:
        """See `Policy`."""
        goals = np.array(self.places) * scene.limit
        rate = scene.rate
        legs = np.abs(np.roll(goals, -1, axis=0) - goals).max(axis=1)
        times = np.ceil(legs / rate) + self.dwell
        if times.sum() == 0.0:
            return np.asarray(goals[0])
        # The first place is reached from wherever the sensor begins.
        start = np.ceil(np.abs(goals[0]).max() / rate)
        if k < start:
            return np.asarray(goals[0])
        phase = (k - start) % times.sum()
        leg = int(np.searchsorted(np.cumsum(times), phase, side="right"))
        within = phase - (np.cumsum(times)[leg] - times[leg])
        return np.asarray(goals[leg] if within < self.dwell else goals[(leg + 1) % len(goals)])


@dataclass(frozen=True)
class MyopicRule:
    """Turn toward the place whose one scan is worth most now, discounted by the time to get there.

    A scan is worth a weighted sum over the targets in the field of view.

    Attributes:
        number: Weight of the expected number of targets seen.
        information: Weight of the expected information about their positions, nat.
        cost: Weight of the expected decrease of the scan's GOSPA / c.
        unseen: Weight of an unseen target beside a track. Raising it explores more.
        discount: Factor of a place's value per scan of travel. 0 compares only places within reach of one scan.
    """

    number: float = 0.0
    information: float = 0.0
    cost: float = 0.0
    unseen: float = 1.0
    discount: float = 0.0

    def center(self, scene: PointedScene, k: int, center: Array, belief: Belief, episode: PointedEpisode) -> Array:
        """See `Policy`."""
        east, north = (_goals(scene, axis, center, self.discount == 0.0) for axis in (0, 1))
        config = scene.config
        dt, q, noise = config.period, config.acceleration_noise**2, config.position_noise**2
        pp = belief.spread[:, 0] + dt * (2.0 * belief.spread[:, 1] + dt * belief.spread[:, 2]) + q * dt**3 / 3.0
        place = belief.states[:, [0, 2]] + dt * belief.states[:, [1, 3]]
        before, after = (relative_errors(np.sqrt(part), config.cutoff) for part in (pp, pp * noise / (pp + noise)))
        gain = np.minimum(before, LOST_ERROR) - after
        worth = self.number + self.information * np.log1p(pp / noise) + self.cost * gain
        fresh = self.number + self.information * np.log1p(NEW_VARIANCE / noise) + self.cost * LOST_ERROR
        deviation = np.sqrt(pp)
        across = scene.inside(0, east, place[:, 0], deviation) * (belief.existence * worth)
        value = across @ scene.inside(1, north, place[:, 1], deviation).T
        unseen = _cells_inside(scene, 0, east) @ belief.unseen @ _cells_inside(scene, 1, north).T
        value += self.unseen * fresh * unseen
        farthest = np.maximum(np.abs(east - center[0])[:, None], np.abs(north - center[1]))
        if self.discount > 0.0:
            value *= self.discount ** np.maximum(np.ceil(farthest / scene.rate) - 1.0, 0.0)
        # Of equal places the nearest, so that a sensor with nothing to see rests.
        value -= 1e-9 * farthest
        best = np.unravel_index(int(np.argmax(value)), value.shape)
        return np.array([east[best[0]], north[best[1]]])


def _goals(scene: PointedScene, axis: int, center: Array, near: bool) -> Array:
    """Coordinates to compare along an axis: those within reach of one scan, or all, beside where the sensor is."""
    if scene.rates[axis] == 0.0:
        return np.zeros(1)
    if near:
        steps = np.linspace(-1.0, 1.0, 5) * scene.rates[axis]
        return np.asarray(np.clip(center[axis] + steps, -scene.limit[axis], scene.limit[axis]))
    return np.r_[center[axis], np.linspace(-scene.limit[axis], scene.limit[axis], 21)]


@dataclass(frozen=True)
class BeliefPlanner:
    """Plan a path over the tracks, which go straight on, and the map of unseen targets.

    Attributes:
        decisions, hold: See `plan_center`.
        unseen: Weight of an unseen target beside a track.
    """

    decisions: int = 6
    hold: int = 3
    unseen: float = 1.0

    def center(self, scene: PointedScene, k: int, center: Array, belief: Belief, episode: PointedEpisode) -> Array:
        """See `Policy`."""
        scans = self.decisions * self.hold
        ahead = scene.config.period * np.arange(1, scans + 1)[:, None, None]
        going = belief.states[None, :, [0, 2]] + ahead * belief.states[None, :, [1, 3]]
        blocks = _CELLS // _BLOCK
        share = belief.unseen.reshape(blocks, _BLOCK, blocks, _BLOCK).sum(axis=(1, 3)).ravel()
        middles = _middles(scene).reshape(blocks, _BLOCK).mean(axis=1)
        cells = np.stack(np.meshgrid(middles, middles, indexing="ij"), axis=-1).reshape(-1, 2)
        share, cells = share[share > _LEAST], cells[share > _LEAST]
        places = np.concatenate([going, np.broadcast_to(cells, (scans, *cells.shape))], axis=1)
        inside = (np.abs(going) <= scene.config.half_width).all(axis=-1)
        survival = scene.config.survival_probability ** np.arange(1, scans + 1)[:, None]
        weights = np.concatenate(
            [belief.existence * inside * survival, np.broadcast_to(self.unseen * share, (scans, len(share)))], axis=1
        )
        certainty = np.r_[np.ones(len(belief.existence)), np.zeros(len(share))]
        spread = np.concatenate(
            [belief.spread, np.tile([NEW_VARIANCE, 0.0, scene.config.birth_speed**2], (len(share), 1))]
        )
        return _planned(scene, center, places, weights, certainty, spread, self.decisions, self.hold)


@dataclass(frozen=True)
class TrackedTruth(BeliefPlanner):
    """The planner with the true states of the targets that its tracks stand for; unseen targets stay unknown."""

    def center(self, scene: PointedScene, k: int, center: Array, belief: Belief, episode: PointedEpisode) -> Array:
        """See `Policy`."""
        now = max(k - 1, 0)
        states = episode.episode.states[now][episode.episode.exists[now]]
        existence, true = np.zeros(len(belief.existence)), belief.states.copy()
        for target in states:
            near = _track_of(scene, belief, target[[0, 2]])
            if near >= 0:
                existence[near], true[near] = belief.existence[near], target
        return super().center(scene, k, center, belief._replace(existence=existence, states=true), episode)


def _track_of(scene: PointedScene, belief: Belief, place: Array) -> int:
    """Return the track that is nearest to a target, shape (2,) m, and near it; -1 without one."""
    away = np.hypot(*(belief.states[:, [0, 2]] - place).T)
    near = int(np.argmin(away)) if len(away) else -1
    return near if near >= 0 and away[near] < _NEAR * scene.config.cutoff else -1


@dataclass(frozen=True)
class OraclePointing:
    """Plan a path over the true targets.

    Attributes:
        decisions, hold: See `plan_center`.
        future: True: all births, deaths and turns to come are known; False: the targets of now, which go straight on.
    """

    decisions: int = 6
    hold: int = 2
    future: bool = True

    def center(self, scene: PointedScene, k: int, center: Array, belief: Belief, episode: PointedEpisode) -> Array:
        """See `Policy`."""
        scans, last = self.decisions * self.hold, len(episode.positions) - 1
        truth, now = episode.episode, max(k - 1, 0)
        if self.future:
            index = np.minimum(np.arange(k, k + scans), last)
            places, weights = episode.positions[index], truth.exists[index].astype(np.float64)
        else:
            states = truth.states[now]
            ahead = scene.config.period * np.arange(1, scans + 1)[:, None, None]
            places = states[None, :, [0, 2]] + ahead * states[None, :, [1, 3]]
            inside = (np.abs(places) <= scene.config.half_width).all(axis=-1)
            weights = truth.exists[now] * inside * 1.0
        used = np.flatnonzero(weights.any(axis=0))
        if len(used) == 0:
            return center
        certainty = np.zeros(len(used))
        spread = np.tile([NEW_VARIANCE, 0.0, scene.config.birth_speed**2], (len(used), 1))
        for row, target in enumerate(used):
            near = _track_of(scene, belief, episode.positions[now, target]) if truth.exists[now, target] else -1
            if near >= 0:
                certainty[row], spread[row] = belief.existence[near], belief.spread[near]
        places, weights = np.ascontiguousarray(places[:, used]), np.ascontiguousarray(weights[:, used])
        return _planned(scene, center, places, weights, certainty, spread, self.decisions, self.hold)


def _planned(
    scene: PointedScene, center: Array, places: Array, weights: Array, certainty: Array, spread: Array,
    decisions: int, hold: int,
) -> Array:  # fmt: skip
    config = scene.config
    numbers = (
        config.period, config.acceleration_noise**2, config.position_noise**2, config.detection_probability,
        config.birth_speed**2, config.cutoff,
    )  # fmt: skip
    return np.asarray(
        plan_center(
            center, scene.rates, scene.limit, scene.half, places, weights, certainty, spread, numbers, decisions, hold
        )
    )
