"""Tracks of all people of a crowd for `CrowdFollower`, compiled: what explains each detection, and their update."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.follow.crowd_people import (
    color_density,
    correct,
    correct_pair,
    covers,
    in_view,
    pair_density,
    place_density,
    size_density,
)
from servotrack.estimators.types import Array, Labels


class Explained(NamedTuple):
    """Causes of the detections of one frame; M detections, T tracks.

    Attributes:
        unknown: Intensity of clutter at each detection. Shape (M,).
        birth: Intensity of people who appear. Shape (M,).
        density: Intensity of each track. Shape (T, M).
        shared: Intensity of a track together with others. Shape (T, M).
        explained: Sum over tracks and pairs. Shape (M,).
        missing: Likelihood that nothing is detected of a track, if its person exists. Shape (T,).
        owner: Track of each detection, -1 for none. Shape (M,).
        taken: Detection of each track, -1 for none. Shape (T,).
        partner: Track that shares a detection with a track, if that is more probable, else -1. Shape (T, M).
    """

    unknown: Array
    birth: Array
    density: Array
    shared: Array
    explained: Array
    missing: Array
    owner: Labels
    taken: Labels
    partner: Labels


@njit(cache=True, nogil=True)
def register_image(crowd, b, detections, jitter, rules, shift):  # type: ignore[no-untyped-def]
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
def _unexplained(b, detections, crowd, memory, rules):  # type: ignore[no-untyped-def]
    """Intensity of what explains a detection without a track: clutter, or a person who appears. Shapes (M,)."""
    rows, tracks = detections.shape[0], crowd.weight.shape[1]
    width, area = memory.width[b], rules.image_width * rules.image_width
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
        same = color_density(detections[j], memory.color[b], memory.color_variance[b], rules)
        fits = 0.85 * size_density(detections[j], width, width, rules.size_noise) + 0.15 * size_density(
            detections[j], 2.4 * width, 2.4 * width, rules.size_noise
        )
        birth[j] = appearing / area * ((1.0 - alike) / 255.0**3 + alike * same) * fits
    return clutter, birth


@njit(cache=True, nogil=True)
def weigh_tracks(b, detections, dt, crowd, memory, rules):  # type: ignore[no-untyped-def]
    """Causes of the detections of run b, an `Explained`; the tracks, predicted, lose those who leave in `dt` s."""
    rows, tracks = detections.shape[0], crowd.weight.shape[1]
    width, size, noise = memory.width[b], rules.image_width, rules.position_noise**2
    stay = np.exp(-rules.leave_rate * dt)
    clutter, birth = _unexplained(b, detections, crowd, memory, rules)
    merged, density = np.zeros(tracks), np.zeros((tracks, rows))
    chance, missing, clear = np.zeros(tracks), np.ones(tracks), np.ones(tracks)
    together = np.zeros((tracks, tracks))
    for m in range(tracks):
        if crowd.weight[b, m] <= 0.0:
            continue
        crowd.weight[b, m] *= stay
        cover = covers(crowd.mean[b, m], crowd.spread[b, m], crowd.label[b, m], crowd, b, width, rules, merged)
        open_share = (1.0 - cover) * (1.0 - merged.max()) * in_view(crowd.mean[b, m], crowd.spread[b, m], size)
        together[m] = merged * (1.0 - cover) * (1.0 - crowd.hidden[b, m]) * rules.detection
        clear[m] = rules.detection * open_share
        chance[m] = crowd.weight[b, m] * (1.0 - crowd.hidden[b, m]) * clear[m]
        missing[m] = 1.0 - (1.0 - crowd.hidden[b, m]) * clear[m]
        total = crowd.spread[b, m, 0] + noise
        for j in range(rows):
            if detections[j, 0] > 0.5:
                near = place_density(detections[j], crowd.mean[b, m, 0], crowd.mean[b, m, 1], total)
                density[m, j] = (
                    chance[m]
                    * near
                    * color_density(detections[j], crowd.color[b, m], crowd.color_variance[b, m], rules)
                    * size_density(detections[j], crowd.width[b, m], crowd.width[b, m], rules.size_noise)
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
                value = chance_both * pair_density(
                    detections[j], crowd, m, crowd, k, crowd.color[b, m], crowd.color_variance[b, m], b, width, rules
                )
                explained[j] += value
                shared[m, j] += value
                shared[k, j] += value
                if value > max(density[m, j], density[k, j]):
                    partner[m, j], partner[k, j] = k, m
    return Explained(clutter, birth, density, shared, explained, missing, owner, taken, partner)


@njit(cache=True, nogil=True)
def update_tracks(b, detections, crowd, guesses, rules, found, parts):  # type: ignore[no-untyped-def]
    """Update the tracks of run b with their detections.

    Args:
        b: Run.
        detections: Detections. Shape (M, 8).
        crowd: Tracks; changed.
        guesses: Hypotheses of the person, predicted.
        rules: Parameters.
        found: The `Explained` of the frame; detections that two tracks share are given to both.
        parts: `Parts` of the hypotheses.

    Returns:
        Label of the second track of each detection, -2 for none. Shape (M,).
    """
    rows, tracks, noise = detections.shape[0], crowd.weight.shape[1], rules.position_noise**2
    owner, taken, partner, missing = found.owner, found.taken, found.partner, found.missing
    left, joined = np.zeros(tracks), np.full(tracks, -1)
    for j in range(rows):
        if owner[j] >= 0:
            m = partner[owner[j], j]
            if m >= 0 and taken[m] < 0:
                taken[m], joined[m], joined[owner[j]] = j, owner[j], m
    for p in range(parts.weight.shape[0]):
        i = parts.source[p]
        if i >= 0 and parts.row[p] >= 0 and parts.merged[p] < 0:
            for m in range(tracks):
                if crowd.weight[b, m] > 0.0 and crowd.label[b, m] == guesses.label[b, i] and taken[m] != parts.row[p]:
                    left[m] += parts.weight[p]
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
                correct_pair(
                    crowd, b, m, crowd.mean[b, k], crowd.spread[b, k, 0], crowd.color[b, k], crowd.color_variance[b, k],
                    d, rules,
                )  # fmt: skip
                correct_pair(crowd, b, k, mean, variance, color, color_variance, d, rules)
        elif taken[m] >= 0:
            d = detections[taken[m]]
            correct(crowd, b, m, d[1], d[2], noise, d[5:8], rules.color_noise**2)
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
    return second


@njit(cache=True, nogil=True)
def start_tracks(b, detections, crowd, memory, rules, found):  # type: ignore[no-untyped-def]
    """Start tracks at detections without one, in place of the weakest; labels of the new ones, -1 for none (M,)."""
    rows, tracks, noise = detections.shape[0], crowd.weight.shape[1], rules.position_noise**2
    width, owner, clutter, birth = memory.width[b], found.owner, found.unknown, found.birth
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
    return born
