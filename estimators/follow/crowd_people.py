"""States of people in the image, and densities of their detections, compiled for `CrowdFollower`.

A person's state is Gaussian with the same variance along both image axes, so that a turn of the camera leaves it as it
is: position and velocity have the covariance [[s0, s1], [s1, s2]], and the color has one variance for all channels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels


class People(NamedTuple):
    """Gaussian states of up to K people in each of B runs; rows of weight 0 are unused.

    Attributes:
        mean: Position and own velocity in the image: u, v, u', v'. Shape (B, K, 4), px and px/s.
        spread: Variance of a position, covariance with its velocity, variance of a velocity, each along one axis.
            Shape (B, K, 3), px^2, px^2/s, px^2/s^2.
        color: Mean color. Shape (B, K, 3), gray levels.
        color_variance: Variance of each channel. Shape (B, K), gray levels squared.
        width: Width of the person's detections. Shape (B, K), px.
        hidden: Probability that something that is not tracked covers the person. Shape (B, K).
        weight: Probability that the person exists, or of the hypothesis. Shape (B, K).
        label: Label of the person's track, or of the track that the hypothesis takes for the person; -1: none.
            Shape (B, K).
    """

    mean: Array
    spread: Array
    color: Array
    color_variance: Array
    width: Array
    hidden: Array
    weight: Array
    label: Labels


class CrowdRules(NamedTuple):
    """Parameters of a `CrowdFollower` in the units of the kernel; fields as there, lengths per person's width."""

    acceleration: float
    crowd_acceleration: float
    speed: float
    position_noise: float
    color_noise: float
    color_drift: float
    size_noise: float
    detection: float
    births: float
    hide_rate: float
    show_rate: float
    uncover_rate: float
    turn_rate: float
    stop_rate: float
    leave_rate: float
    lose_rate: float
    merge_distance: float
    cover_margin: float
    color_outlier: float
    clutter_rate: float
    image_width: float
    first_color: float
    first_people: float


class CrowdMemory(NamedTuple):
    """Memory of B runs beside their people. Shapes (B, ...).

    Attributes:
        width: Width of the person to follow, px.
        color: Color of the person when last seen, (B, 3), gray levels.
        color_variance: Variance of each channel of that color.
        lost: Probability that the person may be anywhere.
        clutter: Expected number of detections per frame that no track explains.
        next_label: Label of the next track.
        place: Position of the most probable hypothesis, (B, 2), px.
        motion: Velocity of the most probable hypothesis, (B, 2), px/s.
        unseen: Number of frames since the most probable hypothesis had a detection.
        confidence: Probability of the hypotheses within a person's width of that position.
    """

    width: Array
    color: Array
    color_variance: Array
    lost: Array
    clutter: Array
    next_label: Labels
    place: Array
    motion: Array
    unseen: Labels
    confidence: Array


@njit(cache=True, nogil=True)
def _normal_share(x):  # type: ignore[no-untyped-def]
    """Approximate distribution function of the standard normal distribution (logistic, error below 0.01)."""
    return 1.0 / (1.0 + np.exp(-min(max(1.702 * x, -30.0), 30.0)))


@njit(cache=True, nogil=True)
def move_people(people, b, dt, acceleration, width, rules):  # type: ignore[no-untyped-def]
    """Predict all people of a run by `dt` s. Covers are places: people enter and leave them as they walk."""
    q = (acceleration * width) ** 2
    for k in range(people.weight.shape[1]):
        if people.weight[b, k] <= 0.0:
            continue
        mean, spread = people.mean[b, k], people.spread[b, k]
        mean[0] += dt * mean[2]
        mean[1] += dt * mean[3]
        spread[0] += dt * (2.0 * spread[1] + dt * spread[2]) + q * dt**3 / 3.0
        spread[1] += dt * spread[2] + q * dt * dt / 2.0
        spread[2] += q * dt
        people.color_variance[b, k] += rules.color_drift**2
        walked = dt * np.sqrt(mean[2] ** 2 + mean[3] ** 2 + 2.0 * spread[2]) / width
        hide = 1.0 - np.exp(-rules.hide_rate * walked)
        show = 1.0 - np.exp(-rules.show_rate * walked - rules.uncover_rate * dt)
        h = people.hidden[b, k]
        people.hidden[b, k] = h * (1.0 - show) + (1.0 - h) * hide


@njit(cache=True, nogil=True)
def in_view(mean, spread, size):  # type: ignore[no-untyped-def]
    """Probability that a position lies in the image."""
    s = np.sqrt(spread[0]) + 1.0
    return (
        _normal_share(mean[0] / s)
        * _normal_share((size - mean[0]) / s)
        * _normal_share(mean[1] / s)
        * _normal_share((size - mean[1]) / s)
    )


@njit(cache=True, nogil=True)
def color_density(detection, color, variance, rules):  # type: ignore[no-untyped-def]
    """Density of a detection's color."""
    off = 0.0
    for channel in range(3):
        off += (detection[5 + channel] - color[channel]) ** 2
    v = variance + rules.color_noise**2
    return (1.0 - rules.color_outlier) * np.exp(-0.5 * off / v) / (2.0 * np.pi * v) ** 1.5 + (
        rules.color_outlier / 255.0**3
    )


