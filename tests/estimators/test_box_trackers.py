"""Trackers of boxes: what all of them keep, and what each is for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from box_scenes import HEIGHT, WIDTH, blob, follow, identity_at, people, person

from servotrack.estimators.boxes import (
    BoxPMB,
    BoxSetFilter,
    DetectThenTrack,
    KalmanHungarian,
    KeptIdentities,
    RawDetections,
    SplitRules,
    box_model,
    centroid_model,
    fill_gaps,
    split_merged,
)
from servotrack.estimators.boxes.report import LARGEST_HELD
from servotrack.estimators.detect import Detections, detections_from_boxes
from servotrack.estimators.metrics import Track
from servotrack.estimators.rfs import GMPHD, PMB, GMCBMeMBer, MeasurementBirth, Reduction, Spawn
from servotrack.estimators.rfs.sets import HELD

NOBODY = detections_from_boxes(np.zeros((0, 4)))


def set_filter(filter_class: Any = GMPHD, kind: str = "centroid", **fields: Any) -> BoxSetFilter:
    model = centroid_model(1.0, 2.0) if kind == "centroid" else box_model(1.0, 2.0, 0.5, 4.0)
    made = filter_class(
        model,
        MeasurementBirth(expected=0.05, hidden_deviation=3.0, largest=0.05, places=10),
        clutter_intensity=1e-7 if kind == "centroid" else 1e-10,
        detection=0.9,
        reduction=Reduction(components=20, tracks=20),
        **fields,
    )
    return BoxSetFilter(made, kind)  # type: ignore[arg-type]


TRACKERS = {
    "pmb": BoxPMB(frame_size=(300, 200)),
    "hungarian": KalmanHungarian(),
    "raw": RawDetections(),
    "phd": set_filter(),
    "phd on boxes": set_filter(kind="box"),
    "cbmember": set_filter(GMCBMeMBer),
    "pmb on boxes": set_filter(PMB, "box"),
    "kept phd": KeptIdentities(set_filter()),
}


@pytest.mark.parametrize("name", TRACKERS)
def test_two_walkers_are_found_where_they_are(name: str) -> None:
    frames = [people([50.0 + 2.0 * k, 200.0 - k]) for k in range(20)]
    last = follow(TRACKERS[name], frames)[-1]
    boxes = np.array(sorted(box.tolist() for box in last.values()))
    assert np.abs(boxes - [person(88.0), person(181.0)]).max() < 4.0


@pytest.mark.parametrize("name", [name for name in TRACKERS if name != "raw"])
def test_a_walker_keeps_one_identity_and_is_forgotten_at_last(name: str) -> None:
    frames = [people([50.0 + 2.0 * k]) for k in range(30)] + [NOBODY] * 200
    answers = follow(TRACKERS[name], frames)
    assert len({label for answer in answers[:30] for label in answer}) == 1
    assert identity_at(answers[29], 108.0) > 0
    assert not answers[-1]


@pytest.mark.parametrize("name", TRACKERS)
def test_states_are_values(name: str) -> None:
    tracker = TRACKERS[name]
    state = tracker.initial(NOBODY)
    for k in range(6):
        state, _ = tracker.step(state, people([50.0 + k, 120.0]))
    _, first = tracker.step(state, people([57.0, 120.0]))
    tracker.step(state, people([30.0]))
    _, again = tracker.step(state, people([57.0, 120.0]))
    assert np.array_equal(first.states, again.states)
    assert np.array_equal(first.labels, again.labels)


@pytest.mark.parametrize("name", TRACKERS)
def test_bad_numbers_are_refused(name: str) -> None:
    tracker = TRACKERS[name]
    bad = people([50.0])._replace(boxes=np.array([[0.0, np.nan, 10.0, 20.0]]))
    with pytest.raises(ValueError, match="finite"):
        tracker.step(tracker.initial(NOBODY), bad)
    upside_down = people([50.0])._replace(boxes=np.array([[0.0, 0.0, -10.0, 20.0]]))
    with pytest.raises(ValueError, match="at least 0"):
        tracker.step(tracker.initial(NOBODY), upside_down)


def test_covariances_are_those_of_boxes() -> None:
    for name in ("pmb", "hungarian", "phd on boxes"):
        tracker = TRACKERS[name]
        state = tracker.initial(NOBODY)
        for k in range(10):
            state, estimate = tracker.step(state, people([50.0 + k]))
        P = estimate.covariances[0]
        assert np.allclose(P, P.T, rtol=0.0, atol=1e-12)
        assert np.linalg.eigvalsh(P).min() > 0.0
        # Right edges are as well known as left ones.
        assert P[0, 0] == pytest.approx(P[0, 0] + 2.0 * P[0, 2] + P[2, 2], rel=1e-6)


def test_pmb_holds_a_person_hidden_by_a_nearer_one() -> None:
    nearer = person(100.0, 105.0)
    before = [detections_from_boxes([person(100.0 - 2.0 * (15 - k), 95.0), nearer]) for k in range(15)]
    hidden = [detections_from_boxes([nearer])] * 12
    tracker, state = BoxPMB(), BoxPMB().initial(NOBODY)
    for frame in before + hidden:
        state, estimate = tracker.step(state, frame)
    # Only people with a detection are reported; the other one is held with a smaller existence.
    assert len(estimate.labels) == len(estimate.held_labels) == 1
    assert HELD <= estimate.held_existence[0] <= LARGEST_HELD
    followed = follow(BoxPMB(), [*before, *hidden, before[-1]])
    assert followed[-1].keys() == followed[14].keys()
    assert len(follow(BoxPMB(coast=1.0), before + hidden)[-1]) == 2


def test_pmb_knows_a_lost_person_again() -> None:
    frames = [people([50.0 + 2.0 * k]) for k in range(20)] + [NOBODY] * 20
    frames += [people([50.0 + 2.0 * k]) for k in range(40, 45)]
    answers = follow(BoxPMB(), frames)
    assert not answers[38]
    assert identity_at(answers[-1], 138.0) == identity_at(answers[19], 88.0) > 0


def test_pmb_starts_nobody_on_a_doubtful_detection() -> None:
    def frames(score: float) -> list[Detections]:
        sure = detections_from_boxes([person(50.0), person(100.0), person(150.0)], [0.98, 0.95, 0.99])
        four = [person(50.0), person(100.0), person(150.0), person(220.0)]
        return [sure] * 10 + [detections_from_boxes(four, [0.98, 0.95, 0.99, score])] * 3

    assert len(follow(BoxPMB(), frames(0.55))[-1]) == 3
    assert len(follow(BoxPMB(), frames(0.98))[-1]) == 4


@pytest.mark.parametrize("constant", [0.0, 0.3, 1.0, 100.0, -4.0])
def test_constant_scores_say_nothing(constant: float) -> None:
    boxes = [[person(50.0 + 2.0 * k), person(200.0 - k)] for k in range(20)]
    without = follow(BoxPMB(), [detections_from_boxes(both) for both in boxes])
    same = follow(BoxPMB(), [detections_from_boxes(both, [constant, constant]) for both in boxes])
    for a, b in zip(without, same, strict=True):
        assert a.keys() == b.keys()
        assert all(np.array_equal(a[label], b[label]) for label in a)


def test_scores_on_any_scale_tell_people_from_clutter() -> None:
    def found(scale: Any, seed: int) -> float:
        """Share of false boxes among those reported in the second half."""
        rng = np.random.default_rng(seed)
        tracker, state, false, all_ = BoxPMB(), BoxPMB().initial(NOBODY), 0, 0
        for k in range(100):
            clutter = [person(float(x), float(y)) for x, y in rng.uniform([20.0, 220.0], [800.0, 500.0], (4, 2))]
            odds = np.concatenate([rng.normal(4.0, 1.0, 2), rng.normal(0.0, 1.0, 4)])
            scores = scale(odds)
            frame = detections_from_boxes([person(50.0 + 2.0 * k), person(400.0 - 2.0 * k), *clutter], scores)
            state, estimate = tracker.step(state, frame)
            if k >= 50:
                all_ += len(estimate.labels)
                false += int((estimate.states[:, 1] > 150.0).sum())
        assert all_ - false >= 90
        return false / all_

    for scale in (
        lambda x: 1.0 / (1.0 + np.exp(-x)),
        lambda x: 100.0 / (1.0 + np.exp(-x)),
        lambda x: x,
        lambda x: 9.0 * x,
    ):
        seeds = range(3)
        assert sum(found(scale, seed) for seed in seeds) < 0.85 * sum(found(np.zeros_like, seed) for seed in seeds)


def test_a_timid_detector_is_read_as_a_bold_one() -> None:
    rng = np.random.default_rng(3)
    scenes = [
        ([person(50.0 + 2.0 * k), person(400.0 - 2.0 * k), person(*rng.uniform([20.0, 220.0], [800.0, 500.0]))],
         np.array([0.97, 0.93, rng.uniform(0.3, 0.8)]))
        for k in range(40)
    ]  # fmt: skip
    bold, timid = (
        follow(BoxPMB(), [detections_from_boxes(boxes, factor * scores) for boxes, scores in scenes])
        for factor in (1.0, 0.25)
    )
    assert len(bold[-1]) >= 2
    for a, b in zip(bold, timid, strict=True):
        assert a.keys() == b.keys()
        assert all(np.allclose(a[label], b[label]) for label in a)


def cut_regions(share: float) -> list[Detections]:
    """Regions of a moving foreground: for half a second only a part of the second person is found."""
    frames = []
    for k in range(80):
        x, y, width, height = person(300.0 - k)
        cut = [x, y, width, (share if 50 <= k < 62 else 1.0) * height]
        frames.append(detections_from_boxes([person(50.0 + 2.0 * k), cut]))
    return frames


def test_people_whose_regions_are_cut_are_followed_and_reported() -> None:
    answers = follow(BoxPMB(), cut_regions(0.7))
    assert [len(answer) for answer in answers[10:]] == [2] * 70
    assert identity_at(answers[-1], 221.0) == identity_at(answers[40], 260.0) > 0
    assert min(len(answer) for answer in follow(BoxPMB(cut_share=0.0), cut_regions(0.7))[50:]) == 1


def test_heights_say_nothing_where_scores_do_not() -> None:
    x, y, width, height = person(500.0)
    small = [x, y + 0.6 * height, 0.4 * width, 0.4 * height]
    frames = [detections_from_boxes([person(50.0 + 2.0 * k), person(300.0 - k), small]) for k in range(60)]

    def existence(tracker: BoxPMB) -> Any:
        state = tracker.initial(frames[0])
        for frame in frames:
            state, estimate = tracker.step(state, frame)
        return np.sort(estimate.existence)

    without = existence(BoxPMB(person=BoxPMB().person._replace(height=0.0)))
    assert len(without) == 3 and np.allclose(existence(BoxPMB()), without)


def test_scores_that_do_not_tell_which_detections_persist_are_not_believed() -> None:
    rng = np.random.default_rng(1)
    frames = [
        detections_from_boxes([person(50.0 + 2.0 * k), person(300.0 - k)], rng.uniform(0.2, 0.6, 2)) for k in range(60)
    ]
    reported = [len(answer) for answer in follow(BoxPMB(), frames)]
    assert sum(reported[:5]) < 10
    assert sum(reported[40:]) == 40


def test_pmb_learns_the_heights_of_people_by_place() -> None:
    def walker(x: float, row: float) -> list[float]:
        height = 20.0 + 0.2 * row
        return [x - 0.2 * height, row - height, 0.4 * height, height]

    near = [[walker(30.0 + 2.0 * k, 200.0), walker(300.0 - 2.0 * k, 400.0)] for k in range(80)]
    scores = [0.93, 0.93]
    frames = [detections_from_boxes(both, scores) for both in near]
    right, wrong = walker(250.0, 300.0), [230.0, 120.0, 60.0, 180.0]
    last = [person_and_odd([*near[-1], box]) for box in (right, wrong)]
    assert len(follow(BoxPMB(), [*frames, last[0]])[-1]) == 3
    assert len(follow(BoxPMB(), [*frames, last[1]])[-1]) == 2


def person_and_odd(boxes: list[list[float]]) -> Detections:
    return detections_from_boxes(boxes, [0.93, 0.93, 0.9])


def test_pmb_learns_the_noise_of_a_sequence() -> None:
    def scales(jitter: float, turn: float) -> Any:
        rng = np.random.default_rng(2)
        tracker, state = BoxPMB(), BoxPMB().initial(NOBODY)
        for k in range(200):
            x = 150.0 + (60.0 * np.sin(turn * k) if turn else 0.0) + jitter * rng.normal()
            state, _ = tracker.step(state, people([float(x)]))
        return state.noise

    calm, restless, turning = scales(0.3, 0.0), scales(6.0, 0.0), scales(0.3, 0.3)
    assert calm.measurement[0] < restless.measurement[0] - 0.6
    assert turning.process[0] > calm.process[0] + 1.0
    fixed = BoxPMB(learning=None)
    state = fixed.initial(NOBODY)
    for k in range(20):
        state, _ = fixed.step(state, people([50.0 + 3.0 * k]))
    assert not state.noise.measurement.any()


@pytest.mark.parametrize("tracker", [BoxPMB(), KalmanHungarian(), KeptIdentities(KalmanHungarian())])
def test_time_that_passed_is_used(tracker: Any) -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.choice([1, 2, 3], 40)) / 25.0
    state, seen = tracker.initial(NOBODY), set()
    for k, time in enumerate(times):
        # 150 px/s: with the nominal 6 px per frame, a gap of three frames would be a jump of the box's width.
        dt = time if k == 0 else time - times[k - 1]
        state, estimate = tracker.step(state, people([20.0 + 150.0 * time, 700.0 - 150.0 * time]), dt)
        seen |= set(estimate.labels.tolist())
    assert len(seen) == 2
    with pytest.raises(ValueError, match="dt"):
        tracker.step(state, NOBODY, 0.0)


def test_pmb_is_the_same_at_any_zoom_and_frame_rate() -> None:
    frames = [people([50.0 + 2.0 * k, 200.0 - k]) for k in range(20)]
    large = [detections_from_boxes(4.0 * frame.boxes) for frame in frames]
    one, two = follow(BoxPMB(), frames), follow(BoxPMB(), large)
    for a, b in zip(one, two, strict=True):
        assert a.keys() == b.keys()
        for label in a:
            assert np.allclose(4.0 * a[label], b[label])


def test_hungarian_confirms_and_ends() -> None:
    tracker = KalmanHungarian(confirm=3, misses=4, shown_misses=1)
    answers = follow(tracker, [people([50.0])] * 6 + [NOBODY] * 3 + [people([50.0])] + [NOBODY] * 6 + [people([50.0])])
    assert [len(answer) for answer in answers] == [0, 0, 1, 1, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0]
    assert answers[2].keys() == answers[9].keys()


def test_hungarian_takes_the_assignment_that_is_best_in_sum() -> None:
    # Nearest neighbors first would give the left person the right one's detection.
    tracker = KalmanHungarian(confirm=1, acceleration=0.01, speed=0.01)
    answers = follow(tracker, [people([50.0, 62.0])] * 4 + [people([57.0, 69.0])])
    assert identity_at(answers[4], 50.0) == identity_at(answers[3], 50.0)
    assert len(answers[4].keys() | answers[3].keys()) == 2


def test_hungarian_tells_people_apart_by_appearance() -> None:
    """Two people change places between two frames, which overlap alone cannot tell."""
    looks = np.eye(2)
    frames = [people([50.0, 62.0])._replace(features=looks)] * 6
    frames += [people([50.0, 62.0])._replace(features=looks[::-1])] * 9
    for appearance, changed in ((0.0, False), (2.0, True)):
        answers = follow(KalmanHungarian(appearance=appearance, confirm=1), frames)
        assert (identity_at(answers[-1], 62.0) == identity_at(answers[5], 50.0)) == changed
    # Without an appearance the match is that of overlap.
    unknown = [frame._replace(features=np.zeros((2, 2))) for frame in frames]
    plain = [people([50.0, 62.0])] * len(frames)
    blind, seen = follow(KalmanHungarian(appearance=2.0), unknown), follow(KalmanHungarian(), plain)
    assert all(np.array_equal(a[label], b[label]) for a, b in zip(blind, seen, strict=True) for label in a)


def test_a_split_is_found_by_spawning() -> None:
    spawn = Spawn(0.02, np.diag([WIDTH**2, 4.0, WIDTH**2, 4.0]))
    together = [people([100.0])] * 8
    # A detector that tells two people apart all at once: the second is far outside the first one's gate.
    apart = [people([100.0, 122.0])] * 7

    def found(terms: tuple[Spawn, ...]) -> int:
        def tracker(births: float) -> BoxSetFilter:
            return BoxSetFilter(
                GMPHD(
                    centroid_model(1.0, 2.0),
                    MeasurementBirth(expected=births, largest=births, hidden_deviation=3.0),
                    clutter_intensity=1e-7,
                    detection=0.99,
                    spawn=terms,
                    reduction=Reduction(prune=0.2, merge=5.0),
                )
            )

        before, after = tracker(0.05), tracker(1e-12)
        state = before.initial(NOBODY)
        for frame in together:
            state, estimate = before.step(state, frame)
        assert len(estimate.labels) == 1
        state = state._replace(belief=state.belief._replace(births=after.initial(NOBODY).belief.births))
        for frame in apart:
            state, estimate = after.step(state, frame)
        return len(estimate.labels)

    assert found((spawn,)) == 2
    assert found(()) == 1


def meeting(by_appearance: bool) -> list[Detections]:
    """Two walk up to each other, are one blob for a while, and each goes back where it came from."""
    size = 2 if by_appearance else 0

    def two(gap: float) -> Detections:
        return people([100.0 - gap, 100.0 + gap], [0, 1] if by_appearance else None)

    approach = [two(60.0 - 2.5 * k) for k in range(20)]
    merged = [blob(100.0 - WIDTH / 2 - 4.0, 100.0 + WIDTH / 2 + 4.0, size)] * 10
    part = [two(12.0 + 2.5 * k) for k in range(20)]
    return approach + merged + part


def test_identities_are_kept_through_a_merge_by_appearance_and_lost_without() -> None:
    def kept(by_appearance: bool) -> bool:
        tracker = KeptIdentities(KalmanHungarian(misses=20), split=False)
        answers = follow(tracker, meeting(by_appearance))
        before = [identity_at(answers[18], 100.0 - 15.0), identity_at(answers[18], 100.0 + 15.0)]
        after = [identity_at(answers[-1], 100.0 - 59.5), identity_at(answers[-1], 100.0 + 59.5)]
        assert min(before + after) > 0
        return before == after

    assert kept(True)
    assert not kept(False)


def test_a_lost_identity_returns_where_it_is_expected_and_to_nobody_else() -> None:
    tracker = KeptIdentities(KalmanHungarian(misses=2), memory=30)

    def after(x: float, appearance: int) -> tuple[int, int]:
        frames = [people([50.0 + 2.0 * k], [0]) for k in range(15)] + [people([], [])] * 8
        frames += [people([x + 2.0 * k], [appearance]) for k in range(6)]
        answers = follow(tracker, frames)
        return identity_at(answers[14], 78.0), identity_at(answers[-1], x + 10.0)

    old, new = after(96.0, 0)
    assert old == new > 0
    for x, appearance in ((96.0, 1), (200.0, 0)):
        old, new = after(x, appearance)
        assert new > 0
        assert old != new


def test_merged_blobs_are_taken_apart_at_the_people_expected() -> None:
    expected = np.array([person(90.0), person(110.0), person(200.0)])
    parts = split_merged(blob(82.0, 122.0), expected)
    assert len(parts.boxes) == 2
    assert parts.boxes[:, 0].min() == pytest.approx(82.0)
    assert (parts.boxes[:, 0] + parts.boxes[:, 2]).max() == pytest.approx(122.0)
    assert parts.areas.sum() == pytest.approx(0.75 * 40.0 * HEIGHT)
    assert not parts.features.any()
    # Boxes of a detector of people, and blobs around one person, are left alone.
    for same in (people([100.0]), blob(88.0, 112.0), blob(190.0, 212.0)):
        assert split_merged(same, expected[2:]) is same
    whole = detections_from_boxes([[82.0, 70.0, 40.0, HEIGHT]])
    assert split_merged(whole, expected) is whole
    merged = blob(82.0, 122.0)
    assert split_merged(merged, expected, SplitRules(larger=2.5)) is merged


def test_a_frame_goes_through_detector_and_tracker() -> None:
    class Bright:
        def initial(self, frame: Any) -> int:
            return 0

        def step(self, state: int, frame: Any) -> tuple[int, Detections]:
            rows, columns = np.nonzero(frame[..., 0])
            box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            return state + 1, detections_from_boxes([box])

    pipeline = DetectThenTrack(Bright(), KalmanHungarian(confirm=1))
    frame = np.zeros((200, 300, 3), np.uint8)
    frame[70:130, 90:110] = 255
    state = pipeline.initial(frame)
    for _ in range(3):
        state, estimate = pipeline.step(state, frame)
    assert state.detector == 3
    assert np.allclose(estimate.states, [[90.0, 70.0, 20.0, 60.0]])


def test_gaps_are_filled_by_straight_lines() -> None:
    gap = Track(np.array([2, 3, 6, 12]), np.array([[0.0], [1.0], [4.0], [10.0]]))
    short = Track(np.array([5]), np.array([[1.0]]))
    (filled,) = fill_gaps([gap, short], longest=2, shortest=2)
    assert filled.steps.tolist() == [2, 3, 4, 5, 6, 12]
    assert filled.states.ravel().tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 10.0]
    assert gap.steps.tolist() == [2, 3, 6, 12]
    assert fill_gaps([gap, short], longest=0)[0].steps.tolist() == [2, 3, 6, 12]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: BoxPMB(frame_rate=0.0), "frame_rate"),
        (lambda: BoxPMB(detection=1.0), "detection"),
        (lambda: BoxPMB(revival=1.0), "revival"),
        (lambda: BoxPMB(overlap=-1.0), "overlap"),
        (lambda: BoxPMB(gate_tail=0.0), "gate_tail"),
        (lambda: BoxPMB(least_existence=0.0), "least_existence"),
        (lambda: BoxPMB(appearance_limits=(1.0, -1.0)), "appearance_limits"),
        (lambda: KalmanHungarian(overlap=0.0), "overlap"),
        (lambda: KalmanHungarian(speed=np.nan), "speed"),
        (lambda: KalmanHungarian(confirm=0), "confirm"),
        (lambda: KeptIdentities(RawDetections(), memory=0), "memory"),
        (lambda: KeptIdentities(RawDetections(), velocity_rate=0.0), "velocity_rate"),
        (lambda: centroid_model(0.0, 1.0), "process_noise"),
        (lambda: box_model(1.0, 1.0, 1.0, -1.0), "size_noise"),
        (lambda: fill_gaps([], longest=-1), "longest"),
        (lambda: BoxSetFilter(set_filter().filter, "box"), "4 numbers"),
        (lambda: BoxSetFilter(set_filter().filter, size_rate=0.0), "size_rate"),
    ],
)
def test_errors_name_the_argument(make: Any, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make()
