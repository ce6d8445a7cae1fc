"""IDF1 (Ristani et al., 2016): how much of the sequence one lasting pairing of identities explains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.sequence import TrackSequence


class IdentityScores(NamedTuple):
    """Identity metrics.

    Attributes:
        idf1: Harmonic mean of the next two.
        precision, recall: Share of estimated and of true objects that the best pairing of tracks explains.
    """

    idf1: float
    precision: float
    recall: float


def identity_scores(sequence: TrackSequence, threshold: float = 0.5) -> IdentityScores:
    """Score a sequence.

    Args:
        sequence: From `track_sequence`.
        threshold: Similarity from which two count as together.
    """
    together = np.zeros((len(sequence.truth_counts), len(sequence.estimate_counts)))
    for truth, estimate, similarity in sequence.meetings():
        rows, columns = np.nonzero(similarity >= threshold)
        together[truth[rows], estimate[columns]] += 1.0
    # Misses and false positives of a pairing are the fewest where the steps together are the most.
    explained = float(together[linear_sum_assignment(together, maximize=True)].sum())
    true, reported = float(sequence.truth_counts.sum()), float(sequence.estimate_counts.sum())
    return IdentityScores(
        2.0 * explained / max(true + reported, 1.0), explained / max(reported, 1.0), explained / max(true, 1.0)
    )
