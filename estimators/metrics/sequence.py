"""Input of the multi-object tracking metrics: existing tracks and pairwise similarities at each step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.joined import Joined
from servotrack.estimators.metrics.tracks import Track, members_by_step
from servotrack.estimators.types import Array, Labels, Mask

EPSILON = float(np.finfo(np.float64).eps)
"""Rounding error that a similarity at the threshold may have."""


class Frame(NamedTuple):
    """Existing tracks of one step, and their similarities.

    Attributes:
        truth: Indices of the true tracks that exist. Shape (n,).
        estimate: Indices of the estimated tracks that exist. Shape (k,).
        similarity: Similarity of each pair, from 0 to 1. Shape (n, k).
    """

    truth: NDArray[np.intp]
    estimate: NDArray[np.intp]
    similarity: Array


class _Frames(Sequence[Frame]):
    """Frames sliced from whole arrays on access, to save memory in long sequences.

    Args:
        sizes: Numbers of true and of estimated tracks at each step, shape (T, 2).
        truth: Indices of the true tracks of all steps, concatenated.
        estimate: Indices of the estimated tracks of all steps, concatenated.
        similarity: Similarities of all pairs of all steps, flattened and concatenated.
    """

    def __init__(self, sizes: Labels, truth: NDArray[np.intp], estimate: NDArray[np.intp], similarity: Array) -> None:
        ends = np.cumsum(np.column_stack([sizes, sizes.prod(axis=1)]), axis=0)
        self._sizes, self._bounds = sizes, np.concatenate([np.zeros((1, 3), np.int64), ends])
        self._truth, self._estimate, self._similarity = truth, estimate, similarity

    def __len__(self) -> int:
        return len(self._sizes)

    @overload
    def __getitem__(self, step: int) -> Frame: ...

    @overload
    def __getitem__(self, step: slice) -> list[Frame]: ...

    def __getitem__(self, step: int | slice) -> Frame | list[Frame]:
        if isinstance(step, slice):
            return [self[one] for one in range(*step.indices(len(self)))]
        one = range(len(self))[step]
        (first, other, pair), (last, end, stop) = self._bounds[one].tolist(), self._bounds[one + 1].tolist()
        similarity = self._similarity[pair:stop].reshape(last - first, end - other)
        return Frame(self._truth[first:last], self._estimate[other:end], similarity)


class TrackSequence(NamedTuple):
    """Frames of all steps, and the lengths of the tracks.

    Attributes:
        frames: One frame per step.
        truth_counts: Steps at which each true track exists. Shape (number of true tracks,).
        estimate_counts: Steps at which each estimated track exists. Shape (number of estimated tracks,).
    """

    frames: Sequence[Frame]
    truth_counts: Labels
    estimate_counts: Labels

    @classmethod
    def of(
        cls,
        sizes: Labels,
        truth: NDArray[np.intp],
        estimate: NDArray[np.intp],
        similarity: Array,
        true_tracks: int,
        estimated_tracks: int,
    ) -> TrackSequence:
        """Make a sequence of whole arrays.

        Args:
            sizes: Numbers of true and of estimated tracks at each step, shape (T, 2).
            truth: Indices of the true tracks of all steps, concatenated.
            estimate: Indices of the estimated tracks of all steps, concatenated.
            similarity: Similarities of all pairs of all steps, flattened and concatenated.
            true_tracks: Number of true tracks.
            estimated_tracks: Number of estimated tracks.
        """
        return cls(
            _Frames(sizes, truth, estimate, similarity),
            np.bincount(truth, minlength=true_tracks).astype(np.int64),
            np.bincount(estimate, minlength=estimated_tracks).astype(np.int64),
        )

    def meetings(self) -> Iterator[Frame]:
        """Iterate over the steps with at least one true and one estimated track."""
        return (frame for frame in self.frames if frame.similarity.size)


def track_sequence(
    truth: Sequence[Track],
    estimate: Sequence[Track],
    distances: Callable[[Array, Array], Array],
    cutoff: float,
    ignored: Sequence[Track] = (),
    threshold: float = 0.5,
) -> TrackSequence:
    """Compute the similarities of true and estimated tracks at each step.

    Args:
        truth: True tracks that count.
        estimate: Estimated tracks.
        distances: Base distances of two arrays of states, (n, d) and (k, d) to (n, k).
        cutoff: Distance at which the similarity, which falls linearly from 1, reaches 0.
        ignored: True tracks that do not count, such as hidden people. An estimate that the best assignment of a step
            gives to one of them is dropped at that step, as in MOTChallenge.
        threshold: Smallest similarity of a pair in that assignment.

    Raises:
        ValueError: `cutoff` is not positive, or states differ in dimension.
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
    sizes = np.zeros((length, 2), np.int64)
    those, others, pairs = Joined(np.intp), Joined(np.intp), Joined(np.float64)
    for step, ((a, true), (b, estimated)) in enumerate(zip(there, here, strict=True)):
        similarity = np.zeros((len(a), len(b)))
        if similarity.size:
            similarity = np.clip(1.0 - distances(true, estimated) / cutoff, 0.0, 1.0)
        counted = a < len(truth)
        if not counted.all():
            kept = _not_ignored(similarity, counted, threshold)
            a, b, similarity = a[counted], b[kept], similarity[np.ix_(counted, kept)]
        sizes[step] = len(a), len(b)
        those.append(a)
        others.append(b)
        pairs.append(similarity.ravel())
    return TrackSequence.of(sizes, those.array(), others.array(), pairs.array(), len(truth), len(estimate))


def _not_ignored(similarity: Array, counted: Mask, threshold: float) -> Mask:
    """Mask of the estimates not assigned to ignored tracks; counted tracks are assigned first."""
    eligible = np.where(similarity >= threshold - EPSILON, similarity, 0.0)
    # The bonus exceeds the sum of all similarities, so pairs with counted tracks come first.
    rows, columns = linear_sum_assignment(eligible + (eligible > 0.0) * counted[:, None] * len(counted), maximize=True)
    dropped = (eligible[rows, columns] > 0.0) & ~counted[rows]
    kept = np.ones(similarity.shape[1], dtype=np.bool_)
    kept[columns[dropped]] = False
    return kept
