"""Compiled recursion of `CrowdFollower`: tracks of all people, and hypotheses about which of them is the person.

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
def _move(people, b, dt, acceleration, width, rules):  # type: ignore[no-untyped-def]
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
def _in_view(mean, spread, size):  # type: ignore[no-untyped-def]
    """Probability that a position lies in the image."""
    s = np.sqrt(spread[0]) + 1.0
    return (
        _normal_share(mean[0] / s)
        * _normal_share((size - mean[0]) / s)
        * _normal_share(mean[1] / s)
        * _normal_share((size - mean[1]) / s)
    )


@njit(cache=True, nogil=True)
def _color_density(detection, color, variance, rules):  # type: ignore[no-untyped-def]
    """Density of a detection's color."""
    off = 0.0
    for channel in range(3):
        off += (detection[5 + channel] - color[channel]) ** 2
    v = variance + rules.color_noise**2
    return (1.0 - rules.color_outlier) * np.exp(-0.5 * off / v) / (2.0 * np.pi * v) ** 1.5 + (
        rules.color_outlier / 255.0**3
    )


@njit(cache=True, nogil=True)
def _size_density(detection, width, height, noise):  # type: ignore[no-untyped-def]
    """Density of the logarithms of a detection's width and height."""
    a = np.log(max(detection[3], 1.0) / width) / noise
    b = np.log(max(detection[4], 1.0) / height) / noise
    # Optics and merged or cut people: some sizes say little.
    wide = (2.5 * noise) ** 2
    return 0.9 * np.exp(-0.5 * (a * a + b * b)) / (2.0 * np.pi * noise * noise) + 0.1 * np.exp(
        -0.5 * (a * a + b * b) * noise * noise / wide
    ) / (2.0 * np.pi * wide)


@njit(cache=True, nogil=True)
def _place_density(detection, u, v, variance):  # type: ignore[no-untyped-def]
    """Density of a detection's position."""
    d = (detection[1] - u) ** 2 + (detection[2] - v) ** 2
    return np.exp(-0.5 * d / variance) / (2.0 * np.pi * variance)


@njit(cache=True, nogil=True)
def _covers(mean, spread, own, crowd, b, width, rules, merged):  # type: ignore[no-untyped-def]
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
def _pair_density(detection, a, i, crowd, m, color, color_variance, b, width, rules):  # type: ignore[no-untyped-def]
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
        _place_density(detection, u, v, both)
        * _size_density(detection, wide, high, 1.5 * rules.size_noise)
        * _color_density(detection, mixed, variance, rules)
    )


@njit(cache=True, nogil=True)
def _correct_pair(people, b, i, mean, variance, color, color_variance, detection, rules):  # type: ignore[no-untyped-def]
    """Update person i of a table with a detection shared with a person of this mean, variance and color."""
    u, v = 2.0 * detection[1] - mean[0], 2.0 * detection[2] - mean[1]
    variance = 4.0 * rules.position_noise**2 + variance
    color_variance = 16.0 * rules.color_noise**2 + color_variance
    _correct(people, b, i, u, v, variance, 2.0 * detection[5:8] - color, color_variance)


@njit(cache=True, nogil=True)
def _correct(people, b, k, u, v, variance, color, color_variance):  # type: ignore[no-untyped-def]
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
def _copy(source, i, target, b, k):  # type: ignore[no-untyped-def]
    """Copy person i of a run's table to row k of another table."""
    target.mean[b, k] = source.mean[b, i]
    target.spread[b, k] = source.spread[b, i]
    target.color[b, k] = source.color[b, i]
    target.color_variance[b, k] = source.color_variance[b, i]
    target.width[b, k] = source.width[b, i]
    target.hidden[b, k] = source.hidden[b, i]
    target.weight[b, k] = source.weight[b, i]
    target.label[b, k] = source.label[b, i]