@njit(cache=True, nogil=True)
def size_density(detection, width, height, noise):  # type: ignore[no-untyped-def]
    """Density of the logarithms of a detection's width and height."""
    a = np.log(max(detection[3], 1.0) / width) / noise
    b = np.log(max(detection[4], 1.0) / height) / noise
    # Optics and merged or cut people: some sizes say little.
    wide = (2.5 * noise) ** 2
    return 0.9 * np.exp(-0.5 * (a * a + b * b)) / (2.0 * np.pi * noise * noise) + 0.1 * np.exp(
        -0.5 * (a * a + b * b) * noise * noise / wide
    ) / (2.0 * np.pi * wide)


@njit(cache=True, nogil=True)
def place_density(detection, u, v, variance):  # type: ignore[no-untyped-def]
    """Density of a detection's position."""
    d = (detection[1] - u) ** 2 + (detection[2] - v) ** 2
    return np.exp(-0.5 * d / variance) / (2.0 * np.pi * variance)


@njit(cache=True, nogil=True)
def covers(mean, spread, own, crowd, b, width, rules, merged):  # type: ignore[no-untyped-def]
    """Probability that another track covers a person, or is detected as one with them.

    Args:
        mean: Position and velocity of the person.
        spread: Covariance of both.
        own: Label of the person's own track.
        crowd: Tracks.
        b: Run.
        width: Width of a person, px.
        rules: Parameters.
        merged: Output: probability of a common detection with each track. Shape (T,).
    """
    clear = 1.0
    for m in range(crowd.weight.shape[1]):
        merged[m] = 0.0
        if crowd.weight[b, m] < 0.1 or crowd.label[b, m] == own:
            continue
        du, dv = mean[0] - crowd.mean[b, m, 0], mean[1] - crowd.mean[b, m, 1]
        distance = np.sqrt(du * du + dv * dv)
        if distance > 3.0 * width + crowd.width[b, m]:
            continue
        s = np.sqrt(spread[0] + crowd.spread[b, m, 0]) + 1.0
        if crowd.width[b, m] > 1.6 * width:
            inside = 0.5 * crowd.width[b, m] - rules.cover_margin * width
            clear *= 1.0 - crowd.weight[b, m] * _normal_share((inside - distance) / s)
        seen = crowd.weight[b, m] * (1.0 - crowd.hidden[b, m])
        merged[m] = 0.95 * seen * _normal_share((rules.merge_distance * width - distance) / s)
    return 1.0 - clear


@njit(cache=True, nogil=True)
def pair_density(detection, a, i, crowd, m, color, color_variance, b, width, rules):  # type: ignore[no-untyped-def]
    """Density of a common detection of person i of a table `a`, in this color, and track m: midway, of mixed color."""
    u, v = 0.5 * (a.mean[b, i, 0] + crowd.mean[b, m, 0]), 0.5 * (a.mean[b, i, 1] + crowd.mean[b, m, 1])
    both = rules.position_noise**2 + 0.25 * (a.spread[b, i, 0] + crowd.spread[b, m, 0])
    if (detection[1] - u) ** 2 + (detection[2] - v) ** 2 > 20.0 * both:
        return 0.0
    wide = width + abs(a.mean[b, i, 0] - crowd.mean[b, m, 0])
    high = width + abs(a.mean[b, i, 1] - crowd.mean[b, m, 1])
    mixed = 0.5 * (color + crowd.color[b, m])
    variance = 0.25 * (color_variance + crowd.color_variance[b, m])
    return (
        place_density(detection, u, v, both)
        * size_density(detection, wide, high, 1.5 * rules.size_noise)
        * color_density(detection, mixed, variance, rules)
    )


@njit(cache=True, nogil=True)
def correct_pair(people, b, i, mean, variance, color, color_variance, detection, rules):  # type: ignore[no-untyped-def]
    """Update person i of a table with a detection shared with a person of this mean, variance and color."""
    u, v = 2.0 * detection[1] - mean[0], 2.0 * detection[2] - mean[1]
    variance = 4.0 * rules.position_noise**2 + variance
    color_variance = 16.0 * rules.color_noise**2 + color_variance
    correct(people, b, i, u, v, variance, 2.0 * detection[5:8] - color, color_variance)


@njit(cache=True, nogil=True)
def correct(people, b, k, u, v, variance, color, color_variance):  # type: ignore[no-untyped-def]
    """Update a person with a measured position and color."""
    mean, spread = people.mean[b, k], people.spread[b, k]
    total = spread[0] + variance
    gain, gain_velocity = spread[0] / total, spread[1] / total
    off_u, off_v = u - mean[0], v - mean[1]
    mean[0] += gain * off_u
    mean[1] += gain * off_v
    mean[2] += gain_velocity * off_u
    mean[3] += gain_velocity * off_v
    spread[2] -= gain_velocity * spread[1]
    spread[1] *= 1.0 - gain
    spread[0] *= 1.0 - gain
    share = people.color_variance[b, k] / (people.color_variance[b, k] + color_variance)
    for channel in range(3):
        people.color[b, k, channel] += share * (color[channel] - people.color[b, k, channel])
    people.color_variance[b, k] *= 1.0 - share


@njit(cache=True, nogil=True)
def copy_person(source, i, target, b, k):  # type: ignore[no-untyped-def]
    """Copy person i of a run's table to row k of another table."""
    target.mean[b, k] = source.mean[b, i]
    target.spread[b, k] = source.spread[b, i]
    target.color[b, k] = source.color[b, i]
    target.color_variance[b, k] = source.color_variance[b, i]
    target.width[b, k] = source.width[b, i]
    target.hidden[b, k] = source.hidden[b, i]
    target.weight[b, k] = source.weight[b, i]
    target.label[b, k] = source.label[b, i]
