"""HOTA (Luiten et al., 2021): detection and association with equal weight, averaged over localization thresholds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.joined import Joined
from servotrack.estimators.metrics.sequence import EPSILON, TrackSequence
from servotrack.estimators.types import Array

THRESHOLDS = np.arange(0.05, 0.99, 0.05)
"""Localization thresholds of the definition: similarity 0.05 to 0.95."""


class HotaScores(NamedTuple):
    """HOTA at each of the 19 thresholds 0.05 to 0.95, shape (19,).

    Attributes:
        hota: Geometric mean of `deta` and `assa`.
        deta: Detection accuracy: matches over matches, misses and false positives.
        assa: Association accuracy: mean over matches of the same ratio for the pair's tracks.
    """

    hota: Array
    deta: Array
    assa: Array


def hota_scores(sequence: TrackSequence) -> HotaScores:
    """Score a sequence.

    Args:
        sequence: Result of `track_sequence`.
    """
    alignment = _alignment(sequence)
    # For every match: the pair of tracks and the number of thresholds passed. Most pairs never match.
    pairs, passed = Joined(np.int64), Joined(np.int64)
    for truth, estimate, similarity in sequence.meetings():
        rows, columns = linear_sum_assignment(alignment[np.ix_(truth, estimate)] * similarity, maximize=True)
        pairs.append(truth[rows] * alignment.shape[1] + estimate[columns])
        passed.append((similarity[rows, columns][:, None] >= THRESHOLDS - EPSILON).sum(axis=1))
    met, pair = np.unique(pairs.array(), return_inverse=True)
    steps = len(THRESHOLDS) + 1
    levels = np.bincount(pair * steps + passed.array(), minlength=len(met) * steps).reshape(len(met), steps)
    together = np.cumsum(levels[:, :0:-1], axis=1)[:, ::-1].T.astype(np.float64)
    true, reported = sequence.truth_counts, sequence.estimate_counts
    matches = together.sum(axis=1)
    deta = matches / np.maximum(true.sum() + reported.sum() - matches, 1.0)
    either = true[met // alignment.shape[1]] + reported[met % alignment.shape[1]] if len(met) else np.zeros(0)
    assa = (together * together / np.maximum(either - together, 1.0)).sum(axis=1) / np.maximum(matches, 1.0)
    return HotaScores(np.sqrt(deta * assa), deta, assa)


def _alignment(sequence: TrackSequence) -> Array:
    """Global similarity of two tracks over the whole sequence, which guides the matching of each step."""
    total = np.zeros((len(sequence.truth_counts), len(sequence.estimate_counts)))
    for truth, estimate, similarity in sequence.meetings():
        union = similarity.sum(axis=0)[None, :] + similarity.sum(axis=1)[:, None] - similarity
        total[np.ix_(truth, estimate)] += np.divide(
            similarity, union, out=np.zeros_like(similarity), where=union > EPSILON
        )
    counts = sequence.truth_counts[:, None] + sequence.estimate_counts[None, :] - total
    return np.divide(total, counts, out=np.zeros_like(total), where=counts > 0.0)
