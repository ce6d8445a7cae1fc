"""A sequence as the metrics of multi-object tracking read it: who is there at each step, and how like each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.tracks import Array, Track, members_by_step

EPSILON = float(np.finfo(np.float64).eps)  # rounding that a similarity at the threshold is forgiven


class Frame(NamedTuple):
    """One step.

    Attributes:
        truth: Indices of the true tracks that exist. Shape (n,).
        estimate: Indices of the estimated tracks that exist. Shape (k,).
        similarity: Of each pair, from 0 to 1. Shape (n, k).
    """

    truth: NDArray[np.intp]
    estimate: NDArray[np.intp]
    similarity: Array


class TrackSequence(NamedTuple):
    """All steps.

    Attributes:
        frames: One per step.
        truth_counts: Steps at which each true track exists. Shape (number of true tracks,).
        estimate_counts: Steps at which each estimated track exists. Shape (number of estimated tracks,).
    """

    frames: list[Frame]
    truth_counts: NDArray[np.int64]
    estimate_counts: NDArray[np.int64]

    def meetings(self) -> Iterator[Frame]:
        """The steps at which both sides exist; the others say nothing about who is whom."""
        return (frame for frame in self.frames if frame.similarity.size)


def track_sequence(
    truth: Sequence[Track],
    estimate: Sequence[Track],
    distances: Callable[[Array, Array], Array],
    cutoff: float,
    ignored: Sequence[Track] = (),
    threshold: float = 0.5,
) -> TrackSequence:
    """Pair up what exists step by step.

    Args:
        truth: True tracks that count.
        estimate: Estimated tracks.
        distances: Base distances of two arrays of states, (n, d) and (k, d) to (n, k).
        cutoff: Distance at which similarity, which falls linearly from 1, is 0.
        ignored: True tracks that do not count, such as people who are hidden: an estimate that the best assignment of
            a step gives to one of them is dropped there, as MOTChallenge does before it scores.
        threshold: Similarity from which that assignment pairs.

    Raises:
        ValueError: `cutoff` is not positive, or tracks of unlike states.
    """
    if not cutoff > 0.0:
        raise ValueError(f"cutoff must be positive, got {cutoff!r}")
    everything = [*truth, *ignored, *estimate]
    length = max((int(np.max(track.steps)) + 1 for track in everything if len(track.steps)), default=0)
    if length == 0:
        return TrackSequence([], np.zeros(len(truth), np.int64), np.zeros(len(estimate), np.int64))
    dimension = next(np.asarray(track.states).shape[1] for track in everything if len(track.steps))
    there = members_by_step([*truth, *ignored], length, dimension)
    here = members_by_step(estimate, length, dimension)
    frames = []
    for (a, true), (b, estimated) in zip(there, here, strict=True):
        similarity = np.zeros((len(a), len(b)))
        if similarity.size:
            similarity = np.clip(1.0 - distances(true, estimated) / cutoff, 0.0, 1.0)
        counted = a < len(truth)
        if not counted.all():
            kept = _not_ignored(similarity, counted, threshold)
            a, b, similarity = a[counted], b[kept], similarity[np.ix_(counted, kept)]
        frames.append(Frame(a, b, similarity))
    return TrackSequence(
        frames,
        _counts([frame.truth for frame in frames], len(truth)),
        _counts([frame.estimate for frame in frames], len(estimate)),
    )


def _counts(members: list[NDArray[np.intp]], number: int) -> NDArray[np.int64]:
    return np.bincount(np.concatenate(members), minlength=number).astype(np.int64)


def _not_ignored(similarity: Array, counted: NDArray[np.bool_], threshold: float) -> NDArray[np.bool_]:
    """Which estimates are not paired with ignored truth, truth that counts coming first."""
    eligible = np.where(similarity >= threshold - EPSILON, similarity, 0.0)
    # More than all similarities together: no pair with truth that counts is given up.
    rows, columns = linear_sum_assignment(eligible + (eligible > 0.0) * counted[:, None] * len(counted), maximize=True)
    dropped = (eligible[rows, columns] > 0.0) & ~counted[rows]
    kept = np.ones(similarity.shape[1], dtype=np.bool_)
    kept[columns[dropped]] = False
    return kept
