"""CLEAR MOT, IDF1 and HOTA of two lists of tracks, in one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from servotrack.estimators.metrics.clear import clear_mot
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.metrics.hota import hota_scores
from servotrack.estimators.metrics.identity import identity_scores
from servotrack.estimators.metrics.sequence import TrackSequence, track_sequence
from servotrack.estimators.metrics.tracks import Track
from servotrack.estimators.types import Array


class MotScores(NamedTuple):
    """Scores of multi-object tracking; ratios from 0 to 1, MOTA possibly below 0.

    Attributes:
        hota, deta, assa: Luiten et al. (2021), averaged over localization thresholds.
        idf1: Ristani et al. (2016).
        mota, motp: Bernardin and Stiefelhagen (2008).
        identity_switches, false_positives, misses: Counts under CLEAR MOT's matching.
        fragments: Number of times a true track is found again after a gap, under the same matching.
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
        cutoff: Distance at which the similarity, which falls linearly from 1, reaches 0.
        threshold: Smallest similarity of a match in CLEAR MOT and IDF1, in (0, 1].
        ignored: True tracks that count neither as matches nor as misses, such as hidden people. An estimate that
            matches an ignored track and no counted one at a step is left out at that step. A track may be counted at
            some steps and ignored at others: put its parts into the two lists.

    Raises:
        ValueError: `cutoff` is not positive, `threshold` is out of range, or states differ in dimension.
    """
    if not 0.0 < threshold <= 1.0:
        raise ValueError(f"threshold must be above 0 and at most 1, got {threshold!r}")
    return sequence_scores(track_sequence(truth, estimate, distances, cutoff, ignored, threshold), threshold)


def sequence_scores(sequence: TrackSequence, threshold: float = 0.5) -> MotScores:
    """Score a sequence of `track_sequence` or `benchmark_sequence`.

    Args:
        sequence: Similarities at each step.
        threshold: Smallest similarity of a match in CLEAR MOT and IDF1, in (0, 1].
    """
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
