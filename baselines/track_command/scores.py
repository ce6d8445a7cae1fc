"""Scores of tracks against the truth of a sequence, as numbers and as a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from servotrack.baselines.reporting.grid import Grid
from servotrack.envs.track.files.labeled import LabeledTruth, boxes_of
from servotrack.envs.track.files.recorded import RecordedTracks
from servotrack.estimators.metrics import (
    BENCHMARKS,
    LabeledBoxes,
    benchmark_sequence,
    box_similarities,
    centroid_distances,
    score_distances,
    sequence_scores,
)
from servotrack.estimators.metrics.sequence import TrackSequence
from servotrack.estimators.types import Array, Labels


class MatchRule(NamedTuple):
    """Rule that matches estimated boxes to true ones.

    Attributes:
        similarities: Function of true boxes (n, 4) and estimated boxes (m, 4) that returns similarities (n, m), 0 to 1.
        cutoff: Distance at which similarity is 0; the c of OSPA. A larger value accepts coarser matches.
        threshold: Smallest similarity that CLEAR MOT and IDF1 count as a match.
        summary: Description for tables.
    """

    similarities: Callable[[Array, Array], Array]
    cutoff: float
    threshold: float
    summary: str


_CENTROID_CUTOFF = 1.2


def _centroid_similarities(first: Array, second: Array) -> Array:
    return np.clip(1.0 - centroid_distances(first, second) / _CENTROID_CUTOFF, 0.0, 1.0)


MATCH_RULES = {
    "iou": MatchRule(box_similarities, 1.0, 0.5, "boxes overlap by an IoU of at least 0.5"),
    "centroid": MatchRule(
        _centroid_similarities, _CENTROID_CUTOFF, 0.5, "centers are at most 0.6 of the true height apart"
    ),
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
    truth: LabeledTruth | RecordedTracks,
    found: RecordedTracks | LabeledBoxes,
    frames: Sequence[int],
    match: str = "iou",
    benchmark: str | None = None,
) -> TrackScores:
    """Score the tracks in the given frames by the rules of a benchmark. Every box that it counts counts, hidden or not.

    Args:
        truth: True tracks; of recorded tracks all count.
        found: Tracks of a tracker.
        frames: Numbers of the tracked frames, from 0, increasing.
        match: Name in `MATCH_RULES`.
        benchmark: Name in `BENCHMARKS`; None: the one that fits the truth.

    Raises:
        ValueError: Unknown rule or benchmark, classes that the benchmark does not know, or no frames.
    """
    if match not in MATCH_RULES:
        raise ValueError(f"match must be one of {', '.join(MATCH_RULES)}, got {match!r}")
    if len(frames) == 0:
        raise ValueError("frames must hold at least one frame, got none")
    if isinstance(truth, RecordedTracks):
        truth = LabeledTruth(boxes_of(truth), boxes_of(RecordedTracks(np.zeros(0, np.int64), [], [])), "mot15")
    rules = BENCHMARKS[check_benchmark(benchmark or truth.benchmark)]
    rule, numbers = MATCH_RULES[match], np.asarray(frames, dtype=np.int64)
    answers = found if isinstance(found, LabeledBoxes) else boxes_of(found)
    if isinstance(found, RecordedTracks) and rules.scored is not None:
        answers = answers._replace(classes=np.full_like(answers.classes, rules.scored))
    sequence = benchmark_sequence(
        _within(truth.boxes, numbers),
        _within(answers, numbers),
        rules,
        _within(truth.regions, numbers),
        rule.similarities,
    )
    right, ospa = _by_frame(sequence, len(numbers), rule)
    scores = sequence_scores(sequence, rule.threshold)
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


def check_benchmark(name: str) -> str:
    """Return the name if it is one of `BENCHMARKS`.

    Raises:
        ValueError: Another name.
    """
    if name not in BENCHMARKS:
        raise ValueError(f"benchmark must be one of {', '.join(BENCHMARKS)}, got {name!r}")
    return name


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


def _within(boxes: LabeledBoxes, numbers: Labels) -> LabeledBoxes:
    """Boxes of tracked frames."""
    return boxes.part(np.isin(boxes.steps, numbers))


def _by_frame(sequence: TrackSequence, length: int, rule: MatchRule) -> tuple[float, float]:
    """Share of frames with the right number of people, and mean OSPA; frames outside of the sequence are empty."""
    wrong, total = 0, 0.0
    for frame in sequence.frames:
        there, here = len(frame.truth), len(frame.estimate)
        wrong += there != here
        total += float(
            score_distances(
                rule.cutoff * (1.0 - frame.similarity),
                np.ones(there, np.bool_),
                np.ones(here, np.bool_),
                rule.cutoff,
            ).ospa
        )
    # Rounding may leave a distance of equal boxes below 0.
    return 1.0 - wrong / length, max(total / length, 0.0)
