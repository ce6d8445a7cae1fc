"""People who meet and part: who is who afterward is decided by their appearance before."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.boxes.overlap import covered_boxes
from servotrack.estimators.compilation import njit


class MeetingRules(NamedTuple):
    """Conditions under which two tracks that met exchange their identities.

    Attributes:
        overlap: Overlap of two tracks, as a share of the smaller box, from which their people meet. What counts is
            their appearance before.
        parted: Largest overlap of their own detections, as a share of the smaller box, with which they have parted.
        margin: Excess of the similarities of exchanged identities over those of kept ones from which they are
            exchanged, or the reverse from which they are kept. Raising it waits for clearer pictures.
        patience: Time after which people who look alike keep the identities that motion gave them, s.
    """

    overlap: float = 0.3
    parted: float = 0.05
    margin: float = 0.2
    patience: float = 1.0


@njit(cache=True, nogil=True)
def meet(tracks, known, boxes, partner, detections, features, dt, rules):  # type: ignore[no-untyped-def]
    """Note who meets, and give people who part their identities by their appearance; changes the arrays of `tracks`.

    Args:
        tracks: Identities (T,), the identity that each one met, 0 for none (T,), time since they parted (T,) s, mean
            appearance vectors (T, F) and those before the meeting (T, F).
        known: Mask of the tracks of people. Shape (T,).
        boxes: Boxes of the tracks. Shape (T, 4), px.
        partner: Detection of each track alone, -1 for none. Shape (T,).
        detections: Boxes of the detections. Shape (Z, 4), px.
        features: Appearance vectors of the detections. Shape (Z, F).
        dt: Time since the last frame, s.
        rules: A `MeetingRules`.
    """
    label, rival, parted, appearance, before = tracks
    _note_meetings(tracks, known, covered_boxes(boxes, boxes), rules.overlap)
    for i in range(len(label)):
        if rival[i] == 0:
            continue
        j = _place_of(rival[i], label)
        if j < 0:
            rival[i] = 0
            continue
        a, b = partner[i], partner[j]
        if a < 0 or b < 0 or not (before[i].any() and before[j].any()):
            continue
        if not (features[a].any() and features[b].any()):
            continue
        pair = np.empty((2, 4))
        pair[0], pair[1] = detections[a], detections[b]
        share = covered_boxes(pair, pair)
        if max(share[0, 1], share[1, 0]) > rules.parted:
            continue
        gain = 0.0
        for k in range(features.shape[1]):
            gain += (before[i, k] - before[j, k]) * (features[b, k] - features[a, k])
        parted[i] += dt
        if abs(gain) < rules.margin and parted[i] < rules.patience:
            continue
        if gain >= rules.margin:
            label[i], label[j] = label[j], label[i]
            appearance[i], appearance[j] = before[j], before[i]
        rival[i] = rival[j] = 0


@njit(cache=True, nogil=True)
def _note_meetings(tracks, known, covered, overlap):  # type: ignore[no-untyped-def]
    """Note the person that each one overlaps most; a person met earlier stays until the two have parted."""
    label, rival, parted, appearance, before = tracks
    for i in range(len(label)):
        if not known[i]:
            continue
        largest = 0.0
        for j in range(len(label)):
            share = max(covered[i, j], covered[j, i])
            if j == i or not known[j] or share < overlap:
                continue
            if rival[i] == label[j]:
                parted[i] = 0.0
            elif share > largest and (rival[i] == 0 or largest > 0.0):
                largest = share
                rival[i], parted[i] = label[j], 0.0
                before[i] = appearance[i]


@njit(cache=True, nogil=True)
def _place_of(wanted, label):  # type: ignore[no-untyped-def]
    for k in range(len(label)):
        if label[k] == wanted:
            return k
    return -1
