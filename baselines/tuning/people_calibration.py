"""Calibration of the default tracker of people, leaving out one sequence at a time.

    python -m servotrack.baselines.tuning.people_calibration SEQUENCE...

Every box of a track with a detection is a person or not: the best assignment of a frame gives it to a true box with an
overlap of at least 0.5, or not. The log odds of `PersonOdds` are fitted by logistic regression, in which every sequence
has the same weight. For each sequence they are fitted on the others, and the expected calibration error (ten bins) of
the existence with these odds is printed, and that of all sequences together, each with the same weight. The number of
undetected people for each one with a track is the mean of the others too; printed is the share of frames in which the
90 % interval of the number of people holds the true one. So is the number of missed crossings for each seen one, of
three vertical lines across the whole frame and three horizontal ones in its lower half; printed is the share of these
lines and directions whose 90 % interval at the end holds the true number, without those that no person crosses or
seems to cross. The last lines are the values fitted on all.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize

from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.running.stopping import program
from servotrack.baselines.tuning.people_sequences import PeopleSequence, read_sequence
from servotrack.estimators.boxes import LineCount, PersonOdds, people_count, set_of_boxes
from servotrack.estimators.boxes.counting import NumberDistribution, add_missed
from servotrack.estimators.boxes.kalman import center_boxes
from servotrack.estimators.boxes.person import person_probabilities
from servotrack.estimators.metrics import box_distances, members_by_step
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Labels, Mask

OVERLAP = 0.5
"""Smallest overlap of a box and a true one."""
BINS = 10
RIDGE = 1e-3
"""Weight of the squared coefficients in the fit, in units of a sequence's log likelihood."""


class Judged(NamedTuple):
    """Boxes with a detection of all frames of a sequence, and the number of people in each frame.

    Attributes:
        evidence: `BoxTracks.evidence` of every box. Shape (k, 3).
        existence: Probability that the track is of something that persists. Shape (k,).
        person: True where the box is that of a person. Shape (k,).
        estimates: Estimate of every frame.
        number: True number of people in every frame. Shape (number of frames,).
        truth: The true people of every frame, as estimates.
        size: Width and height of the frame, or, where they are unknown, of the area of the true boxes, px.
    """

    evidence: Array
    existence: Array
    person: Mask
    estimates: list[SetEstimate]
    number: Array
    truth: list[SetEstimate]
    size: tuple[float, float]


def judge(sequence: PeopleSequence) -> Judged:
    """Run the default tracker over a sequence and compare its boxes with the truth."""
    tracker = create_tracker("pmb", sequence.frame_size, sequence.frame_rate)
    state: Any = tracker.initial(sequence.frames[0])
    truth = members_by_step(sequence.truth, len(sequence.frames), 4)
    parts: list[tuple[Array, Array, Mask]] = []
    estimates = []
    for frame, true in zip(sequence.frames, truth, strict=True):
        state, estimate = tracker.step(state, frame)
        tracks = state.tracks
        found = tracks.missed == 0
        person = _matched(true.states, center_boxes(tracks.mean[found]))
        parts.append((tracks.evidence[found], tracks.existence[found], person))
        estimates.append(estimate)
    number = np.array([len(true.rows) for true in truth])
    evidence, existence, matched = (np.concatenate(column) for column in zip(*parts, strict=True))
    people = [_certain(np.asarray(true.rows), np.asarray(true.states)) for true in truth]
    corners = np.concatenate([one.states[:, :2] + one.states[:, 2:] for one in people])
    size = sequence.frame_size or (float(corners[:, 0].max()), float(corners[:, 1].max()))
    return Judged(evidence, existence, matched, estimates, number, people, (float(size[0]), float(size[1])))


def fit_odds(judged: Sequence[Judged]) -> PersonOdds:
    """Fit the log odds; every sequence has the same weight."""
    features = np.concatenate([_features(one.evidence) for one in judged])
    person = np.concatenate([one.person for one in judged]).astype(np.float64)
    weight = np.concatenate([np.full(len(one.person), 1.0 / len(one.person)) for one in judged])

    def cost(theta: Array) -> tuple[float, Array]:
        log_odds = features @ theta
        gap = weight * (1.0 / (1.0 + np.exp(-log_odds)) - person)
        back = 2.0 * RIDGE * np.concatenate([[0.0], theta[1:]])
        loss = weight @ (np.logaddexp(0.0, log_odds) - person * log_odds) + RIDGE * theta[1:] @ theta[1:]
        return float(loss), features.T @ gap + back

    theta = minimize(cost, np.zeros(features.shape[1]), jac=True).x
    return PersonOdds(
        intercept=-float(theta[0]),
        mean=float(theta[1]),
        high=float(theta[2]),
        last=float(theta[3]),
        height=-float(theta[4]),
    )


def calibration_error(probability: Array, true: Array, weight: Array) -> float:
    """Expected calibration error: mean absolute difference of probability and frequency in bins of equal width.

    Args:
        probability: Stated probabilities. Shape (k,).
        true: 1 where the event happened, else 0. Shape (k,).
        weight: Weights. Shape (k,).
    """
    inside = np.minimum((probability * BINS).astype(np.int64), BINS - 1)
    gaps = np.bincount(inside, weight * (probability - true), BINS)
    return float(np.abs(gaps).sum() / weight.sum())


