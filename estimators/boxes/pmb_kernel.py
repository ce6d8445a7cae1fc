"""Compiled kernels of the Poisson multi-Bernoulli filter of boxes: one Gaussian per person, noise in body heights."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.boxes.confidence import score_log_odds, trust
from servotrack.estimators.boxes.kalman import center_boxes
from servotrack.estimators.boxes.overlap import covered_boxes
from servotrack.estimators.boxes.person import person_probabilities
from servotrack.estimators.boxes.perspective import height_errors, learn_heights
from servotrack.estimators.compilation import njit
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.rfs.association import association_marginals
from servotrack.estimators.rfs.sets import HELD, REPORTED


@njit(cache=True, nogil=True)
def overlap_share(mean, i, j):  # type: ignore[no-untyped-def]
    """Share of track i's box that track j's box covers."""
    share = 1.0
    for axis in range(2):
        a, b = mean[i, 2 * axis], mean[j, 2 * axis]
        wide, other = mean[i, 4 + axis], mean[j, 4 + axis]
        common = min(a + wide / 2, b + other / 2) - max(a - wide / 2, b - other / 2)
        share *= max(common, 0.0) / wide
    return share


@njit(cache=True, nogil=True)
def visible_shares(mean, existence, frame_width, frame_height):  # type: ignore[no-untyped-def]
    """Share of each track that no nearer person hides, and share inside the frame (1 if its size is unknown).

    Of two people the one whose feet are lower in the image is nearer.
    """
    count = mean.shape[0]
    visible, inside = np.ones(count), np.ones(count)
    for i in range(count):
        foot = mean[i, 2] + mean[i, 5] / 2
        for j in range(count):
            if j != i and existence[j] >= 0.5 and mean[j, 2] + mean[j, 5] / 2 > foot:
                visible[i] = min(visible[i], 1.0 - existence[j] * overlap_share(mean, i, j))
        if frame_width > 0.0:
            for axis in range(2):
                end = frame_width if axis == 0 else frame_height
                center, size = mean[i, 2 * axis], mean[i, 4 + axis]
                inside[i] *= max(min(center + size / 2, end) - max(center - size / 2, 0.0), 0.0) / size
    return visible, inside


@njit(cache=True, nogil=True)
def region_share(boxes, areas, solid):  # type: ignore[no-untyped-def]
    """Share of the detections whose area is less than `solid` times that of their box: regions of the foreground."""
    count = 0
    for j in range(len(boxes)):
        count += areas[j] < solid * boxes[j, 2] * boxes[j, 3]
    return count / max(len(boxes), 1)


@njit(cache=True, nogil=True)
def remaining_existence(tracks, inside, velocity, fading, turning, established, revival):  # type: ignore[no-untyped-def]
    """Existence after the time between two frames, by the share of each track inside the frame.

    Args:
        tracks: Means (T, 6), existence (T,), numbers of detections (T,).
        inside: Share inside the frame. Shape (T,).
        velocity: Velocity of the camera. Shape (2,), px/s.
        fading: Probability that a person stays who is entirely inside.
        turning: Speed of the camera from which people outside the frame are expected back, heights/s.
        established: Number of detections from which `revival` applies.
        revival: Least existence of a lost person.

    Returns:
        Shape (T,).
    """
    mean, existence, seen = tracks
    out = np.empty(len(existence))
    speed = math.hypot(velocity[0], velocity[1])
    for i in range(len(out)):
        staying = 1.0 if speed > turning * mean[i, 5] else min(max(2.0 * inside[i], 1e-3), 1.0)
        out[i] = existence[i] * fading * staying
        if seen[i] >= established:
            out[i] = max(out[i], revival * staying)
    return out


@njit(cache=True, nogil=True)
def detection_odds(tracks, visible, detection, again, least_visible, clutter):  # type: ignore[no-untyped-def]
    """Probability of each track, if it exists, that it is detected, and log odds of "detected" against clutter.

    Args:
        tracks: Existence (T,), numbers of frames since the last detection (T,).
        visible: Visible shares. Shape (T,).
        detection: Detection probability of a person in full view.
        again: The same for one who was missed in the last frame.
        least_visible: Lower limit of the visible share.
        clutter: Log density of false and new detections.

    Returns:
        Both of shape (T,).
    """
    existence, missed = tracks
    detectable, odds = np.empty(len(existence)), np.empty(len(existence))
    for i in range(len(odds)):
        detectable[i] = (again if missed[i] > 0 else detection) * min(max(visible[i], least_visible), 1.0)
        odds[i] = math.log(existence[i] * detectable[i] / (1.0 - existence[i] * detectable[i])) - clutter
    return detectable, odds


@njit(cache=True, nogil=True)
def settled(tracks, partner, shares, detectable, chances, scores, dt):  # type: ignore[no-untyped-def]
    """Existence, numbers and readings of the tracks after the assignment of a frame.

    Args:
        tracks: Existence, frames and time since the last detection, numbers of detections, last readings and summed
            readings, shape (T,) each.
        partner: Detection of each track, -1 for none. Shape (T,).
        shares: Mask of the tracks that share a region. Shape (T,).
        detectable: Detection probabilities. Shape (T,).
        chances: Marginal probabilities that the track caused no detection, and that it caused one, shape (T,) each.
        scores: Readings of the detections. Shape (Z,).
        dt: Time since the last frame, s.

    Returns:
        The same as `tracks`.
    """
    before, frames, times, numbers, last, sums = tracks
    existence, missed, absent, seen = before.copy(), frames + 1, times + dt, numbers.copy()
    reading, readings = last.copy(), sums.copy()
    for i in range(len(existence)):
        if not shares[i]:
            r, p = before[i], detectable[i]
            existence[i] = min(chances[0][i] * r * (1.0 - p) / (1.0 - r * p) + chances[1][i], 1.0)
        if partner[i] >= 0:
            missed[i], absent[i] = 0, 0.0
            seen[i] += 1
            reading[i] = scores[partner[i]]
            readings[i] += reading[i]
    return existence, missed, absent, seen, reading, readings


@njit(cache=True, nogil=True)
def birth_chances(boxes, tracks, fresh, birth, overlap):  # type: ignore[no-untyped-def]
    """Probability that each detection belongs to something new that persists.

    Args:
        boxes: Left, top, width, height of the detections. Shape (Z, 4), px.
        tracks: Means (T, 6), existence (T,).
        fresh: Probability that no track explains the detection. Shape (Z,).
        birth: Probability that an unexplained detection belongs to something that persists.
        overlap: Exponent of the share of the box that no probable track covers.

    Returns:
        Shape (Z,).
    """
    mean, existence = tracks
    cover = covered_boxes(boxes, center_boxes(mean))
    out = np.empty(len(boxes))
    for j in range(len(boxes)):
        most = 0.0
        for i in range(len(mean)):
            if existence[i] >= REPORTED:
                most = max(most, cover[j, i])
        out[j] = birth * fresh[j] * max(1.0 - most, 0.0) ** overlap
    return out


@njit(cache=True, nogil=True)
def stated_existence(tracks, coast, confirm, established, held):  # type: ignore[no-untyped-def]
    """Probability of each track that it is a person, limited for those that are held.

    Args:
        tracks: Existence, probability of a person, time since the last detection, mask of shared regions, numbers of
            detections, shape (T,) each.
        coast: Time for which undetected people are reported, s.
        confirm: Number of detections from which a person is reported.
        established: Number of detections from which a person keeps the identity until the track ends.
        held: Largest existence of a held identity.

    Returns:
        Shape (T,).
    """
    existence, person, absent, shares, seen = tracks
    out = existence * person
    for i in range(len(out)):
        if not ((absent[i] <= coast or shares[i]) and seen[i] >= confirm):
            out[i] = min(max(out[i], HELD if seen[i] >= established else 0.0), held)
    return out


@njit(cache=True, nogil=True)
def pair_log_weights(mean, variance, boxes, noise, gate, track, detection, share, scale):  # type: ignore[no-untyped-def]
    """Log weight of every pair: log density of the detection under the track's prediction, plus a summand of either.

    Densities are in heights^-4 and without the constant of 2 pi: a Gaussian, or a mixture with a wider one for regions
    that are cut or joined.

    Args:
        mean: Predicted means. Shape (T, 6).
        variance: Predicted variances. Shape (T, 8).
        boxes: Left, top, width, height. Shape (Z, 4), px.
        noise: Standard deviations of a measured center column, center row, width and height, heights. Shape (4,).
        gate: Largest squared Mahalanobis distance, in the wider component if there is one; for other pairs the log
            weight is -inf.
        track: Summand of each track. Shape (T,).
        detection: Summand of each detection. Shape (Z,).
        share: Share of the wider component; 0 for a Gaussian.
        scale: Factor of its standard deviations.

    Returns:
        Shape (T, Z).
    """
    farthest, own, wide = gate, 0.0, -np.inf
    if share > 0.0:
        farthest, own, wide = gate * scale**2, math.log(1.0 - share), math.log(share) - 4.0 * math.log(scale)
    out = np.full((mean.shape[0], boxes.shape[0]), -np.inf)
    S = np.empty(4)
    for i in range(mean.shape[0]):
        height, spread = mean[i, 5], 0.0
        for k in range(4):
            S[k] = (noise[k] * height) ** 2 + (variance[i, 3 * k] if k < 2 else variance[i, 4 + k])
            spread += 0.5 * math.log(S[k] / height**2)
        for j in range(boxes.shape[0]):
            total = 0.0
            for k in range(2):
                total += (boxes[j, k] + boxes[j, 2 + k] / 2.0 - mean[i, 2 * k]) ** 2 / S[k]
                total += (boxes[j, 2 + k] - mean[i, 4 + k]) ** 2 / S[2 + k]
            if total > farthest:
                continue
            density = own - 0.5 * total
            if share > 0.0:
                density = np.logaddexp(density, wide - 0.5 * total / scale**2)
            out[i, j] = track[i] + detection[j] - spread + density
    return out


@njit(cache=True, nogil=True)
def associate(weight):  # type: ignore[no-untyped-def]
    """Marginal probabilities and the best assignment of tracks to detections.

    Args:
        weight: Weight of "track i caused detection j", divided by that of "i is missed and j is false or new". Shape
            (T, Z).

    Returns:
        missed (T,): probability that a track caused no detection; assigned (T,): probability that it caused one; fresh
        (Z,): probability that no track caused the detection; partner (T,): detection in the best assignment, -1 for
        none.
    """
    tracks, detections = weight.shape
    pairs = 0
    for i in range(tracks):
        for j in range(detections):
            pairs += weight[i, j] > 0.0
    track, to, psi = np.empty(pairs, np.int64), np.empty(pairs, np.int64), np.empty(pairs)
    cost = np.zeros((tracks, detections + tracks))
    pairs = 0
    for i in range(tracks):
        for j in range(detections):
            cost[i, j] = 1e6
            if weight[i, j] > 0.0:
                track[pairs], to[pairs], psi[pairs] = i, j, weight[i, j]
                cost[i, j] = -math.log(weight[i, j])
                pairs += 1
    missed, share, fresh = association_marginals(track, to, psi, tracks, detections)
    assigned = np.zeros(tracks)
    for p in range(pairs):
        assigned[track[p]] += share[p]
    partner = assign(cost, tracks, detections + tracks)
    for i in range(tracks):
        if partner[i] >= detections:
            partner[i] = -1
    return missed, assigned, fresh, partner


@njit(cache=True, nogil=True)
def judge_tracks(tracks, known, found, confidence, heights, dt, odds, scores, rules):  # type: ignore[no-untyped-def]
    """Probabilities that tracks with a detection are people, by scores and heights; learn the heights.

    Args:
        tracks: Means (T, 6), numbers of detections (T,), last readings (T,), summed readings (T,).
        known: Evidence (T, 3) and probabilities (T,) so far.
        found: Indices of the tracks with a detection. Shape (k,).
        confidence: State of `score_log_odds`.
        heights: State of `height_errors`.
        dt: Time since the last frame, s.
        odds: A `PersonOdds`.
        scores: A `ScoreRules`.
        rules: A `HeightRules`.

    Returns:
        New evidence (T, 3), probabilities (T,) and state of the heights.
    """
    mean, seen, last, total = tracks
    evidence, person = known[0].copy(), known[1].copy()
    boxes = center_boxes(mean[found])
    error = height_errors(heights, boxes, rules)
    average = score_log_odds(confidence, total[found] / seen[found], scores)
    newest = score_log_odds(confidence, last[found], scores)
    # A detector whose scores say nothing does not look for people: its regions are of any height, also on people.
    rows = np.stack((average, newest, trust(confidence) * error), axis=1)
    chance = person_probabilities(odds, rows)
    evidence[found], person[found] = rows, chance
    return evidence, person, learn_heights(heights, boxes, error, chance, dt, rules)


@njit(cache=True, nogil=True)
def mix_appearances(appearance, own, partner, features, seen, least_rate):  # type: ignore[no-untyped-def]
    """Average the appearances of detections into those of tracks, in place: a mean first, then exponentially weighted.

    Args:
        appearance: Mean appearance vectors of unit length, or zero; changed. Shape (T, F).
        own: Mask of the tracks whose detection shows only them. Shape (T,).
        partner: Index of each track's detection. Shape (T,).
        features: Appearance vectors of the detections; zeros if unknown. Shape (Z, F).
        seen: Number of detections of each track so far. Shape (T,).
        least_rate: Smallest weight of a new frame.
    """
    for i in range(appearance.shape[0]):
        if not own[i]:
            continue
        new = features[partner[i]]
        known = 0.0
        for k in range(new.shape[0]):
            known += new[k] * new[k]
        if known == 0.0:
            continue
        rate = max(least_rate, 1.0 / (seen[i] + 1.0))
        length = 0.0
        for k in range(new.shape[0]):
            appearance[i, k] = (1.0 - rate) * appearance[i, k] + rate * new[k]
            length += appearance[i, k] * appearance[i, k]
        length = math.sqrt(length)
        for k in range(new.shape[0]):
            appearance[i, k] /= length
