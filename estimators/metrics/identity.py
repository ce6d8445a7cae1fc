"""IDF1 (Ristani et al., 2016): share of the sequence that one fixed pairing of identities explains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.sequence import TrackSequence


class IdentityScores(NamedTuple):
    """Identity scores.

    Attributes:
        idf1: Harmonic mean of precision and recall.
        precision, recall: Share of estimated and of true objects that the best pairing of tracks explains.
    """

    idf1: float
    precision: float
    recall: float


def identity_scores(sequence: TrackSequence, threshold: float = 0.5) -> IdentityScores:
    """Score a sequence.

    Args:
        sequence: Result of `track_sequence`.
        threshold: Smallest similarity of a match, in (0, 1].
    """
    together = np.zeros((len(sequence.truth_counts), len(sequence.estimate_counts)))
    for truth, estimate, similarity in sequence.meetings():
        rows, columns = np.nonzero(similarity >= threshold)
        together[truth[rows], estimate[columns]] += 1.0
    # The pairing with the most matched steps has the fewest misses and false positives.
    explained = float(together[linear_sum_assignment(together, maximize=True)].sum())
    true, reported = float(sequence.truth_counts.sum()), float(sequence.estimate_counts.sum())
    return IdentityScores(
        2.0 * explained / max(true + reported, 1.0), explained / max(reported, 1.0), explained / max(true, 1.0)
    )
