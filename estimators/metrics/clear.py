"""CLEAR MOT (Bernardin and Stiefelhagen, 2008): errors counted under a matching that holds on to yesterday's pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.sequence import EPSILON, TrackSequence


class ClearScores(NamedTuple):
    """CLEAR MOT.

    Attributes:
        mota: One minus misses, false positives and switches per true object, at most 1.
        motp: Mean similarity of matched pairs, 0 where there are none.
        matches, misses, false_positives, identity_switches: Counts over all steps.
        fragments: How often a true track is found again after a gap.
    """

    mota: float
    motp: float
    matches: int
    misses: int
    false_positives: int
    identity_switches: int
    fragments: int


def clear_mot(sequence: TrackSequence, threshold: float = 0.5) -> ClearScores:
    """Score a sequence.

    Args:
        sequence: From `track_sequence`.
        threshold: Similarity from which two may be matched.
    """
    objects = len(sequence.truth_counts)
    last = np.full(objects, -1)  # estimate that a true track was last matched with, at any earlier step
    current = np.full(objects, -1)  # the same, at the step before only
    fragments = np.zeros(objects, dtype=np.int64)
    matches = misses = false_positives = switches = 0
    total = 0.0
    for truth, estimate, similarity in sequence.frames:
        if len(truth) == 0 or len(estimate) == 0:
            # As the reference implementation does, pairs outlive a step at which one side is empty.
            misses += len(truth)
            false_positives += len(estimate)
            continue
        # A pair of the step before is worth more than any similarity.
        value = 1000.0 * (estimate[None, :] == current[truth][:, None]) + similarity
        value[similarity < threshold - EPSILON] = 0.0
        rows, columns = linear_sum_assignment(value, maximize=True)
        matched = value[rows, columns] > EPSILON
        rows, columns = rows[matched], columns[matched]
        found, by = truth[rows], estimate[columns]
        switches += int(np.sum((last[found] >= 0) & (last[found] != by)))
        fragments[found[current[found] < 0]] += 1
        last[found] = by
        current[:] = -1
        current[found] = by
        matches += len(found)
        misses += len(truth) - len(found)
        false_positives += len(estimate) - len(found)
        total += float(similarity[rows, columns].sum())
    errors = misses + false_positives + switches
    # Without truth there is nothing to be a share of; without answers nobody was found.
    mota = 1.0 - errors / (matches + misses) if matches + misses else 0.0
    return ClearScores(
        mota,
        total / max(matches, 1),
        matches,
        misses,
        false_positives,
        switches,
        int(np.sum(np.maximum(fragments - 1, 0))),
    )
