"""Numbers of people with intervals."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from servotrack.estimators.boxes import LineCount, ZoneCount, people_count, set_of_boxes
from servotrack.estimators.boxes.counting import NOBODY, add_chances, add_missed
from servotrack.estimators.rfs.sets import SetEstimate


def seen(feet: list[tuple[float, float]], labels: list[int], existence: list[float]) -> SetEstimate:
    boxes = np.array([[x - 10.0, y - 60.0, 20.0, 60.0] for x, y in feet]).reshape(-1, 4)
    return set_of_boxes(boxes, np.zeros((len(boxes), 4, 4)), np.array(labels, np.int64), np.array(existence))


ONE = seen([(0.0, 0.0)], [1], [0.9])
ZONE = ZoneCount([(0.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
LINE = LineCount((0.0, 0.0), (1.0, 1.0))


def test_numbers_have_the_distribution_of_all_combinations() -> None:
    chances = [0.9, 0.5, 0.2, 0.7]
    wanted = np.zeros(5)
    for here in product([0, 1], repeat=4):
        wanted[sum(here)] += np.prod([p if a else 1.0 - p for p, a in zip(chances, here, strict=True)])
    number = add_chances(add_chances(NOBODY, chances[:1]), chances[1:])
    assert number.first == 0
    assert np.allclose(number.probability, wanted)
    assert number.interval().expected == pytest.approx(sum(chances))
    assert add_chances(NOBODY, [1.0, 1.0]).interval() == (2.0, 2, 2)


def test_intervals_cover_the_number_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(400):
        existence = rng.uniform(0.1, 1.0, 40)
        estimate = seen([(10.0, 70.0)] * 40, list(range(1, 41)), existence.tolist())
        held = np.concatenate([estimate.existence, estimate.held_existence])
        number = (rng.random(len(held)) < held).sum() + rng.poisson(0.3 * held.sum())
        count = people_count(estimate, undetected=0.3)
        inside += count.low <= number <= count.high
    assert 0.87 <= inside / 400 <= 0.97


def test_undetected_people_raise_the_number_and_widen_the_interval() -> None:
    estimate = seen([(10.0, 70.0)] * 5, [1, 2, 3, 4, 5], [1.0] * 5)
    sure, doubtful = people_count(estimate, undetected=0.0), people_count(estimate, undetected=0.5)
    assert sure == (5.0, 5, 5)
    assert doubtful.expected == pytest.approx(7.5)
    assert doubtful.low >= 5
    assert doubtful.high > 7


def test_a_zone_holds_those_whose_feet_are_in_it() -> None:
    corners = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (60.0, 100.0), (60.0, 50.0), (0.0, 50.0)]
    zone = ZoneCount(corners, undetected=0.0)
    estimate = seen([(50.0, 25.0), (80.0, 90.0), (30.0, 80.0), (120.0, 50.0)], [1, 2, 3, 4], [1.0, 0.75, 1.0, 1.0])
    count = zone.count(estimate)
    assert count.expected == pytest.approx(1.75)
    assert (count.low, count.high) == (1, 2)


def test_a_line_counts_each_direction_once() -> None:
    line = LineCount((50.0, 0.0), (50.0, 100.0), missed=0.0)
    state = line.initial()
    paths = {1: (40.0, 2.0, 50.0), 2: (62.0, -3.0, 30.0), 3: (40.0, 2.0, 300.0), 4: (20.0, 1.0, 50.0)}
    for k in range(12):
        feet = [(x + v * k, y) for x, v, y in paths.values()]
        # The second person is hidden while crossing.
        shown = [i for i in range(4) if not (i == 1 and 3 <= k <= 6)]
        estimate = seen([feet[i] for i in shown], [i + 1 for i in shown], [[1.0, 0.8, 1.0, 1.0][i] for i in shown])
        state, crossings = line.step(state, estimate)
    assert crossings.backward.expected + crossings.forward.expected == pytest.approx(1.8)
    one, other = sorted([crossings.forward, crossings.backward])
    assert other == (1.0, 1, 1)
    assert one.expected == pytest.approx(0.8)
    assert (one.low, one.high) == (0, 1)
    # Down the image, a person who walks to the left of the picture goes from its left to its right side.
    assert crossings.forward.expected == pytest.approx(0.8)


@pytest.mark.parametrize("rate", [5.0, 30.0])
def test_a_line_remembers_hidden_people_for_a_time_at_every_frame_rate(rate: float) -> None:
    def crossings(memory: float, dt: float | None) -> float:
        line = LineCount((50.0, 0.0), (50.0, 100.0), missed=0.0, memory=memory, frame_rate=rate)
        state, _ = line.step(line.initial(), seen([(20.0, 50.0)], [1], [1.0]), dt)
        for _ in range(int(2.0 * rate)):
            state, _ = line.step(state, seen([], [], []), dt)
        _, found = line.step(state, seen([(80.0, 50.0)], [1], [1.0]), dt)
        return found.forward.expected + found.backward.expected

    for dt in (None, 1.0 / rate):
        assert crossings(2.5, dt) == 1.0 and crossings(1.5, dt) == 0.0
    with pytest.raises(ValueError, match="dt must be finite"):
        crossings(1.0, -1.0)


def test_people_that_a_camera_left_behind_are_not_in_the_frame() -> None:
    feet = [(50.0, 90.0), (95.0, 90.0), (160.0, 90.0)]
    estimate = seen(feet, [1, 2, 3], [0.9, 0.3, 0.3])
    assert len(estimate.held_existence) == 2
    assert people_count(estimate, undetected=0.0).expected == pytest.approx(1.5)
    assert people_count(estimate, undetected=0.0, frame_size=(100, 100)).expected == pytest.approx(1.2)


def test_who_walks_along_a_line_does_not_cross_it() -> None:
    feet = np.column_stack([np.linspace(0.0, 100.0, 60), 50.0 + 5.0 * np.cos(np.arange(60) * 2.0)])
    numbers = {}
    for margin in (0.0, 0.1):
        line = LineCount((0.0, 50.0), (100.0, 50.0), margin=margin, missed=0.0)
        state = line.initial()
        for place in feet:
            state, crossings = line.step(state, seen([tuple(place)], [1], [1.0]))
        numbers[margin] = crossings.forward.expected + crossings.backward.expected
    assert numbers[0.0] > 10.0 and numbers[0.1] == 0.0


def test_missed_crossings_widen_the_interval_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    seen_ones = add_chances(NOBODY, [0.95] * 20)
    count = add_missed(seen_ones, 0.5).interval()
    assert count.expected == pytest.approx(1.5 * 19.0)
    number = rng.binomial(20, 0.95, 4000)
    number = number + rng.poisson(rng.exponential(0.5 * 19.0, 4000))
    assert 0.885 < np.mean((count.low <= number) & (number <= count.high)) < 0.93
    assert add_missed(seen_ones, 0.0) is seen_ones and add_missed(NOBODY, 2.0) is NOBODY


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: ZoneCount([(0.0, 0.0), (1.0, 1.0)]), "corners"),
        (lambda: LineCount((1.0, 1.0), (1.0, 1.0)), "different"),
        (lambda: LineCount((1.0, np.nan), (1.0, 1.0)), "start and end"),
        (lambda: LineCount((1.0, 0.0), (1.0, 1.0), missed=-1.0), "missed"),
        (lambda: LineCount((1.0, 0.0), (1.0, 1.0), frame_rate=0.0), "frame_rate"),
        (lambda: LineCount((1.0, 0.0), (1.0, 1.0), margin=np.nan), "margin"),
        (lambda: ZoneCount([(0.0, 0.0), (1.0, 1.0), (0.0, 1.0)], undetected=-1.0), "undetected"),
        (lambda: add_chances(NOBODY, [1.2]), "chances"),
        (lambda: people_count(seen([], [], []), undetected=-1.0), "undetected"),
        (lambda: people_count(seen([], [], []), level=1.0), "level"),
        (lambda: ZoneCount([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)]), "corners must enclose an area"),
        (lambda: ZoneCount([(0.0, 0.0), (1e308, 1.0), (2.0, 0.0)]), "corners must be at most 1e"),
        (lambda: ZoneCount([("a", 0.0), (1.0, 1.0), (2.0, 0.0)]), "corners must be real numbers"),
        (lambda: LineCount((0.0, 0.0), (1e9, 1.0)), "start and end must be at most 1e"),
        (lambda: LineCount((0.0, 0.0), (1.0, 1.0), missed=1e9), "missed must be in 0 to 100"),
        (lambda: people_count(seen([(np.nan, 0.0)], [1], [0.9])), "estimate.states must be finite"),
        (lambda: people_count(replace(ONE, existence=np.array([np.nan]))), r"estimate.existence must be in \[0, 1\]"),
        (lambda: people_count(replace(ONE, states=np.zeros((1, 3)))), "estimate.states must be boxes"),
        (lambda: ZONE.count(seen([(np.inf, 0.0)], [1], [0.9])), "estimate.states must be finite"),
        (lambda: LINE.step(LINE.initial(), replace(ONE, existence=np.array([1.5]))), "estimate.existence"),
    ],
)
def test_errors_name_the_argument(make: object, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make()  # type: ignore[operator]
