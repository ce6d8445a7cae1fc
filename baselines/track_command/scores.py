"""Scores of tracks against a sequence's truth, as a table and as numbers."""

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
    """When an estimate is a person.

    Attributes:
        distances: Of true and estimated boxes.
        cutoff: Distance at which similarity is 0; the c of OSPA.
        threshold: Similarity from which CLEAR MOT and IDF1 count a match.
        summary: One line for people.
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
    """How well a sequence was tracked; ratios from 0 to 1, MOTA possibly below 0.

    Attributes:
        frames: Number of frames.
        count_accuracy: Share of frames with the right number of people.
        mota: Bernardin and Stiefelhagen (2008).
        idf1: Ristani et al. (2016).
        hota: Luiten et al. (2021).
        ospa: Mean over frames, in units of the rule's distance, cut at its cutoff.
        identity_switches: Of CLEAR MOT.
        false_positives: Of CLEAR MOT.
        misses: Of CLEAR MOT.
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
    """Score what was found in some frames. As on MOTChallenge every true box counts, hidden ones too.

    Args:
        truth: Of the sequence.
        found: By a tracker.
        frames: The frames that were tracked, from 0, increasing.
        match: Name of a rule.

    Raises:
        ValueError: No such rule, or no frames.
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
    """Scores as a table of one row."""
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
    """Tracks on the axis of the frames that were tracked; those that have nothing there are left out."""
    kept = []
    for track in tracks.tracks:
        at = np.searchsorted(numbers, track.steps)
        inside = numbers[np.minimum(at, len(numbers) - 1)] == track.steps
        if inside.any():
            kept.append(Track(at[inside], track.states[inside]))
    return kept


def _by_frame(true: list[Track], estimated: list[Track], length: int, rule: MatchRule) -> tuple[float, float]:
    """Share of frames with the right number, and mean OSPA."""
    there, here = members_by_step(true, length, 4), members_by_step(estimated, length, 4)
    right = np.array([len(a.rows) == len(b.rows) for a, b in zip(there, here, strict=True)])
    ospa = [
        float(
            score_distances(
                rule.distances(a.states, b.states),
                np.ones(len(a.rows), np.bool_),
                np.ones(len(b.rows), np.bool_),
                rule.cutoff,
            ).ospa
        )
        for a, b in zip(there, here, strict=True)
    ]
    # Rounding may leave a distance of equal boxes below 0.
    return float(right.mean()), max(float(np.mean(ospa)), 0.0)
