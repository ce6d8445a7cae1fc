"""CLEAR MOT (Bernardin and Stiefelhagen, 2008): errors under a matching that keeps the pairs of the previous step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.sequence import EPSILON, TrackSequence


class ClearScores(NamedTuple):
    """CLEAR MOT scores.

    Attributes:
        mota: One minus misses, false positives and switches per true object, at most 1.
        motp: Mean similarity of matched pairs, 0 without pairs.
        matches, misses, false_positives, identity_switches: Counts over all steps.
        fragments: Number of times a true track is found again after a gap.
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
        sequence: Result of `track_sequence`.
        threshold: Smallest similarity of a matched pair, in (0, 1]. Larger values demand more exact estimates.
    """
    objects = len(sequence.truth_counts)
    last = np.full(objects, -1)  # estimate of the latest match of each true track
    current = np.full(objects, -1)  # estimate matched at the previous step only
    fragments = np.zeros(objects, dtype=np.int64)
    matches = misses = false_positives = switches = 0
    total = 0.0
    for truth, estimate, similarity in sequence.frames:
        if len(truth) == 0 or len(estimate) == 0:
            # Pairs survive a step at which one side is empty, as in the reference implementation.
            misses += len(truth)
            false_positives += len(estimate)
            continue
        # A pair of the previous step outweighs any similarity.
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
    # Without true objects the ratio is undefined; it is reported as 0.
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
