"""Hypotheses of the followed person for `CrowdFollower`, compiled: their parts, their weights, and the decision."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.follow.crowd_people import (
    People,
    color_density,
    copy_person,
    correct,
    correct_pair,
    covers,
    in_view,
    pair_density,
    place_density,
    size_density,
)
from servotrack.estimators.types import Array, Labels


class Parts(NamedTuple):
    """Parts into which the hypotheses of one run split: a miss, and one for every detection that it may have caused.

    Attributes:
        source: Hypothesis, -1 for a person who may be anywhere. Shape (P,).
        row: Detection, -1 for a miss. Shape (P,).
        merged: Track that shares the detection, -1 for none. Shape (P,).
        weight: Probability. Shape (P,).
        hidden: Probability that something that is not tracked covers the person. Shape (P,).
    """

    source: Labels
    row: Labels
    merged: Labels
    weight: Array
    hidden: Array


@njit(cache=True, nogil=True)
def add_turns(guesses, b, dt, width, rules):  # type: ignore[no-untyped-def]
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
            copy_person(guesses, i, guesses, b, free)
            guesses.weight[b, free] = share * before[i]
            guesses.weight[b, i] -= share * before[i]
            guesses.mean[b, free, 2:] = 0.0
            guesses.spread[b, free, 1] = 0.0
            guesses.spread[b, free, 2] = (deviation * width) ** 2


@njit(cache=True, nogil=True)
def split_guesses(b, detections, dt, crowd, guesses, memory, rules, found):  # type: ignore[no-untyped-def]
    """Parts of the hypotheses of run b, weighed against all other causes of the detections; they change `memory.lost`.

    Args:
        b: Run.
        detections: Detections. Shape (M, 8).
        dt: Time since the last frame, s.
        crowd: Tracks, predicted.
        guesses: Hypotheses, predicted.
        memory: A `CrowdMemory`; changed.
        rules: Parameters.
        found: The `Explained` of the frame.

    Returns:
        A `Parts`.
    """
    rows, tracks, count = detections.shape[0], crowd.weight.shape[1], guesses.weight.shape[1]
    width, size, noise = memory.width[b], rules.image_width, rules.position_noise**2
    area, merged = size * size, np.zeros(tracks)
    clutter, birth, explained = found.unknown, found.birth, found.explained
    density, shared = found.density, found.shared
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
        view = in_view(mean, spread, size)
        cover = covers(mean, spread, guesses.label[b, i], crowd, b, width, rules, merged)
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
                value = w * (1.0 - h) * alone * place_density(detections[j], mean[0], mean[1], total) / rest
                if own >= 0:
                    evidence[own] += (
                        crowd.weight[b, own]
                        * value
                        * color_density(detections[j], crowd.color[b, own], crowd.color_variance[b, own], rules)
                        * size_density(detections[j], own_width, own_width, rules.size_noise)
                    )
                value *= color_density(
                    detections[j], guesses.color[b, i], guesses.color_variance[b, i], rules
                ) * size_density(detections[j], width, width, rules.size_noise)
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
                    * pair_density(
                        detections[j], guesses, i, crowd, m, crowd.color[b, own], crowd.color_variance[b, own], b,
                        width, rules,
                    )
                )  # fmt: skip
                value = chance_both * pair_density(
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
                * color_density(detections[j], memory.color[b], memory.color_variance[b], rules)
                * size_density(detections[j], width, width, rules.size_noise)
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
    return Parts(
        part_of[:parts],
        part_row[:parts],
        part_merged[:parts],
        part_weight[:parts] / total_weight,
        part_hidden[:parts],
    )


@njit(cache=True, nogil=True)
def renew_guesses(  # type: ignore[no-untyped-def]
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
            correct(guesses, b, k, d[1], d[2], noise, d[5:8], rules.color_noise**2)
            # Of two tracks that share the detection, a hypothesis keeps its own one.
            if owner[j] >= 0 and guesses.label[b, k] != second[j]:
                guesses.label[b, k] = crowd.label[b, owner[j]]
            elif born[j] >= 0:
                guesses.label[b, k] = born[j]
        elif j >= 0:
            correct_pair(
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
