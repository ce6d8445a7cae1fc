"""CLEAR MOT, IDF1 and HOTA: by hand, on edges, with ignored truth, and against the reference implementation."""

from __future__ import annotations

import contextlib
import io

import numpy as np
import pytest

from servotrack.estimators.metrics import Track, box_distances, mot_scores, point_distances, stack_tracks

NOTHING = Track(np.zeros(0, np.int64), np.zeros((0, 4)))


def walk(start, steps, size=(10.0, 20.0), velocity=(1.0, 0.0)):
    steps = np.asarray(steps)
    boxes = np.zeros((len(steps), 4))
    boxes[:, :2] = np.asarray(start, dtype=float) + steps[:, None] * np.asarray(velocity)
    boxes[:, 2:] = size
    return Track(steps, boxes)


def random_tracks(rng, count, length, noise=None, of=None):
    """Tracks with gaps; of other tracks with noise, if they are given, now and then taking over another's place."""
    tracks = []
    for _ in range(count):
        alive = rng.random(length) < rng.uniform(0.3, 1.0)
        if of is None:
            boxes = np.cumsum(rng.normal(0.0, 1.5, (length, 4)), axis=0) + rng.uniform(0.0, 40.0, 4)
            boxes[:, 2:] = 12.0 + rng.uniform(0.0, 10.0, 2)
        else:
            source = np.repeat(rng.integers(0, len(of), length // 5 + 1), 5)[:length]
            boxes = np.stack([of[source[t]][t] for t in range(length)]) + rng.normal(0.0, noise, (length, 4))
        tracks.append(Track(np.flatnonzero(alive), np.abs(boxes[alive]) + np.array([0.0, 0.0, 1.0, 1.0])))
    return tracks


def reference(truth, estimate, distances, cutoff, threshold):
    """Through trackeval, as its own data sets are fed to it."""
    with contextlib.redirect_stdout(io.StringIO()):
        metrics = pytest.importorskip("trackeval.metrics")
        config = {"THRESHOLD": threshold, "PRINT_CONFIG": False}
        length = max(int(track.steps.max()) + 1 for track in [*truth, *estimate] if len(track.steps))
        there, here = stack_tracks(truth, length, 4), stack_tracks(estimate, length, 4)
        exists, reported = ~np.isnan(there).any(axis=2), ~np.isnan(here).any(axis=2)
        rows = [(np.flatnonzero(exists[:, t]), np.flatnonzero(reported[:, t])) for t in range(length)]
        similarities = [
            np.clip(1.0 - distances(there[a, t], here[b, t]) / cutoff, 0.0, 1.0) for t, (a, b) in enumerate(rows)
        ]
        data = {
            "num_timesteps": length,
            "num_gt_ids": len(truth),
            "num_tracker_ids": len(estimate),
            "num_gt_dets": int(exists.sum()),
            "num_tracker_dets": int(reported.sum()),
            "gt_ids": [a for a, _ in rows],
            "tracker_ids": [b for _, b in rows],
            "similarity_scores": similarities,
        }
        c = metrics.CLEAR(config).eval_sequence(data)
        i = metrics.Identity(config).eval_sequence(data)
        h = metrics.HOTA().eval_sequence(data)
    return {
        "hota": np.mean(h["HOTA"]),
        "deta": np.mean(h["DetA"]),
        "assa": np.mean(h["AssA"]),
        "idf1": i["IDF1"],
        "mota": c["MOTA"],
        "motp": c["MOTP"],
        "identity_switches": c["IDSW"],
        "false_positives": c["CLR_FP"],
        "misses": c["CLR_FN"],
        "fragments": c["Frag"],
    }


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("distances", "cutoff"), [(box_distances, 1.0), (point_distances, 25.0)])
def test_equal_to_the_reference_implementation(seed, distances, cutoff):
    rng = np.random.default_rng(seed)
    length = int(rng.integers(5, 40))
    truth = random_tracks(rng, int(rng.integers(1, 7)), length)
    places = np.nan_to_num(stack_tracks(truth, length, 4), nan=5.0)
    estimate = random_tracks(rng, int(rng.integers(1, 9)), length, rng.uniform(0.2, 3.0), places)
    for threshold in (0.5, 0.3):
        ours = mot_scores(truth, estimate, distances, cutoff, threshold)._asdict()
        assert ours == pytest.approx(reference(truth, estimate, distances, cutoff, threshold), abs=1e-9)


def test_the_random_sequences_hold_what_they_compare():
    rng = np.random.default_rng(3)
    truth = random_tracks(rng, 6, 40)
    estimate = random_tracks(rng, 8, 40, 1.0, np.nan_to_num(stack_tracks(truth, 40, 4), nan=5.0))
    scores = mot_scores(truth, estimate)
    assert min(scores.identity_switches, scores.false_positives, scores.misses, scores.fragments) > 5
    assert 0.1 < scores.hota < 0.9


@pytest.mark.parametrize(("truth", "estimate"), [([walk((0, 0), range(5))], []), ([], [walk((0, 0), range(5))])])
def test_nothing_on_one_side(truth, estimate):
    ours = mot_scores(truth, estimate)._asdict()
    assert ours == pytest.approx(reference(truth, estimate, box_distances, 1.0, 0.5), abs=1e-9)
    assert ours["misses"] + ours["false_positives"] == 5


def test_nothing_at_all():
    assert set(mot_scores([], [])) == {0.0}
    assert set(mot_scores([NOTHING], [NOTHING])) == {0.0}


def test_counts_of_a_sequence_done_by_hand():
    truth = [walk((0, 0), range(10)), walk((0, 100), range(10))]
    # The first is lost at 3 and 4 and found again under another name; the second is not found; one is nobody.
    estimate = [walk((0, 0), range(3)), walk((0, 0), range(5, 10)), walk((0, 300), [3, 4])]
    scores = mot_scores(truth, estimate)
    assert (scores.identity_switches, scores.misses, scores.false_positives, scores.fragments) == (1, 12, 2, 1)
    assert scores.mota == pytest.approx(1.0 - 15 / 20)
    assert scores.motp == pytest.approx(1.0)
    # The longer piece explains 5 of 20 true and of 10 reported objects.
    assert scores.idf1 == pytest.approx(2 * 5 / 30)
    assert scores.deta == pytest.approx(8 / 22)
    assert scores.assa == pytest.approx((3 * 3 / 10 + 5 * 5 / 10) / 8)


def test_matching_holds_on_to_the_pair_of_the_step_before():
    truth = [walk((0, 0), range(6), velocity=(0, 0))]
    near = Track(np.arange(6), walk((2, 0), range(6), velocity=(0, 0)).states)
    late = walk((0, 0), range(3, 6), velocity=(0, 0))
    assert mot_scores(truth, [near, late]).identity_switches == 0


def test_ignored_truth_takes_its_answers_away():
    counted, hidden = walk((0, 0), range(10)), walk((0, 100), range(10))
    both = [walk((0, 0), range(10)), walk((1, 100), range(10))]
    assert mot_scores([counted], both).false_positives == 10
    scores = mot_scores([counted], both, ignored=[hidden])
    assert (scores.false_positives, scores.mota, scores.hota, scores.idf1) == (0, 1.0, 1.0, 1.0)
    # Nobody has to find who is ignored.
    assert mot_scores([counted], both[:1], ignored=[hidden]) == scores


def test_ignored_truth_never_takes_an_answer_from_truth_that_counts():
    counted, hidden = walk((0, 0), range(10)), walk((1, 0), range(10))
    # Nearer to the hidden one, but the only answer that fits the counted one.
    scores = mot_scores([counted], [walk((1, 0), range(10))], ignored=[hidden])
    assert (scores.misses, scores.false_positives) == (0, 0)
    # Of two answers one goes with each.
    scores = mot_scores([counted], [walk((1, 0), range(10)), walk((2, 0), range(10))], ignored=[hidden])
    assert (scores.misses, scores.false_positives) == (0, 0)


def test_an_answer_far_from_ignored_truth_stays_wrong():
    scores = mot_scores([walk((0, 0), range(4))], [walk((0, 200), range(4))], ignored=[walk((0, 100), range(4))])
    assert (scores.misses, scores.false_positives) == (4, 4)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [({"cutoff": 0.0}, "cutoff must be positive, got 0.0"), ({"threshold": 0.0}, "threshold must be above 0")],
)
def test_bad_input_is_named(arguments, match):
    with pytest.raises(ValueError, match=match):
        mot_scores([], [], **arguments)
