"""Tracks of the Poisson multi-Bernoulli filter of boxes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.types import Array, Labels, Mask


class BoxTracks(NamedTuple):
    """T tracks of people.

    Attributes:
        mean: Center column, its velocity, center row, its velocity, width, height. Shape (T, 6), px and px/s.
        variance: Variance of the position, covariance of position and velocity, variance of the velocity, for columns
            and then for rows; then variances of width and height. Shape (T, 8).
        existence: Probabilities that the track is of something that persists. Shape (T,).
        person: Probabilities that it is a person, if so. Shape (T,).
        evidence: Mean log odds of the scores, log odds of the last one, and deviation of the height in standard
            deviations, weighted by how far scores tell something, at the last detection. Shape (T, 3).
        label: Identities. Shape (T,).
        missed: Number of frames since the last detection. Shape (T,).
        absent: Time since the last detection, s. Shape (T,).
        seen: Number of detections so far. Shape (T,).
        shares: True where the last region is shared with another track. Shape (T,).
        reading: Score of the last detection, as `read_scores` reads it. Shape (T,).
        readings: Readings of all detections, summed. Shape (T,).
        innovation: Normalized innovations of the last frame, zero without a detection. Shape (T, 4).
        appearance: Mean appearance vector of unit length, or zero. Shape (T, F).
        rival: Identity of the person that it met and has not parted from, 0 for none. Shape (T,).
        parted: Time since the two no longer overlap, s. Shape (T,).
        before: Appearance before the meeting. Shape (T, F).
    """

    mean: Array
    variance: Array
    existence: Array
    person: Array
    evidence: Array
    label: Labels
    missed: Labels
    absent: Array
    seen: Labels
    shares: Mask
    reading: Array
    readings: Array
    innovation: Array
    appearance: Array
    rival: Labels
    parted: Array
    before: Array


def new_tracks(
    mean: Array, variance: Array, existence: Array, label: int, reading: Array, appearance: Array
) -> BoxTracks:
    """Return tracks with one detection each.

    Args:
        mean: Means, see `BoxTracks`. Shape (k, 6).
        variance: Variances, see `BoxTracks`. Shape (k, 8).
        existence: Probabilities that something persists. Shape (k,).
        label: Identity of the first one; the others follow.
        reading: Scores as read. Shape (k,).
        appearance: Appearance vectors. Shape (k, F).
    """
    count = len(mean)
    none, zeros = np.zeros(count, np.int64), np.zeros(count)
    return BoxTracks(
        mean,
        variance,
        existence,
        zeros,
        np.zeros((count, 3)),
        label + np.arange(count),
        none,
        zeros,
        none + 1,
        none > 0,
        reading,
        reading,
        np.zeros((count, 4)),
        appearance,
        none,
        zeros,
        appearance,
    )