def undetected_share(judged: Sequence[Judged]) -> float:
    """Mean over sequences of the number of people without a track for each one with a track."""
    shares = []
    for one in judged:
        expected = sum(float(found.existence.sum() + found.held_existence.sum()) for found in one.estimates)
        shares.append(float(one.number.sum()) / max(expected, 1e-9) - 1.0)
    return max(float(np.mean(shares)), 0.0)


def coverage(judged: Judged, undetected: float) -> float:
    """Share of frames in which the 90 % interval holds the true number of people."""
    counts = [people_count(estimate, undetected) for estimate in judged.estimates]
    return float(
        np.mean([count.low <= number <= count.high for count, number in zip(counts, judged.number, strict=True)])
    )


class LineJudgment(NamedTuple):
    """Crossings of one line in one direction.

    Attributes:
        seen: Distribution of the number of crossings that the tracker saw.
        true: True number.
    """

    seen: NumberDistribution
    true: int


def judge_lines(judged: Judged) -> list[LineJudgment]:
    """Count the crossings of six lines in both directions, without those that no person crosses or seems to cross."""
    width, height = judged.size
    ends = [((width * k / 4.0, 0.0), (width * k / 4.0, height)) for k in (1, 2, 3)]
    ends += [((0.0, height * k / 8.0), (width, height * k / 8.0)) for k in (4, 5, 6)]
    found = []
    for start, end in ends:
        line = LineCount(start, end)
        seen, true = line.initial(), line.initial()
        for estimate, people in zip(judged.estimates, judged.truth, strict=True):
            seen, _ = line.step(seen, estimate)
            true, _ = line.step(true, people)
        found.append(LineJudgment(seen.forward, round(true.forward.expected)))
        found.append(LineJudgment(seen.backward, round(true.backward.expected)))
    return [one for one in found if one.true or one.seen.expected]


def missed_share(judgments: Sequence[Sequence[LineJudgment]]) -> float:
    """Mean over sequences of the number of missed crossings for each seen one."""
    shares = [sum(one.true for one in lines) / sum(one.seen.expected for one in lines) - 1.0 for lines in judgments]
    return max(float(np.mean(shares)), 0.0)


def line_coverage(lines: Sequence[LineJudgment], missed: float) -> float:
    """Share of lines and directions whose 90 % interval holds the true number of crossings."""
    counts = [add_missed(one.seen, missed).interval() for one in lines]
    return float(np.mean([count.low <= one.true <= count.high for count, one in zip(counts, lines, strict=True)]))


def _certain(labels: Labels, states: Array) -> SetEstimate:
    return set_of_boxes(states, np.zeros((len(states), 4, 4)), labels + 1, np.ones(len(states)))


def _matched(true: Array, boxes: Array) -> Mask:
    out = np.zeros(len(boxes), np.bool_)
    if len(true) and len(boxes):
        overlap = 1.0 - box_distances(true, boxes)
        eligible = np.where(overlap >= OVERLAP, overlap, 0.0)
        rows, columns = linear_sum_assignment(eligible, maximize=True)
        out[columns[eligible[rows, columns] > 0.0]] = True
    return out


def _features(evidence: Array) -> Array:
    high = np.maximum(evidence[:, 0] - PersonOdds().knee, 0.0)
    return np.column_stack([np.ones(len(evidence)), evidence[:, 0], high, evidence[:, 1:]])


def main() -> None:
    """The command line above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", help="folders, or NAME=DETECTIONS,TRUTH,RATE")
    arguments = parser.parse_args()
    with program("run the same command again"):
        sequences = [read_sequence(given) for given in arguments.sequences]
        if len(sequences) < 2:
            parser.error("at least two sequences are needed, one to leave out and one to fit")
        judged = [judge(sequence) for sequence in sequences]
        lines = [judge_lines(one) for one in judged]
        said, happened, weight, covered, crossed = [], [], [], [], []
        for k, (sequence, one) in enumerate(zip(sequences, judged, strict=True)):
            others = [*judged[:k], *judged[k + 1 :]]
            stated = one.existence * person_probabilities(fit_odds(others), one.evidence)
            equal = np.full(len(stated), 1.0 / len(stated))
            true = one.person.astype(np.float64)
            share = undetected_share(others)
            covered.append(coverage(one, share))
            print(
                f"{sequence.name} left out: calibration error {calibration_error(stated, true, equal):.3f}, "
                f"interval holds the number in {100.0 * covered[-1]:.1f} % of frames (undetected {share:.2f})",
                end=", ",
            )
            missed = missed_share([*lines[:k], *lines[k + 1 :]])
            crossed.append(line_coverage(lines[k], missed))
            print(f"and the crossings of {100.0 * crossed[-1]:.0f} % of {len(lines[k])} lines (missed {missed:.2f})")
            said.append(stated)
            happened.append(true)
            weight.append(equal)
        total = calibration_error(np.concatenate(said), np.concatenate(happened), np.concatenate(weight))
        print(f"all: calibration error {total:.3f}, interval {100.0 * np.mean(covered):.1f} %, ", end="")
        print(f"crossings {100.0 * np.mean(crossed):.1f} %")
        print(f"fitted on all: {fit_odds(judged)}")
        print(f"undetected: {undetected_share(judged):.3f}, missed: {missed_share(lines):.3f}")


if __name__ == "__main__":
    main()
