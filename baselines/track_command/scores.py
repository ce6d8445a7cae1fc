"""Scores of tracks against the truth of a sequence, as numbers and as a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from servotrack.baselines.reporting.grid import Grid
from servotrack.envs.track.files.recorded import RecordedTracks
from servotrack.estimators.metrics import (
    Track,
    box_distances,
    centroid_distances,
    members_by_step,
    mot_scores,
    score_distances,
)
from servotrack.estimators.types import Array, Labels


class MatchRule(NamedTuple):
    """Rule that matches estimated boxes to true ones.

    Attributes:
        distances: Function of true boxes (n, 4) and estimated boxes (m, 4) that returns distances (n, m).
        cutoff: Distance at which similarity is 0; the c of OSPA. A larger value accepts coarser matches.
        threshold: Smallest similarity that CLEAR MOT and IDF1 count as a match.
        summary: Description for tables.
    """

    distances: Callable[[Array, Array], Array]
    cutoff: float
    threshold: float
    summary: str


MATCH_RULES = {
    "iou": MatchRule(box_distances, 1.0, 0.5, "boxes overlap by an IoU of at least 0.5"),
    "centroid": MatchRule(centroid_distances, 1.2, 0.5, "centers are at most 0.6 of the true height apart"),
}


class TrackScores(NamedTuple):
    """Scores of one tracker on one sequence. Ratios are from 0 to 1; MOTA may be negative.

    Attributes:
        frames: Number of frames.
        count_accuracy: Share of frames with the right number of people.
        mota: CLEAR MOT accuracy, Bernardin and Stiefelhagen (2008).
        idf1: Identity F1, Ristani et al. (2016).
        hota: Higher order tracking accuracy, Luiten et al. (2021).
        ospa: Mean OSPA over frames, in units of the rule's distance, at most its cutoff.
        identity_switches: Identity switches of CLEAR MOT.
        false_positives: False positives of CLEAR MOT.
        misses: Misses of CLEAR MOT.
    """

    frames: int
    count_accuracy: float
    mota: float
    idf1: float
    hota: float
    ospa: float
    identity_switches: int
    false_positives: int
    misses: int


def score_tracks(
    truth: RecordedTracks, found: RecordedTracks, frames: Sequence[int], match: str = "iou"
) -> TrackScores:
    """Score the tracks in the given frames. As on MOTChallenge every true box counts, hidden ones too.

    Args:
        truth: True tracks.
        found: Tracks of a tracker.
        frames: Numbers of the tracked frames, from 0, increasing.
        match: Name in `MATCH_RULES`.

    Raises:
        ValueError: Unknown rule, or no frames.
    """
    if match not in MATCH_RULES:
        raise ValueError(f"match must be one of {', '.join(MATCH_RULES)}, got {match!r}")
    if len(frames) == 0:
        raise ValueError("frames must hold at least one frame, got none")
    rule = MATCH_RULES[match]
    numbers = np.asarray(frames, dtype=np.int64)
    true, estimated = _within(truth, numbers), _within(found, numbers)
    right, ospa = _by_frame(true, estimated, len(numbers), rule)
    scores = mot_scores(true, estimated, rule.distances, rule.cutoff, rule.threshold)
    return TrackScores(
        len(numbers),
        right,
        scores.mota,
        scores.idf1,
        scores.hota,
        ospa,
        scores.identity_switches,
        scores.false_positives,
        scores.misses,
    )


def score_grid(scores: TrackScores, name: str) -> Grid:
    """Return the scores as a table of one row."""
    headings = ["tracker", "frames", "count right", "MOTA", "IDF1", "HOTA", "OSPA", "switches", "false", "missed"]
    percent = [scores.count_accuracy, scores.mota, scores.idf1, scores.hota]
    cells = [
        name,
        str(scores.frames),
        *(f"{100.0 * value:.1f}" for value in percent),
        f"{scores.ospa:.3f}",
        *(str(value) for value in (scores.identity_switches, scores.false_positives, scores.misses)),
    ]
    return Grid(headings, [cells], 1)


def _within(tracks: RecordedTracks, numbers: Labels) -> list[Track]:
    """Tracks with steps counted in tracked frames; tracks outside of them are left out."""
    kept = []
    for track in tracks.tracks:
        at = np.searchsorted(numbers, track.steps)
        inside = numbers[np.minimum(at, len(numbers) - 1)] == track.steps
        if inside.any():
            kept.append(Track(at[inside], track.states[inside]))
    return kept


def _by_frame(true: list[Track], estimated: list[Track], length: int, rule: MatchRule) -> tuple[float, float]:
    """Share of frames with the right number of people, and mean OSPA."""
    true_rows, found_rows = members_by_step(true, length, 4), members_by_step(estimated, length, 4)
    right = np.array([len(a.rows) == len(b.rows) for a, b in zip(true_rows, found_rows, strict=True)])
    ospa = [
        float(
            score_distances(
                rule.distances(a.states, b.states),
                np.ones(len(a.rows), np.bool_),
                np.ones(len(b.rows), np.bool_),
                rule.cutoff,
            ).ospa
        )
        for a, b in zip(true_rows, found_rows, strict=True)
    ]
    # Rounding may leave a distance of equal boxes below 0.
    return float(right.mean()), max(float(np.mean(ospa)), 0.0)
