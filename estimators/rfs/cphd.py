"""Gaussian-mixture cardinalized PHD filter (Vo, Vo and Cantoni 2007), under hidden and pairwise Markov models.

Beside the intensity the filter keeps the distribution of the number of targets. Clutter is Poisson, so that its rate
cancels, and only its intensity at each measurement enters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.capacity import intensity_outgrew, warn_of_cap
from servotrack.estimators.rfs.extraction import MAP, RULES, Rule, extract_intensity
from servotrack.estimators.rfs.gaussians import Pairs, weigh_pairs
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture, scratch_mixture
from servotrack.estimators.rfs.phd import keep_corrected, predict_intensity
from servotrack.estimators.rfs.pmb_kernel import SMALLEST_EVIDENCE
from servotrack.estimators.rfs.recursion import GaussianSetFilter, check_positive_definite
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import HELD, Extraction, Scan, empty_extraction
from servotrack.estimators.types import Array, Labels


class CPHDState(NamedTuple):
    """State of a `GMCPHD`.

    Attributes:
        intensity: The posterior intensity.
        cardinality: Probability of each number of targets from 0 on. Shape (*batch, N + 1).
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
    """

    intensity: Mixture
    cardinality: Array
    births: BirthMixture
    next_label: Labels


@dataclass(frozen=True, eq=False)
class GMCPHD(GaussianSetFilter[CPHDState]):
    """GM-CPHD filter; further arguments as in `GaussianSetFilter`, of which `spawn` must be empty.

    The rule "map" of `extraction`, the default, reports the most probable number of targets.

    Args:
        targets: Largest number of targets in the distribution of their number; a step in which it is probable warns.
            None: no limit; arrays have room for 50 and double.
        tail: Probability of the largest number in the arrays from which they grow. Raising it keeps smaller arrays.

    Raises:
        ValueError: An argument is out of range, or there are spawn terms.

    References:
        Vo, Vo and Cantoni, "Analytic implementations of the cardinalized probability hypothesis density filter", IEEE
        Transactions on Signal Processing 55(7), 2007.
    """

    extraction: Rule = "map"
    reduction: Reduction = field(default_factory=lambda: Reduction(components=None))
    targets: int | None = None
    tail: float = 1e-9

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.spawn:
            raise ValueError(
                f"spawn must be empty, got {len(self.spawn)} terms: targets that split are not independent; use GMPHD "
                "or a multi-Bernoulli filter"
            )
        if self.targets is not None and self.targets < 1:
            raise ValueError(f"targets must be at least 1 or None, got {self.targets!r}")
        if not 0.0 < self.tail < 1.0:
            raise ValueError(f"tail must be in (0, 1), got {self.tail!r}")

    def _empty(self, batch: int) -> CPHDState:
        cardinality = np.zeros((batch, 1 + (50 if self.targets is None else self.targets)))
        cardinality[:, 0] = 1.0
        intensity = empty_mixture(batch, self.reduction.first_components, sum(self._sizes))
        return CPHDState(intensity, cardinality, self._no_births(batch), np.ones(batch, np.int64))

    def _advance(self, state: CPHDState, births: BirthMixture, scan: Scan) -> tuple[CPHDState, Extraction, Array]:
        model, rules, (batch, capacity) = self.model.packed, self.reduction, state.intensity.weight.shape
        n, m = self._sizes
        predicted = scratch_mixture(batch, capacity + births.weight.shape[1], n + m)
        survival = self._evaluate("survival", self.survival, state.intensity)
        predict_intensity(model, state.intensity, births, self._spawns, survival, predicted)
        self._attach(predicted)
        detection = self._evaluate("detection", self.detection, predicted)
        room = state.cardinality.shape[1]
        while True:
            prior = self._predicted_cardinality(state, survival, births, room)
            intensity, cardinality = empty_mixture(batch, capacity, n + m), np.zeros(prior.shape)
            next_label = state.next_label.copy()
            unexplained, left = np.zeros(scan.clutter.shape), np.zeros(batch)
            limits = rules.limits._replace(components=capacity)
            check_positive_definite(
                _update(
                    model,
                    predicted,
                    prior,
                    scan,
                    detection,
                    self._gate,
                    limits,
                    next_label,
                    intensity,
                    cardinality,
                    unexplained,
                    left,
                )
            )
            more_targets = self._number_outgrew(cardinality)
            more_components = intensity_outgrew(rules, intensity, left - intensity.weight.sum(axis=1))
            if not (more_targets or more_components):
                break
            capacity, room = capacity * (2 if more_components else 1), room * (2 if more_targets else 1)
        extraction, rule = empty_extraction(batch, capacity, n), RULES[self.extraction]
        wanted = cardinality.argmax(axis=1) if rule == MAP else np.full(batch, -1)
        extract_intensity(model, intensity, next_label, limits, rule, self.threshold, extraction, wanted)
        extraction = extraction._replace(expected=cardinality @ np.arange(room, dtype=np.float64))
        return CPHDState(intensity, cardinality, state.births, next_label), extraction, unexplained

    def _number_outgrew(self, cardinality: Array) -> bool:
        """Return True if the largest number of targets is so probable that larger ones may be, too."""
        last = float(cardinality[:, -1].max())
        if self.targets is None:
            return last > self.tail
        if last >= HELD:
            warn_of_cap("targets", "the probability")
        return False

    def _predicted_cardinality(self, state: CPHDState, survival: Array, births: BirthMixture, room: int) -> Array:
        """Distribution of the number of targets before the scan, of numbers below `room`. Shape (B, room)."""
        weight = state.intensity.weight
        used = np.arange(weight.shape[1]) < state.intensity.number[:, None]
        total = np.where(used, weight, 0.0).sum(axis=1)
        # Where survival depends on the state, that of the mean target counts for all (the article has a constant).
        share = np.where(used, survival * weight, 0.0).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        born = np.broadcast_to(np.maximum(births.weight, 0.0).sum(axis=1), total.shape)
        predicted = np.zeros((len(total), room))
        _predict_cardinality(state.cardinality, share, np.array(born), predicted)
        return predicted


@njit(cache=True, nogil=True)
def _predict_cardinality(before, survival, births, out):  # type: ignore[no-untyped-def]
    """Thin the number of targets by survival and add a Poisson number of births (Vo, Vo and Cantoni 2007, eq. 13)."""
    room = out.shape[1]
    for b in range(before.shape[0]):
        q = survival[b]
        # Horner's scheme for sum_l p(l) (1 - q + q s)^l, coefficient by coefficient.
        thinned = np.zeros(before.shape[1])
        for place in range(before.shape[1] - 1, -1, -1):
            for k in range(before.shape[1] - 1 - place, 0, -1):
                thinned[k] = (1.0 - q) * thinned[k] + q * thinned[k - 1]
            thinned[0] = (1.0 - q) * thinned[0] + before[b, place]
        # Poisson up to a factor, so that a large mean does not underflow.
        chance = np.zeros(room)
        for new in range(1, room):
            chance[new] = chance[new - 1] + (math.log(births[b] / new) if births[b] > 0.0 else -np.inf)
        chance = np.exp(chance - chance.max())
        for new in range(room):
            for k in range(min(before.shape[1], room - new)):
                out[b, new + k] += chance[new] * thinned[k]
        total = 0.0
        for k in range(room):
            total += out[b, k]
        for k in range(room):
            out[b, k] /= total


@njit(cache=True, nogil=True)
def elementary_symmetric(values, leave_out, out):  # type: ignore[no-untyped-def]
    """Elementary symmetric functions e_0 to e_M of M values without one of them; leave_out -1: of all."""
    out[:] = 0.0
    out[0] = 1.0
    used = 0
    for j in range(values.shape[0]):
        if j == leave_out:
            continue
        used += 1
        for k in range(used, 0, -1):
            out[k] += values[j] * out[k - 1]


@njit(cache=True, nogil=True)
def _log_moments(prior, missed, total, most, out):  # type: ignore[no-untyped-def]
    """Log sum_n p(n) n! / (n - j)! missed^(n - j) / total^n for j from 0 to `most`."""
    numbers = prior.shape[0]
    log_factorial = np.zeros(numbers)
    for k in range(1, numbers):
        log_factorial[k] = log_factorial[k - 1] + math.log(k)
    log_missed = math.log(missed) if missed > 0.0 else -np.inf
    log_total = math.log(total)
    for j in range(most + 1):
        largest = -np.inf
        for pass_over in range(2):
            value = 0.0
            for k in range(j, numbers):
                if prior[k] <= 0.0 or (k > j and missed <= 0.0):
                    continue
                rest = (k - j) * log_missed if k > j else 0.0
                term = math.log(prior[k]) + log_factorial[k] - log_factorial[k - j] + rest - k * log_total
                if pass_over == 0:
                    largest = max(largest, term)
                else:
                    value += math.exp(term - largest)
            if largest == -np.inf:
                break
        out[j] = largest + math.log(value) if largest > -np.inf else -np.inf


@njit(cache=True, nogil=True)
def _weighed(symmetric, log_scale, moments, shift, count, largest):  # type: ignore[no-untyped-def]
    """sum_j e_j scale^j exp(moments[j + shift] - largest) over j from 0 to count."""
    value = 0.0
    for j in range(count + 1):
        if symmetric[j] > 0.0 and moments[j + shift] > -np.inf:
            value += math.exp(math.log(symmetric[j]) + j * log_scale + moments[j + shift] - largest)
    return value


@njit(cache=True, nogil=True)
def _update(  # type: ignore[no-untyped-def]
    model,
    predicted,
    prior,
    scan,
    detection,
    gate,
    limits,
    next_label,
    out,
    cardinality,
    unexplained,
    expected,
):
    """Posterior intensity and cardinality of every run (Vo, Vo and Cantoni 2007, eq. 15 to 20).

    With Poisson clutter of intensity kappa the article's Upsilon^u(n) is proportional to
    sum_j e_j(xi) n! / (n - j - u)! <1 - p_D, v>^(n - j - u) / <1, v>^n, with xi_z = <p_D g_z, v> / kappa(z).
    `expected` receives the expected number of targets before the reduction, shape (B,).
    """
    z, number, clutter, excess = scan
    positive_definite = True
    for b in range(predicted.weight.shape[0]):
        count = predicted.number[b]
        component, measurement, likelihood, part, gain, posterior, definite = weigh_pairs(
            model, count, predicted.mean[b], predicted.covariance[b], z[b], excess[b], number[b], gate
        )
        positive_definite = positive_definite and definite
        pairs = component.shape[0]
        ratio = np.zeros(number[b])
        for p in range(pairs):
            i, j = component[p], measurement[p]
            likelihood[p] *= detection[b, i] * predicted.weight[b, i] / max(clutter[b, j], SMALLEST_EVIDENCE)
            ratio[j] += likelihood[p]
        total, missed = 0.0, 0.0
        for i in range(count):
            total += predicted.weight[b, i]
            missed += (1.0 - detection[b, i]) * predicted.weight[b, i]
        found = np.flatnonzero(ratio > 0.0)
        seen = min(found.shape[0], prior.shape[1] - 1)
        scale = ratio.max() if seen > 0 else 1.0
        log_scale = math.log(scale)
        scaled = ratio[found] / scale
        symmetric = np.empty(found.shape[0] + 1)
        moments = np.full(found.shape[0] + 2, -np.inf)
        undetected, share = 0.0, np.zeros(number[b])
        if total > 0.0:
            _log_moments(prior[b], missed, total, min(seen + 1, prior.shape[1] - 1), moments)
            elementary_symmetric(scaled, -1, symmetric)
            largest = -np.inf
            for j in range(seen + 1):
                if symmetric[j] > 0.0:
                    largest = max(largest, math.log(symmetric[j]) + j * log_scale + moments[j])
            evidence = _weighed(symmetric, log_scale, moments, 0, seen, largest)
            undetected = _weighed(symmetric, log_scale, moments, 1, seen, largest) / evidence
            _posterior_cardinality(prior[b], symmetric, log_scale, seen, missed, total, cardinality[b])
            for k in range(found.shape[0]):
                elementary_symmetric(scaled, k, symmetric)
                share[found[k]] = _weighed(symmetric, log_scale, moments, 1, seen, largest) / evidence
        else:
            cardinality[b, 0] = 1.0
        for j in range(number[b]):
            unexplained[b, j] = max(1.0 - share[j] * ratio[j], 0.0)
        left = undetected * (1.0 - detection[b, :count]) * predicted.weight[b, :count]
        for p in range(pairs):
            likelihood[p] *= share[measurement[p]]
        seen_pairs = Pairs(component, measurement, likelihood, part, gain)
        expected[b] = keep_corrected(model, predicted, b, z[b], seen_pairs, left, posterior, limits, next_label[b], out)
        next_label[b] += number[b]
    return positive_definite


@njit(cache=True, nogil=True)
def _posterior_cardinality(prior, symmetric, log_scale, seen, missed, total, out):  # type: ignore[no-untyped-def]
    """p(n) Upsilon^0(n), normalized."""
    numbers = prior.shape[0]
    log_factorial = np.zeros(numbers)
    for k in range(1, numbers):
        log_factorial[k] = log_factorial[k - 1] + math.log(k)
    log_missed = math.log(missed) if missed > 0.0 else -np.inf
    terms = np.full((numbers, seen + 1), -np.inf)
    largest = -np.inf
    for k in range(numbers):
        for j in range(min(seen, k) + 1):
            if prior[k] > 0.0 and symmetric[j] > 0.0 and (k == j or missed > 0.0):
                rest = (k - j) * log_missed if k > j else 0.0
                terms[k, j] = (
                    math.log(prior[k])
                    + math.log(symmetric[j])
                    + j * log_scale
                    + log_factorial[k]
                    - log_factorial[k - j]
                    + rest
                    - k * math.log(total)
                )
                largest = max(largest, terms[k, j])
    sum_of_all = 0.0
    for k in range(numbers):
        out[k] = 0.0
        for j in range(min(seen, k) + 1):
            if terms[k, j] > -np.inf:
                out[k] += math.exp(terms[k, j] - largest)
        sum_of_all += out[k]
    for k in range(numbers):
        out[k] /= sum_of_all
