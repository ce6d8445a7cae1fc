"""Extraction of the reported targets and their identities from a posterior.

Rules. `threshold`: every component or track above the threshold (Vo and Ma 2006, table III). `sum`: the rounded
expected number of targets. `map`: the most probable number of targets, by a Poisson distribution for an intensity and a
Poisson-binomial one for tracks.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.reduction import Candidates, Components, Limits, reduce_mixture
from servotrack.estimators.rfs.sets import HELD

Rule = Literal["threshold", "sum", "map"]
THRESHOLD, SUM, MAP = 0, 1, 2
"""Numbers of the rules for the compiled kernels."""
RULES: dict[str, int] = {"threshold": THRESHOLD, "sum": SUM, "map": MAP}

COPY_STRIDE = 1 << 40
"""Difference of the identities of successive targets that one component of weight above 1.5 stands for."""


@njit(cache=True, nogil=True)
def _seen(label, labels, count):  # type: ignore[no-untyped-def]
    """Return True if an identity is among the first `count`."""
    return np.any(labels[:count] == label)


@njit(cache=True, nogil=True)
def round_half_up(value):  # type: ignore[no-untyped-def]
    """Round to the nearest integer, halves upward."""
    return math.floor(value + 0.5)


@njit(cache=True, nogil=True)
def _write(extraction, b, row, existence, label, mean, cov, reported):  # type: ignore[no-untyped-def]
    """Write one identity of run b."""
    n = extraction.state.shape[2]
    extraction.existence[b, row] = existence
    extraction.label[b, row] = label
    extraction.reported[b, row] = reported
    for r in range(n):
        extraction.state[b, row, r] = mean[r]
        for c in range(n):
            extraction.covariance[b, row, r, c] = cov[r, c]


@njit(cache=True, nogil=True)
def extract_intensity(  # type: ignore[no-untyped-def]
    model, mixture, next_label, limits, rule, threshold, extraction, wanted_number
):
    """Extract targets from an intensity and give a new identity to those without one of their own.

    `wanted_number` is the number of targets of each run, shape (B,); -1: by the rule. Under a pairwise model the
    x-marginals of missed and detected components are merged first: both describe one target.
    """
    m, n = model.observation.shape
    batch = mixture.weight.shape[0]
    room = extraction.label.shape[1]
    for b in range(batch):
        count = mixture.number[b]
        weight, mean, cov = mixture.weight[b, :count].copy(), mixture.mean[b], mixture.covariance[b]
        head = np.arange(count)
        if model.pairwise:
            indices = np.arange(count)
            candidates = Candidates(weight, mean, indices, np.full(count, -1), indices + 1)
            merged = Components(
                np.empty(count),
                np.empty((count, n + m)),
                np.empty((count, n + m, n + m)),
                np.empty(count, np.bool_),
                np.empty(count, np.int64),
            )
            all_kept = Limits(0.0, limits.merge, count, 0.0, limits.candidates)
            count = reduce_mixture(False, n, candidates, indices, cov, cov, all_kept, count, merged, 0)
            weight, mean, cov = merged.weight[:count], merged.mean, merged.covariance
            head = merged.label[:count] - 1
        expected = 0.0
        for i in range(count):
            expected += weight[i]
        extraction.expected[b] = expected
        copies = np.zeros(count, np.int64)
        if rule == THRESHOLD and wanted_number[b] < 0:
            for i in range(count):
                if weight[i] > threshold:
                    copies[i] = max(1, round_half_up(weight[i]))
        else:
            wanted = wanted_number[b]
            if wanted < 0:
                wanted = round_half_up(expected) if rule == SUM else math.floor(expected)
            left = weight.copy()
            for _ in range(wanted if count > 0 else 0):
                # Each target takes a weight of one from the heaviest component left.
                best = np.argmax(left)
                copies[best] += 1
                left[best] -= 1.0
        row = 0
        for i in np.argsort(-weight, kind="mergesort"):
            label = mixture.label[b, head[i]]
            if copies[i] > 0:
                if label == 0 or _seen(label, extraction.label[b], row):
                    label = next_label[b]
                    next_label[b] += 1
                    mixture.label[b, head[i]] = label
                for k in range(min(copies[i], room - row)):
                    _write(extraction, b, row, min(weight[i], 1.0), label + k * COPY_STRIDE, mean[i], cov[i], True)
                    row += 1
            elif weight[i] >= HELD and label > 0 and row < room and not _seen(label, extraction.label[b], row):
                _write(extraction, b, row, min(weight[i], 1.0), label, mean[i], cov[i], False)
                row += 1
        extraction.number[b] = row


@njit(cache=True, nogil=True)
def most_probable_number(existence):  # type: ignore[no-untyped-def]
    """Return the mode of the Poisson-binomial distribution of the number of existing tracks."""
    count = existence.shape[0]
    pmf = np.zeros(count + 1)
    pmf[0] = 1.0
    for i in range(count):
        for k in range(i + 1, 0, -1):
            pmf[k] = pmf[k] * (1.0 - existence[i]) + pmf[k - 1] * existence[i]
        pmf[0] *= 1.0 - existence[i]
    return np.argmax(pmf)


@njit(cache=True, nogil=True)
def extract_tracks(n, tracks, mixture, next_label, rule, threshold, extraction):  # type: ignore[no-untyped-def]
    """Extract targets from Bernoulli tracks; the state of a track is its heaviest component.

    Two tracks may share an identity (legacy and updated track of one target in the CBMeMBer filter). The more probable
    one keeps it; the other gets a new identity if it is reported as well.
    """
    for b in range(tracks.existence.shape[0]):
        number = tracks.number[b]
        existence = tracks.existence[b, :number]
        first = np.zeros(number + 1, np.int64)
        for i in range(number):
            first[i + 1] = first[i] + tracks.size[b, i]
        order = np.argsort(-existence, kind="mergesort")
        total = 0.0
        for i in range(number):
            total += existence[i]
        extraction.expected[b] = total
        wanted = number
        if rule == SUM:
            wanted = round_half_up(total)
        elif rule == MAP:
            wanted = most_probable_number(existence)
        row = 0
        for rank in range(number):
            i = order[rank]
            reported = rank < wanted and (rule != THRESHOLD or existence[i] > threshold)
            if not reported and existence[i] < HELD:
                continue
            label = tracks.label[b, i]
            if label == 0 or _seen(label, extraction.label[b], row):
                if not reported:
                    continue
                label = next_label[b]
                next_label[b] += 1
                tracks.label[b, i] = label
            best = first[i]
            for j in range(first[i] + 1, first[i + 1]):
                if mixture.weight[b, j] > mixture.weight[b, best]:
                    best = j
            _write(
                extraction, b, row, existence[i], label, mixture.mean[b, best], mixture.covariance[b, best], reported
            )
            row += 1
        extraction.number[b] = row
