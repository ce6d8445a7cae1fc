"""CLEAR MOT, IDF1 and HOTA of two lists of tracks, in one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from servotrack.estimators.metrics.clear import clear_mot
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.metrics.hota import hota_scores
from servotrack.estimators.metrics.identity import identity_scores
from servotrack.estimators.metrics.sequence import track_sequence
from servotrack.estimators.metrics.tracks import Track
from servotrack.estimators.types import Array


class MotScores(NamedTuple):
    """What tables of multi-object tracking report; ratios from 0 to 1, MOTA possibly below 0.

    Attributes:
        hota, deta, assa: Luiten et al. (2021), averaged over localization thresholds.
        idf1: Ristani et al. (2016).
        mota, motp: Bernardin and Stiefelhagen (2008).
        identity_switches, false_positives, misses: Counts under CLEAR MOT's matching.
        fragments: How often a true track is found again after a gap, under the same.
    """

    hota: float
    deta: float
    assa: float
    idf1: float
    mota: float
    motp: float
    identity_switches: int
    false_positives: int
    misses: int
    fragments: int


def mot_scores(
    truth: Sequence[Track],
    estimate: Sequence[Track],
    distances: Callable[[Array, Array], Array] = box_distances,
    cutoff: float = 1.0,
    threshold: float = 0.5,
    ignored: Sequence[Track] = (),
) -> MotScores:
    """Score tracks against the truth, with the results of the field's reference implementation, `trackeval`.

    Args:
        truth: True tracks.
        estimate: Estimated tracks.
        distances: Base distances of two arrays of states, (n, d) and (k, d) to (n, k); boxes by default.
        cutoff: Distance at which similarity, which falls linearly from 1, is 0.
        threshold: Similarity from which CLEAR MOT and IDF1 count a match, above 0 and at most 1.
        ignored: True tracks whose finding is neither right nor wrong, such as people who are hidden; an estimate that
            fits one of them at a step, and no counted one, is left out there. A track may be counted at some
            steps and ignored at others: give its parts to the two lists.

    Raises:
        ValueError: `cutoff` is not positive, `threshold` is out of range, or tracks of unlike states.
    """
    if not 0.0 < threshold <= 1.0:
        raise ValueError(f"threshold must be above 0 and at most 1, got {threshold!r}")
    sequence = track_sequence(truth, estimate, distances, cutoff, ignored, threshold)
    clear, identity, hota = clear_mot(sequence, threshold), identity_scores(sequence, threshold), hota_scores(sequence)
    return MotScores(
        hota=float(np.mean(hota.hota)),
        deta=float(np.mean(hota.deta)),
        assa=float(np.mean(hota.assa)),
        idf1=identity.idf1,
        mota=clear.mota,
        motp=clear.motp,
        identity_switches=clear.identity_switches,
        false_positives=clear.false_positives,
        misses=clear.misses,
        fragments=clear.fragments,
    )