@njit(cache=True, nogil=True)
def _turned(guesses, b, dt, width, rules):  # type: ignore[no-untyped-def]
    """Add hypotheses in which the person turns, stops or starts now, where there is room."""
    count = guesses.weight.shape[1]
    before = guesses.weight[b].copy()
    free = 0
    for kind in range(2):
        share = 1.0 - np.exp(-(rules.turn_rate if kind == 0 else rules.stop_rate) * dt)
        deviation = rules.speed if kind == 0 else 0.1 * rules.speed
        for i in range(count):
            if before[i] < 1e-3:
                continue
            while free < count and guesses.weight[b, free] > 0.0:
                free += 1
            if free == count:
                return
            _copy(guesses, i, guesses, b, free)
            guesses.weight[b, free] = share * before[i]
            guesses.weight[b, i] -= share * before[i]
            guesses.mean[b, free, 2:] = 0.0
            guesses.spread[b, free, 1] = 0.0
            guesses.spread[b, free, 2] = (deviation * width) ** 2


@njit(cache=True, nogil=True)
def _register(crowd, b, detections, jitter, rules, shift):  # type: ignore[no-untyped-def]
    """Find the shift of the whole image under which most tracks meet a detection of their color.

    While arm and camera are hardly known, the predicted motion of the image is wrong by one shift of the whole image.

    Args:
        crowd: Tracks, predicted.
        b: Run.
        detections: Detections. Shape (M, 8).
        jitter: Variance of the shift along each axis, px^2.
        rules: Parameters.
        shift: Output. Shape (2,), px.

    Returns:
        Variance of the shift that is left along each axis, px^2.
    """
    tracks, rows = crowd.weight.shape[1], detections.shape[0]
    noise, left = rules.position_noise**2, jitter
    alike = np.zeros((tracks, rows))
    for m in range(tracks):
        for j in range(rows):
            if crowd.weight[b, m] > 0.3 and detections[j, 0] > 0.5:
                off = 0.0
                for channel in range(3):
                    off += (detections[j, 5 + channel] - crowd.color[b, m, channel]) ** 2
                alike[m, j] = np.exp(-0.25 * off / (crowd.color_variance[b, m] + rules.color_noise**2))
    best = 0.0
    for m in range(-1, tracks):
        for j in range(rows):
            if m < 0 and j > 0:
                break
            du, dv = 0.0, 0.0
            if m >= 0:
                if alike[m, j] < 0.05:
                    continue
                du, dv = detections[j, 1] - crowd.mean[b, m, 0], detections[j, 2] - crowd.mean[b, m, 1]
            score = -0.5 * (du * du + dv * dv) / jitter
            if score < -12.0:
                continue
            matched, sum_u, sum_v = 1.0 / jitter, 0.0, 0.0
            for k in range(tracks):
                most, best_u, best_v, precision = 0.0, 0.0, 0.0, 0.0
                for i in range(rows):
                    if alike[k, i] < 0.05:
                        continue
                    eu, ev = detections[i, 1] - crowd.mean[b, k, 0], detections[i, 2] - crowd.mean[b, k, 1]
                    spread = 2.0 * noise + crowd.spread[b, k, 0]
                    value = alike[k, i] * np.exp(-0.5 * ((eu - du) ** 2 + (ev - dv) ** 2) / spread)
                    if value > most:
                        most, best_u, best_v, precision = value, eu, ev, value / spread
                score += 4.0 * most
                matched += precision
                sum_u += precision * best_u
                sum_v += precision * best_v
            if m < 0 or score > best:
                best = score
                shift[0], shift[1] = sum_u / matched, sum_v / matched
                left = 1.0 / matched
    return left


@njit(cache=True, nogil=True)
def _assign(crowd, b, detections, density, nothing, owner, taken):  # type: ignore[no-untyped-def]
    """Assign detections to tracks, the most probable pair first. `owner` and `taken` are -1 without a partner."""
    tracks, rows = density.shape
    while True:
        best, track, row = 1.0, -1, -1
        for m in range(tracks):
            if taken[m] >= 0 or crowd.weight[b, m] <= 0.0:
                continue
            for j in range(rows):
                if owner[j] < 0 and detections[j, 0] > 0.5:
                    ratio = density[m, j] / nothing[j]
                    if ratio > best:
                        best, track, row = ratio, m, j
        if track < 0:
            return
        owner[row], taken[track] = track, row


