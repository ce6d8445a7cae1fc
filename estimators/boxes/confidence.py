"""Scores of any detector as log odds of a person, on a scale that the detections themselves confirm or refute.

A score between 0 and 1 is read as a probability relative to the highest one so far, because detectors differ in the
confidence that their best detections reach. Any other scale is standardized, and scores that do not vary get a typical
value. Whether these readings mean anything shows in persistence: a detection of a person is followed by another one of
the same track in the next frame, a false one seldom is. Two models predict that outcome: log odds that rise with the
reading as they do for usual detectors of people, and one high rate for all detections. As long as the first predicts
better, readings are taken at face value; otherwise they say nothing and are replaced by the typical value.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


class ScoreRules(NamedTuple):
    """Reading of scores.

    Attributes:
        typical: Reading of scores that say nothing, and mean of standardized scores, log odds. Raising it reports more
            people where scores say nothing.
        spread: Standard deviation that standardized scores are given, log odds.
        usual: Log odds that a detection of reading 0 is followed by another one, for usual detectors; they rise by 1
            per unit.
        intercept_precision: Precision of the prior of the first model's intercept. 10 counts as about 50 outcomes.
        followed, detections: Detections followed by another one, and all, that the prior of the second model counts
            for.
        least_rate: Smallest rate of the second model: where fewer detections persist, their association fails or many
            are false.
        first_factor: Log Bayes factor of the second model before any outcome, negative for a detector of people; its
            sign is changed for regions of the foreground. Raising it distrusts scores sooner.
        largest_factor: Limit of its absolute value. Raising it lets the models change places more slowly.
        lowest: Smallest probability that a score is read as.
        highest: Probability that the highest score so far is read as. Raising it believes the best detections more.
        memory: Time for which the persistence of detections is remembered, s.
    """

    typical: float = 3.0
    spread: float = 2.0
    usual: float = -0.2
    intercept_precision: float = 10.0
    followed: float = 9.0
    detections: float = 10.0
    least_rate: float = 0.9
    first_factor: float = -10.0
    largest_factor: float = 20.0
    lowest: float = 1e-3
    highest: float = 0.9975
    memory: float = 60.0


def initial_confidence(rules: ScoreRules) -> Array:
    """State before the first detection.

    Args:
        rules: Reading of scores.

    Returns:
        Number, mean, sum of squares, lowest and highest of the scores; intercept of the first model and its precision;
        followed and all detections, discounted; log Bayes factor of the second model. Shape (10,).
    """
    start = [rules.usual, rules.intercept_precision, rules.followed, rules.detections, rules.first_factor]
    return np.array([0.0] * 5 + start)


@njit(cache=True, nogil=True)
def read_scores(state, scores, regions, rules):  # type: ignore[no-untyped-def]
    """Update the range of the scores and read those of a frame.

    Args:
        state: State as in `initial_confidence`.
        scores: Scores of the frame's detections, on any scale. Shape (Z,).
        regions: Share of these detections that are regions of the foreground. Those of the first frame with
            detections decide the first belief: the score of a region is the visible share of what it shows, and no
            probability of a person.
        rules: A `ScoreRules`.

    Returns:
        New state; readings x, shape (Z,).
    """
    out = state.copy()
    if state[0] == 0.0 and len(scores) > 0:
        out[9] *= 1.0 - 2.0 * regions
    for score in scores:
        out[0] += 1.0
        gap = score - out[1]
        out[1] += gap / out[0]
        out[2] += gap * (score - out[1])
        first = out[0] == 1.0
        out[3], out[4] = score if first else min(out[3], score), score if first else max(out[4], score)
    deviation = math.sqrt(out[2] / max(out[0], 1.0))
    varies = _varies(out)
    reading = np.full(len(scores), rules.typical)
    for j in range(len(scores) if varies else 0):
        if out[3] >= 0.0 and out[4] <= 1.0:
            share = max(rules.highest * scores[j] / out[4], rules.lowest)
            reading[j] = math.log(share / (1.0 - share))
        else:
            reading[j] += rules.spread * (scores[j] - out[1]) / deviation
    return out, reading


@njit(cache=True, nogil=True)
def trust(state):  # type: ignore[no-untyped-def]
    """Probability that the scores tell which detections persist; 0 where all scores are equal.

    Args:
        state: State as in `initial_confidence`.
    """
    return 1.0 / (1.0 + math.exp(state[9])) if _varies(state) else 0.0


@njit(cache=True, nogil=True)
def _varies(state):  # type: ignore[no-untyped-def]
    return state[4] - state[3] > 1e-9 * max(abs(state[3]), abs(state[4]))


@njit(cache=True, nogil=True)
def score_log_odds(state, reading, rules):  # type: ignore[no-untyped-def]
    """Log odds of readings: themselves, or a typical value if readings do not tell which detections persist.

    Args:
        state: State as in `initial_confidence`.
        reading: Readings x. Shape (k,).
        rules: A `ScoreRules`.

    Returns:
        Shape (k,).
    """
    share = 1.0 / (1.0 + math.exp(-state[9]))
    return (1.0 - share) * reading + share * rules.typical


@njit(cache=True, nogil=True)
def learn_persistence(state, reading, followed, counts, dt, rules):  # type: ignore[no-untyped-def]
    """Update the two models, in place, with the outcomes of the last frame's detections.

    Args:
        state: State as in `initial_confidence`; changed.
        reading: Reading x of each track's last detection. Shape (T,).
        followed: True where this frame has another detection of the track. Shape (T,).
        counts: True where the track had a detection in the last frame and nothing hides it now. Shape (T,).
        dt: Time since the last frame, s.
        rules: A `ScoreRules`.
    """
    keep = math.exp(-dt / rules.memory)
    state[6] = rules.intercept_precision + keep * (state[6] - rules.intercept_precision)
    state[7] = rules.followed + keep * (state[7] - rules.followed)
    state[8] = rules.detections + keep * (state[8] - rules.detections)
    rate = max(state[7] / state[8], rules.least_rate)
    gradient = (1.0 - keep) * rules.intercept_precision * (rules.usual - state[5])
    for i in range(len(reading)):
        if not counts[i]:
            continue
        p = 1.0 / (1.0 + math.exp(-(state[5] + reading[i])))
        if followed[i]:
            gradient += 1.0 - p
            state[9] += math.log(rate / max(p, 1e-3))
            state[7] += 1.0
        else:
            gradient -= p
            state[9] += math.log((1.0 - rate) / max(1.0 - p, 1e-3))
        state[8] += 1.0
        state[6] += p * (1.0 - p)
    state[5] += gradient / state[6]
    state[9] = min(max(state[9], -rules.largest_factor), rules.largest_factor)
