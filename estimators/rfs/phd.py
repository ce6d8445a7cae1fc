"""Gaussian-mixture probability hypothesis density filter (Vo and Ma 2006), under hidden and pairwise Markov models.

The state is the intensity of the set of targets. The pairwise form follows Petetin and Desbouvries (2013), the labels
Clark, Panta and Vo (2006): a component keeps its identity through prediction, update and merging.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.capacity import intensity_outgrew
from servotrack.estimators.rfs.extraction import RULES, extract_intensity
from servotrack.estimators.rfs.gaussians import Pairs, detected_mean, weigh_pairs
from servotrack.estimators.rfs.mixture import (
    Mixture,
    append_births,
    append_spawn,
    empty_mixture,
    predict_components,
    scratch_mixture,
)
from servotrack.estimators.rfs.recursion import GaussianSetFilter, Probability, check_positive_definite
from servotrack.estimators.rfs.reduction import Candidates, Components, Reduction, reduce_mixture
from servotrack.estimators.rfs.sets import Extraction, Scan, empty_extraction
from servotrack.estimators.types import Array, Labels


class PHDState(NamedTuple):
    """State of a `GMPHD`.

    Attributes:
        intensity: The posterior intensity.
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
    """

    intensity: Mixture
    births: BirthMixture
    next_label: Labels


@dataclass(frozen=True, eq=False)
class GMPHD(GaussianSetFilter[PHDState]):
    """GM-PHD filter; arguments as in `GaussianSetFilter`."""

    reduction: Reduction = field(default_factory=lambda: Reduction(components=None))

    def _empty(self, batch: int) -> PHDState:
        intensity = empty_mixture(batch, self.reduction.first_components, sum(self._sizes))
        return PHDState(intensity, self._no_births(batch), np.ones(batch, np.int64))

    def _advance(self, state: PHDState, births: BirthMixture, scan: Scan) -> tuple[PHDState, Extraction, Array]:
        return self._advance_detecting(state, births, scan, self.detection)

    def _advance_detecting(
        self, state: PHDState, births: BirthMixture, scan: Scan, probability: Probability | Array
    ) -> tuple[PHDState, Extraction, Array]:
        """Run `_advance` with another detection probability, which may be one number per run, shape (B,)."""
        model, rules, (batch, capacity) = self.model.packed, self.reduction, state.intensity.weight.shape
        n, m = self._sizes
        room = capacity * (1 + len(self.spawn)) + births.weight.shape[1]
        predicted = scratch_mixture(batch, room, n + m)
        survival = self._evaluate("survival", self.survival, state.intensity)
        predict_intensity(model, state.intensity, births, self._spawns, survival, predicted)
        self._attach(predicted)
        detection = self._evaluate("detection", probability, predicted)
        while True:
            intensity = empty_mixture(batch, capacity, n + m)
            next_label = state.next_label.copy()
            unexplained, left = np.zeros(scan.clutter.shape), np.zeros(batch)
            limits = rules.limits._replace(components=capacity)
            positive_definite = _update_intensity(
                model, predicted, scan, detection, self._gate, limits, next_label, intensity, unexplained, left
            )
            check_positive_definite(positive_definite)
            if not intensity_outgrew(rules, intensity, left - intensity.weight.sum(axis=1)):
                break
            capacity *= 2
        extraction = empty_extraction(batch, capacity, n)
        by_rule, rule = np.full(batch, -1), RULES[self.extraction]
        extract_intensity(model, intensity, next_label, limits, rule, self.threshold, extraction, by_rule)
        return PHDState(intensity, state.births, next_label), extraction, unexplained


@njit(cache=True, nogil=True)
def predict_intensity(model, intensity, births, spawns, survival, out):  # type: ignore[no-untyped-def]
    """Predicted intensity: survivors, births, and targets split off those of the last step (Wu and Hu 2010, eq. 3)."""
    m, n = model.observation.shape
    work = np.empty((n + m, n + m))
    for b in range(intensity.weight.shape[0]):
        predict_components(model, intensity, b, work, out)
        row = intensity.number[b]
        for i in range(row):
            out.weight[b, i] = survival[b, i] * intensity.weight[b, i]
        for term in range(spawns[0].shape[0]):
            for i in range(intensity.number[b]):
                append_spawn(model, spawns, term, intensity.mean[b, i], intensity.covariance[b, i], b, row, out)
                out.weight[b, row] = spawns[0][term] * intensity.weight[b, i]
                row += 1
        out.number[b] = append_births(model, births, b, row, out)


@njit(cache=True, nogil=True)
def _update_intensity(  # type: ignore[no-untyped-def]
    model, predicted, scan, detection, gate, limits, next_label, out, unexplained, expected
):
    """Posterior intensity of every run: components missed, and corrected by measurements (Wu and Hu 2010, eq. 4).

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
        evidence = clutter[b, : number[b]].copy()
        for p in range(pairs):
            i = component[p]
            likelihood[p] *= detection[b, i] * predicted.weight[b, i]
            evidence[measurement[p]] += likelihood[p]
        for j in range(number[b]):
            unexplained[b, j] = clutter[b, j] / evidence[j] if evidence[j] > 0.0 else 1.0
        left = (1.0 - detection[b, :count]) * predicted.weight[b, :count]
        for p in range(pairs):
            if evidence[measurement[p]] > 0.0:
                likelihood[p] /= evidence[measurement[p]]
        seen = Pairs(component, measurement, likelihood, part, gain)
        expected[b] = keep_corrected(model, predicted, b, z[b], seen, left, posterior, limits, next_label[b], out)
        next_label[b] += number[b]
    return positive_definite


