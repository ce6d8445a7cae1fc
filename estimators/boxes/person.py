"""Probability that a track is a person, from its scores and its height."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit


class PersonOdds(NamedTuple):
    """Log odds that a track with a detection is a person: a logistic regression.

    The coefficients were fitted to detections of MOTChallenge sequences; docs/video.md has the protocol.

    Attributes:
        intercept: Log odds against a person whose scores have log odds 0. Raising it reports fewer people.
        mean: Weight of the mean log odds of the track's scores.
        high: Further weight of what exceeds `knee`: high scores say more.
        knee: Log odds above which `high` applies.
        last: Weight of the log odds of the last score.
        height: Lowers the log odds for each standard deviation from the height expected at this place.
    """

    intercept: float = 1.37
    mean: float = 0.475
    high: float = 0.66
    knee: float = 3.0
    last: float = 0.36
    height: float = 0.54


@njit(cache=True, nogil=True)
def person_probabilities(odds, evidence):  # type: ignore[no-untyped-def]
    """Probabilities of a person.

    Args:
        odds: A `PersonOdds`.
        evidence: Rows of `BoxTracks.evidence`. Shape (k, 3).

    Returns:
        Shape (k,).
    """
    out = np.empty(len(evidence))
    for j in range(len(evidence)):
        mean, last, height = evidence[j]
        log_odds = odds.mean * mean + odds.high * max(mean - odds.knee, 0.0) + odds.last * last
        out[j] = 1.0 / (1.0 + math.exp(odds.intercept + odds.height * height - log_odds))
    return out
