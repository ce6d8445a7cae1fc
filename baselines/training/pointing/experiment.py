"""Run policies that point the sensor, choose the best of each kind on tune seeds, and compare them on test seeds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.training.pointing.planning import relative_errors
from servotrack.baselines.training.pointing.policies import (
    BeliefPlanner,
    FixedScan,
    MyopicRule,
    OraclePointing,
    Policy,
    TrackedTruth,
    UnseenMap,
    belief_of,
)
from servotrack.baselines.training.pointing.scene import PointedEpisode, PointedPMB, PointedScene, pointed_filter
from servotrack.estimators.metrics.sets import gospa, ospa
from servotrack.estimators.metrics.trajectories import ospa2
from servotrack.estimators.stateful import add_axis
from servotrack.estimators.types import Array

SCENES = (
    PointedScene("square", "square", 100.0, {"births": "anywhere"}),
    PointedScene("strip, births at sites", "strip", 100.0),
    PointedScene(
        "fast strip, smooth paths", "strip", 200.0,
        {"births": "anywhere", "acceleration_noise": 1.0, "birth_speed": 20.0},
    ),
    PointedScene(
        "slow square, many misses", "square", 50.0,
        {"births": "anywhere", "detection_probability": 0.6, "clutter_rate": 60.0},
    ),
)  # fmt: skip
"""Scenes of different kinds: shape and rate of the field of view, places of births, motion, misses and clutter."""

KINDS = (
    "fixed scan",
    "myopic rule",
    "searched rule",
    "planner",
    "planner, true tracks",
    "oracle, now",
    "oracle, future",
)
MYOPIC, FUTURE = "myopic rule", "oracle, future"
_FIRST, _AGAIN, _FINALISTS = 12, 36, 3
"""Tune episodes on which all candidates of a kind are compared, further ones for the best of them, and their number."""
_TUNE_OFFSET, _TEST_OFFSET = 70_000, 600_000
_DRAWS = 30
"""Number of blends of myopic values that the search draws."""


@dataclass(frozen=True)
class Outcome:
    """Test episodes of the best policy of a kind; N episodes.

    Attributes:
        policy: The policy, as text.
        cost: Mean GOSPA / c of a scan, shape (N,).
        ospa: Mean OSPA of a scan, shape (N,), m.
        ospa2: OSPA(2), shape (N,), m.
        seen: Share of the targets that stand in the field of view, mean over scans, shape (N,).
    """

    policy: str
    cost: Array
    ospa: Array
    ospa2: Array
    seen: Array


def candidates(kind: str, scene: PointedScene) -> Iterator[Policy]:
    """Return the policies of a kind among which the best is chosen on tune seeds."""
    if kind == "fixed scan":
        yield FixedScan(((0.0, 0.0),))
        line = (0.3, 0.6, 1.0) if scene.shape == "square" else (0.25, 0.5, 0.75, 1.0)
        for reach, dwell in product(line, (0, 10)):
            yield FixedScan(((-reach, 0.0), (reach, 0.0)), dwell)
            if scene.shape == "square":
                yield FixedScan(((-reach, -reach), (-reach, reach), (reach, reach), (reach, -reach)), dwell)
        if scene.shape == "strip":
            for place in (-0.3, 0.3):
                yield FixedScan(((place, 0.0),))
            yield FixedScan(((-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 0.0)), 10)
    elif kind == MYOPIC:
        for value, unseen, discount in product(("number", "information", "cost"), (0.3, 1.0, 3.0), (0.0, 0.9)):
            yield MyopicRule(**{value: 1.0}, unseen=unseen, discount=discount)
    elif kind == "searched rule":
        rng = np.random.default_rng(0)
        for _ in range(_DRAWS):
            # A nat is a small unit beside a target: a fresh measurement is worth some ten of them.
            number, information, cost = rng.dirichlet(np.ones(3)) * (1.0, 0.1, 2.0)
            unseen, discount = np.exp(rng.uniform(np.log(0.2), np.log(4.0))), 1.0 - np.exp(rng.uniform(-4.0, -1.0))
            yield MyopicRule(*(round(float(one), 3) for one in (number, information, cost, unseen, discount)))
    elif kind == "planner":
        for decisions, unseen in product((4, 6), (0.5, 1.0)):
            yield BeliefPlanner(decisions, 3, unseen)
    elif kind == "planner, true tracks":
        for unseen in (0.5, 1.0):
            yield TrackedTruth(4, 3, unseen)
    else:
        for hold in (2, 3):
            yield OraclePointing(6, hold, kind == FUTURE)


def outcome(kind: str, scene: PointedScene, episodes: int, folder: Path) -> Outcome:
    """Choose the best policy of a kind on tune seeds and run it on test seeds; a finished outcome is read again.

    Args:
        kind: One of `KINDS`.
        scene: The scene.
        episodes: Number of test episodes.
        folder: Folder in which outcomes are kept.
    """
    path = folder / f"{scene.name}, {kind}, {episodes}.json"
    if not path.exists():
        policy = _best(list(candidates(kind, scene)), scene)
        found = {"policy": repr(policy), **_columns(scene, policy, take("test", episodes, _TEST_OFFSET))}
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(found) + "\n", encoding="utf-8")
    found = json.loads(path.read_text(encoding="utf-8"))
    return Outcome(found.pop("policy"), **{name: np.array(values) for name, values in found.items()})


def _best(policies: list[Policy], scene: PointedScene) -> Policy:
    """Return the policy of least cost on tune seeds: all on a few episodes, the best ones on more."""
    costs = [np.mean(_columns(scene, one, take("tune", _FIRST, _TUNE_OFFSET))["cost"]) for one in policies]
    finalists = [policies[i] for i in np.argsort(costs)[:_FINALISTS]]
    more = take("tune", _AGAIN, _TUNE_OFFSET + _FIRST)
    return min(finalists, key=lambda one: float(np.mean(_columns(scene, one, more)["cost"])))


def _columns(scene: PointedScene, policy: Policy, seeds: Sequence[int]) -> dict[str, list[float]]:
    tracker = pointed_filter(scene)
    rows = [run_episode(scene, policy, seed, tracker) for seed in seeds]
    return {name: [row[name] for row in rows] for name in rows[0]}


def run_episode(scene: PointedScene, policy: Policy, seed: int, tracker: PointedPMB) -> dict[str, float]:
    """Run a policy on an episode; return the numbers of `Outcome`. The tracker is the scene's filter."""
    episode = PointedEpisode(scene, seed)
    cutoff, horizon = scene.config.cutoff, scene.config.horizon
    center, unseen = np.zeros(2), UnseenMap(scene)
    state = tracker.initial(np.zeros((0, 2)))
    tracks: dict[int, Array] = {}
    cost, distance, seen, targets = 0.0, 0.0, 0, 0
    for k in range(horizon):
        belief = belief_of(add_axis(state), unseen.weights)
        center = scene.moved(center, policy.center(scene, k, center, belief, episode))
        tracker.look(center)
        unseen.advance(center)
        state, estimate = tracker.step(state, episode.scan(k, center))
        truth = episode.positions[k][episode.episode.exists[k]]
        places = estimate.states[:, [0, 2]]
        deviation = np.sqrt(0.5 * (estimate.covariances[:, 0, 0] + estimate.covariances[:, 2, 2]))
        # The report of least expected GOSPA: a track counts 1 - its relative error if it is there, at a price of 1/2.
        reported = estimate.existence * (1.0 - relative_errors(deviation, cutoff)) > 0.5
        cost += float(gospa(truth, places[reported], cutoff).total) / cutoff
        distance += float(ospa(truth, places, cutoff))
        for label, place in zip(estimate.labels, places, strict=True):
            tracks.setdefault(int(label), np.full((horizon, 2), np.nan))[k] = place
        seen += int(scene.sees(center, truth).sum())
        targets += len(truth)
    true = np.where(episode.episode.exists[:horizon, :, None], episode.positions[:horizon], np.nan).swapaxes(0, 1)
    true = true[~np.isnan(true[..., 0]).all(axis=1)]
    found = np.array(list(tracks.values())).reshape(-1, horizon, 2)
    return {
        "cost": cost / horizon,
        "ospa": distance / horizon,
        "ospa2": ospa2(true, found, cutoff),
        "seen": seen / max(targets, 1),
    }
