"""Following one of many by several hypotheses: crossings, covers, shared detections and bad input."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.follow import CrowdFollower, CrowdState, StillCamera

FRESH, PERIOD, STILL = np.ones(1, np.bool_), np.full(1, 0.05), np.zeros((1, 2))
RED, BLUE = [180.0, 40.0, 40.0], [40.0, 60.0, 170.0]
WIDTH = 40.0


def table(*people: tuple[float, float, list[float]]) -> np.ndarray:
    rows = np.zeros((1, 6, 8))
    for row, (u, v, color) in zip(rows[0], people, strict=False):
        row[:] = [1.0, u, v, WIDTH, WIDTH, *color]
    return rows


def begin(follower: CrowdFollower, u: float, v: float, color: list[float], *others: tuple) -> CrowdState:
    place = np.array([[u, v]])
    return follower.initial(table((u, v, color), *others), place, np.full(1, WIDTH), np.array([color]))


def step(follower: CrowdFollower, state: CrowdState, detections: np.ndarray):  # type: ignore[no-untyped-def]
    return follower.step(state, detections, FRESH, PERIOD, StillCamera(), STILL, STILL, np.zeros(1))


@pytest.mark.parametrize("other", [RED, BLUE])
def test_two_people_cross_and_keep_their_identities(other):
    follower = CrowdFollower()
    state = begin(follower, 140.0, 200.0, RED, (340.0, 206.0, other))
    for k in range(1, 60):
        a, b = (140.0 + 4.0 * k, 200.0, RED), (340.0 - 4.0 * k, 206.0, other)
        near = abs(a[0] - b[0]) < 0.8 * WIDTH
        middle = (0.5 * (a[0] + b[0]), 203.0, list(0.5 * (np.array(RED) + np.array(other))))
        state, sighting = step(follower, state, table(middle) if near else table(a, b))
    assert sighting.visible.all()
    np.testing.assert_allclose(sighting.features, [[a[0], a[1]]], atol=6.0)


def test_a_hidden_person_comes_out_on_the_other_side_and_not_as_somebody_else():
    follower = CrowdFollower()
    state = begin(follower, 100.0, 200.0, RED)
    for k in range(1, 45):
        there = (100.0 + 3.0 * k, 200.0, RED)
        stranger = (300.0, 400.0 - 3.0 * k, BLUE)
        state, sighting = step(follower, state, table(stranger) if 20 <= k < 35 else table(there, stranger))
        if 22 <= k < 35:
            assert not sighting.visible.any()
    assert sighting.visible.all()
    np.testing.assert_allclose(sighting.features, [[there[0], there[1]]], atol=1e-9)


def test_clutter_beside_the_person_does_not_lead_astray():
    follower, rng = CrowdFollower(), np.random.default_rng(3)
    state = begin(follower, 200.0, 200.0, RED)
    for k in range(1, 60):
        false = [(*rng.uniform(0.0, 480.0, 2), list(rng.uniform(15.0, 240.0, 3))) for _ in range(3)]
        there = (200.0 + 2.0 * k, 200.0, RED)
        state, _ = step(follower, state, table(*false, *([there] if rng.random() > 0.15 else [])))
    np.testing.assert_allclose(state.place, [[there[0], there[1]]], atol=8.0)


def test_the_crowd_says_where_the_image_moved():
    follower = CrowdFollower()
    people = [(120.0, 100.0, RED), (300.0, 140.0, BLUE), (220.0, 330.0, BLUE)]
    state = begin(follower, *people[0], *people[1:])
    for _ in range(10):
        state, _ = step(follower, state, table(*people))
    shifted = [(u + 60.0, v - 35.0, color) for u, v, color in people]
    state, sighting = follower.step(
        state, table(*shifted), FRESH, PERIOD, StillCamera(), STILL, STILL, np.full(1, 40.0**2)
    )
    assert sighting.visible.all()
    np.testing.assert_allclose(sighting.features, [[180.0, 65.0]])


def test_runs_are_independent_and_stay_where_there_is_no_frame():
    follower = CrowdFollower()
    detections = np.concatenate([table((100.0, 100.0, RED)), table((200.0, 300.0, BLUE))])
    place = np.array([[100.0, 100.0], [200.0, 300.0]])
    state = follower.initial(detections, place, np.full(2, WIDTH), np.array([RED, BLUE]))
    still, fresh = np.zeros((2, 2)), np.array([True, False])
    moved = detections.copy()
    moved[:, 0, 1] += 3.0
    new, sighting = follower.step(state, moved, fresh, np.full(2, 0.05), StillCamera(), still, still, np.zeros(2))
    assert sighting.visible.tolist() == [True, False]
    np.testing.assert_array_equal(new.place[1], state.place[1])
    alone = begin(follower, 100.0, 100.0, RED)
    alone, _ = step(follower, alone, moved[:1])
    np.testing.assert_allclose(new.place[0], alone.place[0])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [({"detection": 1.0}, "detection must lie in"), ({"speed": -1.0}, "speed must be finite and > 0")],
)
def test_bad_parameters_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        CrowdFollower(**keywords)


def test_bad_input_is_refused():
    follower = CrowdFollower()
    place, color = np.array([[100.0, 100.0]]), np.array([RED])
    with pytest.raises(ValueError, match="width must be > 0 px"):
        follower.initial(table(), place, np.zeros(1), color)
    state = begin(follower, 100.0, 100.0, RED)
    with pytest.raises(ValueError, match="fresh must have shape"):
        follower.step(state, table(), np.ones(2, bool), PERIOD, StillCamera(), STILL, STILL, np.zeros(1))
    with pytest.raises(ValueError, match="of the state's 1 runs"):
        follower.step(state, np.zeros((2, 3, 8)), FRESH, PERIOD, StillCamera(), STILL, STILL, np.zeros(1))
    with pytest.raises(ValueError, match="ego_variance"):
        follower.step(state, table(), FRESH, PERIOD, StillCamera(), STILL, STILL, np.full(1, np.nan))