@njit(cache=True, nogil=True)
def keep_corrected(model, predicted, b, z, seen, left, posterior, limits, next_label, out):  # type: ignore[no-untyped-def]
    """Write the components of run b that were missed or corrected by a measurement, reduced.

    Args:
        model: The packed model.
        predicted: The predicted intensity, a `Mixture`.
        b: The run.
        z: Measurements. Shape (Z, m).
        seen: `Pairs`, with the weights of the corrected components as their likelihoods.
        left: Weights of the missed components. Shape (J,).
        posterior: Covariances after a detection. Shape (parts, n, n).
        limits: A `Limits`.
        next_label: Identity of a component without one that the first measurement corrects.
        out: A `Mixture` to write to.

    Returns:
        Expected number of targets before the reduction, without what is pruned.
    """
    m, n = model.observation.shape
    count, pairs = left.shape[0], seen.component.shape[0]
    weight, mean = np.empty(count + pairs), np.empty((count + pairs, n + m))
    source, group = np.empty(count + pairs, np.int64), np.empty(count + pairs, np.int64)
    label, innovation = np.empty(count + pairs, np.int64), np.empty(m)
    total = 0
    for i in range(count):
        if left[i] > limits.prune:
            weight[total], source[total], group[total], label[total] = left[i], i, -1, predicted.label[b, i]
            mean[total] = predicted.mean[b, i]
            total += 1
    for p in range(pairs):
        if seen.likelihood[p] > limits.prune:
            i, j = seen.component[p], seen.measurement[p]
            weight[total], source[total], group[total] = seen.likelihood[p], seen.part[p], j
            label[total] = predicted.label[b, i] if predicted.label[b, i] > 0 else next_label + j
            detected_mean(model, predicted.mean[b, i], seen.gain[seen.part[p]], z[j], innovation, mean[total])
            total += 1
    candidates = Candidates(weight[:total], mean[:total], source[:total], group[:total], label[:total])
    room = Components(out.weight[b], out.mean[b], out.covariance[b], out.detected[b], out.label[b])
    out.number[b] = reduce_mixture(
        model.pairwise,
        n,
        candidates,
        np.arange(total),
        predicted.covariance[b],
        posterior,
        limits,
        limits.components,
        room,
        0,
    )
    return weight[:total].sum()