@njit(cache=True, nogil=True)
def follow_crowd(  # type: ignore[no-untyped-def]
    detections, fresh, elapsed, jitter, crowd, guesses, memory, rules, features, visible
):
    """Update every run with its new frame.

    Args:
        detections: Detections. Shape (B, M, 8).
        fresh: Mask of the runs with a new frame. Shape (B,).
        elapsed: Time since the last frame. Shape (B,), s.
        jitter: Variance of the camera's predicted motion along each axis. Shape (B,), px^2.
        crowd: Tracks of all people, `People`; changed.
        guesses: Hypotheses of the person, `People`; changed.
        memory: A `CrowdMemory`; changed.
        rules: A `CrowdRules`.
        features: Output: position of the person. Shape (B, 2), px.
        visible: Output: True where the most probable hypothesis has a detection of its own. Shape (B,).
    """
    for b in range(detections.shape[0]):
        features[b] = memory.place[b]
        if fresh[b]:
            _follow_run(b, detections[b], elapsed[b], jitter[b], crowd, guesses, memory, rules, features, visible)


@njit(cache=True, nogil=True)
def _follow_run(b, detections, dt, jitter, crowd, guesses, memory, rules, features, visible):  # type: ignore[no-untyped-def]
    rows, tracks, count = detections.shape[0], crowd.weight.shape[1], guesses.weight.shape[1]
    width, size = memory.width[b], rules.image_width
    area = size * size
    noise = rules.position_noise**2
    _move(crowd, b, dt, rules.crowd_acceleration, width, rules)
    _move(guesses, b, dt, rules.acceleration, width, rules)
    if jitter > 0.0:
        shift = np.zeros(2)
        left = _register(crowd, b, detections, jitter, rules, shift)
        for people in (crowd, guesses):
            for axis in range(2):
                people.mean[b, :, axis] += shift[axis]
            people.spread[b, :, 0] += left
    _turned(guesses, b, dt, width, rules)
    stay = np.exp(-rules.leave_rate * dt)

    # What explains a detection without a track: clutter, or a person who appears.
    similar, others = 0.5, 5.0
    for m in range(tracks):
        if crowd.weight[b, m] > 0.5:
            off = 0.0
            for channel in range(3):
                off += (crowd.color[b, m, channel] - memory.color[b, channel]) ** 2
            others += 1.0
            if off < 4.0 * 3.0 * rules.color_noise**2:
                similar += 1.0
    alike = similar / others
    # Everybody in the first frame is new.
    appearing = rules.births if memory.next_label[b] > 1 else rules.first_people
    clutter, birth = np.zeros(rows), np.zeros(rows)
    for j in range(rows):
        if detections[j, 0] < 0.5:
            continue
        clutter[j] = memory.clutter[b] / area / 255.0**3 / 1.44
        same = _color_density(detections[j], memory.color[b], memory.color_variance[b], rules)
        fits = 0.85 * _size_density(detections[j], width, width, rules.size_noise) + 0.15 * _size_density(
            detections[j], 2.4 * width, 2.4 * width, rules.size_noise
        )
        birth[j] = appearing / area * ((1.0 - alike) / 255.0**3 + alike * same) * fits

    # Tracks of all people.
    merged, density = np.zeros(tracks), np.zeros((tracks, rows))
    chance, missing, clear = np.zeros(tracks), np.ones(tracks), np.ones(tracks)
    together = np.zeros((tracks, tracks))
    for m in range(tracks):
        if crowd.weight[b, m] <= 0.0:
            continue
        crowd.weight[b, m] *= stay
        cover = _covers(crowd.mean[b, m], crowd.spread[b, m], crowd.label[b, m], crowd, b, width, rules, merged)
        open_share = (1.0 - cover) * (1.0 - merged.max()) * _in_view(crowd.mean[b, m], crowd.spread[b, m], size)
        together[m] = merged * (1.0 - cover) * (1.0 - crowd.hidden[b, m]) * rules.detection
        clear[m] = rules.detection * open_share
        chance[m] = crowd.weight[b, m] * (1.0 - crowd.hidden[b, m]) * clear[m]
        missing[m] = 1.0 - (1.0 - crowd.hidden[b, m]) * clear[m]
        total = crowd.spread[b, m, 0] + noise
        for j in range(rows):
            if detections[j, 0] > 0.5:
                near = _place_density(detections[j], crowd.mean[b, m, 0], crowd.mean[b, m, 1], total)
                density[m, j] = (
                    chance[m]
                    * near
                    * _color_density(detections[j], crowd.color[b, m], crowd.color_variance[b, m], rules)
                    * _size_density(detections[j], crowd.width[b, m], crowd.width[b, m], rules.size_noise)
                )
    owner, taken = np.full(rows, -1), np.full(tracks, -1)
    _assign(crowd, b, detections, density, clutter + birth, owner, taken)
    explained = np.zeros(rows)
    for j in range(rows):
        for m in range(tracks):
            explained[j] += density[m, j]
    # Two tracks may share a detection; `shared` is what a track has in such pairs.
    shared, partner = np.zeros((tracks, rows)), np.full((tracks, rows), -1)
    for m in range(tracks):
        for k in range(m):
            chance_both = min(crowd.weight[b, k] * together[m, k], crowd.weight[b, m] * together[k, m])
            if chance_both < 0.01:
                continue
            for j in range(rows):
                if detections[j, 0] < 0.5:
                    continue
                value = chance_both * _pair_density(
                    detections[j], crowd, m, crowd, k, crowd.color[b, m], crowd.color_variance[b, m], b, width, rules
                )
                explained[j] += value
                shared[m, j] += value
                shared[k, j] += value
                if value > max(density[m, j], density[k, j]):
                    partner[m, j], partner[k, j] = k, m
    # Hypotheses of the person: each one splits into a miss and one for every detection that it may have caused.
    limit = 16 * count
    part_of, part_row, part_merged = np.empty(limit, np.int64), np.empty(limit, np.int64), np.empty(limit, np.int64)
    part_weight, part_hidden = np.empty(limit), np.empty(limit)
    # Likelihood of the frame if the track that a hypothesis takes for the person is one of the others. Motion counts
    # the same for both, so that only the color decides.
    evidence, held, own_track = np.zeros(tracks), np.zeros(tracks), np.full(count, -1)
    parts = 0
    leak = 1.0 - np.exp(-rules.lose_rate * dt)
    gone = memory.lost[b]
    for i in range(count):
        w = guesses.weight[b, i]
        if w <= 0.0:
            continue
        own = -1
        for m in range(tracks):
            if crowd.weight[b, m] > 0.0 and crowd.label[b, m] == guesses.label[b, i]:
                own = m
        own_track[i] = own
        own_width = width
        if own >= 0 and crowd.width[b, own] > 1.6 * width:
            own_width = crowd.width[b, own]
        mean, spread, h = guesses.mean[b, i], guesses.spread[b, i], guesses.hidden[b, i]
        view = _in_view(mean, spread, size)
        cover = _covers(mean, spread, guesses.label[b, i], crowd, b, width, rules, merged)
        alone = (1.0 - cover) * (1.0 - merged.max()) * rules.detection * view
        gone += leak * h * w
        w *= 1.0 - leak * h
        if parts < limit:
            missed = h + (1.0 - h) * (1.0 - alone)
            if own >= 0:
                held[own] += w
                evidence[own] += w * (1.0 - crowd.weight[b, own] * (1.0 - missed))
            part_of[parts], part_row[parts], part_merged[parts] = i, -1, -1
            part_weight[parts], part_hidden[parts] = w * missed, h / max(missed, 1e-12)
            parts += 1
        total = spread[0] + noise
        for j in range(rows):
            if detections[j, 0] < 0.5:
                continue
            rest = clutter[j] + birth[j] + explained[j]
            if own >= 0:
                rest -= density[own, j] + shared[own, j]
            rest = max(rest, clutter[j] + birth[j])
            d = (detections[j, 1] - mean[0]) ** 2 + (detections[j, 2] - mean[1]) ** 2
            if d < 20.0 * total and parts < limit:
                value = w * (1.0 - h) * alone * _place_density(detections[j], mean[0], mean[1], total) / rest
                if own >= 0:
                    evidence[own] += (
                        crowd.weight[b, own]
                        * value
                        * _color_density(detections[j], crowd.color[b, own], crowd.color_variance[b, own], rules)
                        * _size_density(detections[j], own_width, own_width, rules.size_noise)
                    )
                value *= _color_density(
                    detections[j], guesses.color[b, i], guesses.color_variance[b, i], rules
                ) * _size_density(detections[j], width, width, rules.size_noise)
                if value > 1e-9:
                    part_of[parts], part_row[parts], part_merged[parts] = i, j, -1
                    part_weight[parts], part_hidden[parts] = value, 0.0
                    parts += 1
            for m in range(tracks):
                # A shared detection says that a second person is there, but only a track says which one.
                if merged[m] < 0.02 or own < 0:
                    continue
                if parts >= limit:
                    continue
                chance_both = w * (1.0 - h) * merged[m] * (1.0 - cover) * view * rules.detection / rest
                evidence[own] += (
                    crowd.weight[b, own]
                    * chance_both
                    * _pair_density(
                        detections[j], guesses, i, crowd, m, crowd.color[b, own], crowd.color_variance[b, own], b,
                        width, rules,
                    )
                )  # fmt: skip
                value = chance_both * _pair_density(
                    detections[j], guesses, i, crowd, m, guesses.color[b, i], guesses.color_variance[b, i], b, width,
                    rules,
                )  # fmt: skip
                if value > 1e-9:
                    part_of[parts], part_row[parts], part_merged[parts] = i, j, m
                    part_weight[parts], part_hidden[parts] = value, 0.0
                    parts += 1
    for p in range(parts):
        own = own_track[part_of[p]]
        if own >= 0:
            part_weight[p] *= held[own] / max(evidence[own], 1e-300)
    # The person may be anywhere: a detection of that color may be theirs.
    for j in range(rows):
        if detections[j, 0] > 0.5 and gone > 1e-6 and parts < limit:
            value = (
                gone
                * 0.5
                * rules.detection
                / (2.0 * area)
                * _color_density(detections[j], memory.color[b], memory.color_variance[b], rules)
                * _size_density(detections[j], width, width, rules.size_noise)
                / (clutter[j] + birth[j] + explained[j])
            )
            if value > 1e-7:
                part_of[parts], part_row[parts], part_merged[parts] = -1, j, -1
                part_weight[parts], part_hidden[parts] = value, 0.0
                parts += 1
    gone *= 1.0 - 0.5 * rules.detection
    total_weight = gone
    for p in range(parts):
        total_weight += part_weight[p]
    memory.lost[b] = gone / total_weight

    # Update of the tracks, and new ones.
    left, joined = np.zeros(tracks), np.full(tracks, -1)
    for j in range(rows):
        if owner[j] >= 0:
            m = partner[owner[j], j]
            if m >= 0 and taken[m] < 0:
                taken[m], joined[m], joined[owner[j]] = j, owner[j], m
    for p in range(parts):
        i = part_of[p]
        if i >= 0 and part_row[p] >= 0 and part_merged[p] < 0:
            for m in range(tracks):
                if crowd.weight[b, m] > 0.0 and crowd.label[b, m] == guesses.label[b, i] and taken[m] != part_row[p]:
                    left[m] += part_weight[p] / total_weight
    for m in range(tracks):
        if crowd.weight[b, m] <= 0.0:
            continue
        if joined[m] >= 0:
            crowd.hidden[b, m] = 0.0
            crowd.weight[b, m] = 0.999
            if joined[m] > m:
                # Both are updated with the other one as it was predicted.
                k = joined[m]
                mean, color = crowd.mean[b, m].copy(), crowd.color[b, m].copy()
                variance, color_variance = crowd.spread[b, m, 0], crowd.color_variance[b, m]
                d = detections[taken[m]]
                _correct_pair(
                    crowd, b, m, crowd.mean[b, k], crowd.spread[b, k, 0], crowd.color[b, k], crowd.color_variance[b, k],
                    d, rules,
                )  # fmt: skip
                _correct_pair(crowd, b, k, mean, variance, color, color_variance, d, rules)
        elif taken[m] >= 0:
            d = detections[taken[m]]
            _correct(crowd, b, m, d[1], d[2], noise, d[5:8], rules.color_noise**2)
            crowd.width[b, m] *= np.exp(0.1 * np.log(max(np.sqrt(d[3] * d[4]), 1.0) / crowd.width[b, m]))
            crowd.hidden[b, m] = 0.0
            crowd.weight[b, m] = 0.999
        else:
            r = crowd.weight[b, m]
            crowd.weight[b, m] = r * missing[m] / (1.0 - r + r * missing[m]) * (1.0 - left[m])
            crowd.hidden[b, m] /= max(missing[m], 1e-12)
            if crowd.weight[b, m] < 0.005:
                crowd.weight[b, m] = 0.0
    second = np.full(rows, -2)
    for j in range(rows):
        if owner[j] >= 0 and joined[owner[j]] >= 0:
            second[j] = crowd.label[b, joined[owner[j]]]
    unexplained, born = 0.0, np.full(rows, -1)
    for j in range(rows):
        if detections[j, 0] < 0.5 or owner[j] >= 0:
            continue
        unexplained += 1.0
        slot = 0
        for m in range(tracks):
            if crowd.weight[b, m] < crowd.weight[b, slot]:
                slot = m
        # Even an unlikely person is tracked for a while, so that a hypothesis there competes with a track.
        r = max(birth[j] / (birth[j] + clutter[j]), 0.05)
        if crowd.weight[b, slot] >= r:
            continue
        d = detections[j]
        crowd.mean[b, slot, 0], crowd.mean[b, slot, 1] = d[1], d[2]
        crowd.mean[b, slot, 2:] = 0.0
        crowd.spread[b, slot, 0], crowd.spread[b, slot, 1] = noise, 0.0
        crowd.spread[b, slot, 2] = (rules.speed * width) ** 2
        crowd.color[b, slot], crowd.color_variance[b, slot] = d[5:8], rules.color_noise**2
        crowd.width[b, slot] = max(np.sqrt(d[3] * d[4]), 1.0)
        crowd.hidden[b, slot], crowd.weight[b, slot] = 0.0, r
        crowd.label[b, slot] = memory.next_label[b]
        born[j] = memory.next_label[b]
        memory.next_label[b] += 1
    memory.clutter[b] += rules.clutter_rate * (unexplained - memory.clutter[b])
    _renew(
        b, detections, crowd, guesses, memory, rules, owner, second, born,
        (part_of[:parts], part_row[:parts], part_merged[:parts], part_weight[:parts] / total_weight,
         part_hidden[:parts]),
        features, visible,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _renew(  # type: ignore[no-untyped-def]
    b, detections, crowd, guesses, memory, rules, owner, second, born, parts, features, visible
):
    """Replace the hypotheses of a run by the most probable parts, merged where they are alike, and decide."""
    part_of, part_row, part_merged, part_weight, part_hidden = parts
    count, noise, width = guesses.weight.shape[1], rules.position_noise**2, memory.width[b]
    order = np.argsort(-part_weight)
    one = slice(b, b + 1)
    old = People(
        guesses.mean[one].copy(), guesses.spread[one].copy(), guesses.color[one].copy(),
        guesses.color_variance[one].copy(), guesses.width[one].copy(), guesses.hidden[one].copy(),
        guesses.weight[one].copy(), guesses.label[one].copy(),
    )  # fmt: skip
    guesses.weight[b] = 0.0
    cause = np.full(count, -1)
    used = 0
    keep = count - count // 4  # The rest is room for turns.
    for p in order:
        if part_weight[p] < 1e-6 or used >= keep:
            break
        i, j, m = part_of[p], part_row[p], part_merged[p]
        k = used
        if i >= 0:
            guesses.mean[b, k], guesses.spread[b, k] = old.mean[0, i], old.spread[0, i]
            guesses.color[b, k], guesses.color_variance[b, k] = old.color[0, i], old.color_variance[0, i]
            guesses.label[b, k] = old.label[0, i]
        else:
            guesses.mean[b, k, 0], guesses.mean[b, k, 1] = detections[j, 1], detections[j, 2]
            guesses.mean[b, k, 2:] = 0.0
            guesses.spread[b, k, 0], guesses.spread[b, k, 1] = 1e4 * noise, 0.0
            guesses.spread[b, k, 2] = (rules.speed * width) ** 2
            guesses.color[b, k], guesses.color_variance[b, k] = memory.color[b], memory.color_variance[b]
            guesses.label[b, k] = -1
        guesses.width[b, k] = width
        guesses.hidden[b, k] = part_hidden[p]
        guesses.weight[b, k] = part_weight[p]
        if j >= 0 and m < 0:
            d = detections[j]
            _correct(guesses, b, k, d[1], d[2], noise, d[5:8], rules.color_noise**2)
            # Of two tracks that share the detection, a hypothesis keeps its own one.
            if owner[j] >= 0 and guesses.label[b, k] != second[j]:
                guesses.label[b, k] = crowd.label[b, owner[j]]
            elif born[j] >= 0:
                guesses.label[b, k] = born[j]
        elif j >= 0:
            _correct_pair(
                guesses, b, k, crowd.mean[b, m], crowd.spread[b, m, 0], crowd.color[b, m], crowd.color_variance[b, m],
                detections[j], rules,
            )  # fmt: skip
        merged = False
        for other in range(used):
            if guesses.label[b, other] != guesses.label[b, k] or cause[other] != (j if m < 0 else -1):
                continue
            space, pace = 0.0, 0.0
            for axis in range(2):
                space += (guesses.mean[b, other, axis] - guesses.mean[b, k, axis]) ** 2
                pace += (guesses.mean[b, other, 2 + axis] - guesses.mean[b, k, 2 + axis]) ** 2
            reach = guesses.spread[b, other, 0] + guesses.spread[b, k, 0]
            if space < reach and pace < 0.5 * (guesses.spread[b, other, 2] + guesses.spread[b, k, 2]):
                _join(guesses, b, other, k)
                merged = True
                break
        if merged:
            guesses.weight[b, k] = 0.0
            continue
        cause[k] = j if m < 0 else -1
        used += 1
    _choose(b, detections, cause, used, guesses, memory, features, visible)


@njit(cache=True, nogil=True)
def _join(guesses, b, k, i):  # type: ignore[no-untyped-def]
    """Merge hypothesis i into k: the mean and covariance of both (one axis stands for both)."""
    total = guesses.weight[b, k] + guesses.weight[b, i]
    share = guesses.weight[b, i] / total
    du, dv = guesses.mean[b, i, 0] - guesses.mean[b, k, 0], guesses.mean[b, i, 1] - guesses.mean[b, k, 1]
    pu, pv = guesses.mean[b, i, 2] - guesses.mean[b, k, 2], guesses.mean[b, i, 3] - guesses.mean[b, k, 3]
    mix = share * (1.0 - share)
    for entry, off in enumerate((du * du + dv * dv, du * pu + dv * pv, pu * pu + pv * pv)):
        a, c = guesses.spread[b, k, entry], guesses.spread[b, i, entry]
        guesses.spread[b, k, entry] = a + share * (c - a) + mix * 0.5 * off
    for axis in range(4):
        guesses.mean[b, k, axis] += share * (guesses.mean[b, i, axis] - guesses.mean[b, k, axis])
    for channel in range(3):
        guesses.color[b, k, channel] += share * (guesses.color[b, i, channel] - guesses.color[b, k, channel])
    guesses.color_variance[b, k] += share * (guesses.color_variance[b, i] - guesses.color_variance[b, k])
    guesses.hidden[b, k] += share * (guesses.hidden[b, i] - guesses.hidden[b, k])
    guesses.weight[b, k] = total


@njit(cache=True, nogil=True)
def _choose(b, detections, cause, used, guesses, memory, features, visible):  # type: ignore[no-untyped-def]
    """Report the hypothesis with the most probability within a person's width."""
    memory.unseen[b] += 1
    visible[b] = False
    if used == 0:
        # Nothing is left: the person may be anywhere, and the last place stays.
        features[b] = memory.place[b]
        memory.confidence[b] = 0.0
        return
    best, most = 0, -1.0
    width = memory.width[b]
    for i in range(used):
        support = 0.0
        for k in range(used):
            du = guesses.mean[b, i, 0] - guesses.mean[b, k, 0]
            dv = guesses.mean[b, i, 1] - guesses.mean[b, k, 1]
            if du * du + dv * dv < width * width:
                support += guesses.weight[b, k]
        if support > most * (1.0 + 1e-9):
            best, most = i, support
    heaviest = best
    for i in range(used):
        du = guesses.mean[b, i, 0] - guesses.mean[b, best, 0]
        dv = guesses.mean[b, i, 1] - guesses.mean[b, best, 1]
        if du * du + dv * dv < width * width and guesses.weight[b, i] > guesses.weight[b, heaviest]:
            heaviest = i
    best = heaviest
    memory.confidence[b] = most
    memory.place[b] = guesses.mean[b, best, :2]
    memory.motion[b] = guesses.mean[b, best, 2:]
    features[b] = memory.place[b]
    if cause[best] >= 0:
        features[b] = detections[cause[best], 1:3]
        visible[b] = True
        memory.unseen[b] = 0
        memory.color[b] = guesses.color[b, best]
        memory.color_variance[b] = guesses.color_variance[b, best]
