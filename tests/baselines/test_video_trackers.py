"""Detectors and trackers by name; the preset of Wu and Hu 2010 against its equations written out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from servotrack.baselines.agents.people.catalog import (
    BODY_WIDTH,
    DETECTORS,
    TRACKERS,
    centroid_filter,
    create_detector,
    create_tracker,
    phd_as_printed,
)
from servotrack.baselines.agents.people.trackers_package import PEERS, PeerTracker
from servotrack.estimators.detect import detections_from_boxes

OURS = [name for name in TRACKERS if name not in PEERS]
KAPPA = 0.01 / (380.0 * 280.0)
F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
Q = 16.0 * np.kron(np.eye(2), [[0.25, 0.5], [0.5, 1.0]])
H = np.kron(np.eye(2), [[1.0, 0.0]])
R = 4.0 * np.eye(2)


def density(z: np.ndarray, mean: np.ndarray, S: np.ndarray) -> float:
    gap = z - mean
    return float(np.exp(-0.5 * gap @ np.linalg.solve(S, gap)) / (2.0 * np.pi * np.sqrt(np.linalg.det(S))))


def corrected(m: np.ndarray, P: np.ndarray, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """q(z), m and P after a measurement: equations (15) to (17)."""
    S = R + H @ P @ H.T
    K = P @ H.T @ np.linalg.inv(S)
    return density(z, H @ m, S), m + K @ (z - H @ m), (np.eye(4) - K @ H) @ P


def test_table_one_runs_by_the_equations() -> None:
    z1, z2, z3 = np.array([50.0, 80.0]), np.array([53.0, 79.0]), np.array([57.0, 79.0])
    phd = phd_as_printed()
    state = phd.initial(np.zeros((0, 2)))
    state, _ = phd.step(state, z1[None])

    # Frame 2: the birth at the first measurement is all there is.
    start = np.diag([4.0, 4.0, 4.0, 4.0])
    m, P = F @ [50.0, 0.0, 80.0, 0.0], F @ start @ F.T + Q
    q, m, P = corrected(m, P, z2)
    w = 0.99 * 0.05 * q / (KAPPA + 0.99 * 0.05 * q)
    state, estimate = phd.step(state, z2[None])
    assert state.intensity.number == 1  # what was missed, (12), is lighter than T
    assert estimate.existence[0] == pytest.approx(w, rel=1e-9)
    assert np.allclose(estimate.states[0], m)
    assert np.allclose(estimate.covariances[0], P)

    # Frame 3: the survivor, what it split off, and a birth at the second measurement; then (12) to (18).
    beta = np.diag([BODY_WIDTH**2, 1.0, BODY_WIDTH**2, 1.0])
    born = F @ [53.0, 0.0, 79.0, 0.0], F @ start @ F.T + Q
    predicted = [
        (0.9 * w, F @ m, F @ P @ F.T + Q),
        (0.02 * w, F @ m, F @ P @ F.T + beta),
        (0.05, *born),
    ]
    weights, means = [], []
    for weight, mean, covariance in predicted:
        q, after, _ = corrected(mean, covariance, z3)
        weights.append(0.99 * weight * q)
        means.append(after)
    weights = list(np.array(weights) / (KAPPA + sum(weights)))
    kept = [k for k in range(3) if weights[k] >= 0.2]
    state, estimate = phd.step(state, z3[None])
    assert kept == [0]
    assert state.intensity.number == 1
    assert estimate.existence[0] == pytest.approx(weights[0], rel=1e-9)
    assert np.allclose(estimate.states[0], means[0])


def test_table_one_forgets_whoever_is_missed_once() -> None:
    phd, z = phd_as_printed(), np.array([[50.0, 80.0]])
    state = phd.initial(z)
    for _ in range(5):
        state, estimate = phd.step(state, z)
    assert len(estimate.labels) == 1
    state, estimate = phd.step(state, np.zeros((0, 2)))
    assert len(estimate.labels) == 0
    assert state.intensity.number == 0


@pytest.mark.parametrize("name", OURS)
def test_trackers_follow_a_walker_at_any_size_and_rate(name: str) -> None:
    for size, rate, pace in (((384, 288), 25.0, 1.0), ((1920, 1080), 10.0, 9.0), (None, 25.0, 1.0)):
        tracker = create_tracker(name, size, rate)
        scale = 1.0 if size is None else size[1] / 288.0
        state: Any = tracker.initial(detections_from_boxes(np.zeros((0, 4))))
        for k in range(15):
            box = [scale * 100.0 + pace * k, scale * 80.0, scale * 20.0, scale * 60.0]
            state, estimate = tracker.step(state, detections_from_boxes([box]))
        assert len(estimate.labels) == 1
        assert np.abs(estimate.states[0] - box).max() < 4.0 * scale


@pytest.mark.parametrize("name", OURS)
def test_filters_of_centroids_have_the_same_names(name: str) -> None:
    made = centroid_filter(name, (384, 288), 25.0)
    state = made.initial(np.zeros((0, 2)))
    for k in range(10):
        state, estimate = made.step(state, np.array([[100.0 + k, 80.0]]))
    assert len(estimate.labels) == 1
    assert np.abs(estimate.states[0, [0, 2]] - [109.0, 80.0]).max() < 2.0


@pytest.mark.parametrize("name", DETECTORS)
def test_detectors_find_what_moves(name: str) -> None:
    detector = create_detector(name)
    rng = np.random.default_rng(1)
    still = rng.integers(90, 110, (144, 192, 3)).astype(np.uint8)
    state = detector.initial([still] * 30)
    frame = still.copy()
    frame[40:100, 60:80] = 220
    for _ in range(3):
        state, found = detector.step(state, frame)
    assert len(found.boxes) == 1
    assert np.abs(found.boxes[0] - [60.0, 40.0, 20.0, 60.0]).max() <= 4.0


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(ValueError, match="did you mean 'gm-phd'"):
        create_tracker("gmphd", (384, 288), 25.0)
    with pytest.raises(ValueError, match="known are pmb"):
        create_tracker("xyz", (384, 288), 25.0)
    with pytest.raises(ValueError, match="did you mean 'masked'"):
        create_detector("maskd")
    with pytest.raises(ValueError, match="frame_rate"):
        create_tracker("pmb", (384, 288), 0.0)
    with pytest.raises(ValueError, match="frame_size"):
        create_tracker("pmb", (0, 288), 25.0)


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_that_is_not_installed_says_how_to_get_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trackers", None)
    with pytest.raises(ImportError, match=r"servotrack\[trackers\]"):
        create_tracker(name, (384, 288), 25.0)


def test_a_peer_runs_behind_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    class Found:
        def __init__(self, xyxy: np.ndarray, confidence: np.ndarray, class_id: np.ndarray) -> None:
            self.xyxy, self.confidence = xyxy, confidence
            self.tracker_id: Any = None

    class Sort:
        def __init__(self, frame_rate: float) -> None:
            self.frame_rate, self.frames = frame_rate, 0

        def update(self, detections: Found) -> Found:
            # The package's trackers say -1 for what they do not report yet.
            self.frames += 1
            detections.tracker_id = np.arange(len(detections.xyxy)) if self.frames > 1 else np.full(2, -1)
            return detections

    trackers, supervision = type(sys)("trackers"), type(sys)("supervision")
    trackers.SORTTracker, supervision.Detections = Sort, Found  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "trackers", trackers)
    monkeypatch.setitem(sys.modules, "supervision", supervision)
    tracker = PeerTracker("sort", 10.0)
    boxes = np.array([[10.0, 20.0, 30.0, 40.0], [50.0, 20.0, 30.0, 40.0]])
    first = tracker.initial(detections_from_boxes(boxes))
    second, estimate = tracker.step(first, detections_from_boxes(boxes))
    assert len(estimate.labels) == 0
    _, estimate = tracker.step(second, detections_from_boxes(boxes))
    assert estimate.labels.tolist() == [1, 2]
    assert np.array_equal(estimate.states, boxes)
    with pytest.raises(ValueError, match="step from the last state"):
        tracker.step(first, detections_from_boxes(boxes))
