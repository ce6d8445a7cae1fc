"""Particle (sequential Monte Carlo) PHD filter (Vo, Singh and Doucet 2005) with extraction by clustering.

It serves to check Wu and Hu 2010's remark that the particle form costs more than the Gaussian one and extracts
unreliably.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.birth import Birth
from servotrack.estimators.rfs.models import HiddenMarkovModel, RangeBearingModel
from servotrack.estimators.rfs.particles import (
    cluster_particles,
    predict_particles,
    resample_systematically,
    weigh_particles,
)
from servotrack.estimators.rfs.sets import (
    Extraction,
    SetEstimate,
    check_runs,
    empty_extraction,
    estimate_from_extraction,
    read_measurements,
)
from servotrack.estimators.stateful import add_axis, copied, first_row
from servotrack.estimators.types import Array, Labels


class ParticlePHDState(NamedTuple):
    """State of a `ParticlePHD`.

    Attributes:
        number: Number of particles in use. Shape (*batch,).
        weight: Weights. Shape (*batch, P).
        particle: States. Shape (*batch, P, n).
        label: Identities, 0 for none yet. Shape (*batch, P).
        next_label: The next new identity. Shape (*batch,).
        stream: Index of the run's random stream. Shape (*batch,).
        time: Number of steps so far. Shape (*batch,).
    """

    number: Labels
    weight: Array
    particle: Array
    label: Labels
    next_label: Labels
    stream: Labels
    time: Labels


@dataclass(frozen=True, eq=False)
class ParticlePHD:
    """SMC-PHD filter with prediction as proposal, systematic resampling and k-means extraction.

    Args:
        model: A hidden Markov or a range-bearing model.
        birth: Places where targets appear.
        clutter_intensity: Expected false measurements per unit of measurement space.
        survival: Survival probability p_S.
        detection: Detection probability p_D.
        particles: Number of particles per expected target. Raising it reduces the Monte Carlo error and costs time.
        birth_particles: Number of particles drawn from the births per step.
        capacity: Largest number of particles.
        seed: Seed of the random streams; each number drawn is a function of (seed, run, step).
        cluster_iterations: Largest number of Lloyd iterations of the clustering. Well separated targets need fewer.

    Raises:
        ValueError: An argument is out of range, or the model is pairwise.
    """

    model: HiddenMarkovModel | RangeBearingModel
    birth: Birth
    clutter_intensity: float
    survival: float = 0.99
    detection: float = 0.98
    particles: int = 1000
    birth_particles: int = 1000
    capacity: int = 30_000
    seed: int = 0
    cluster_iterations: int = 10

    def __post_init__(self) -> None:
        if self.model.packed.pairwise:
            raise ValueError("model must be a hidden Markov model: a particle's weight needs p(y | x)")
        n = self.model.packed.observation.shape[1]
        if self.birth.means.shape[1] != n:
            raise ValueError(f"birth means must have {n} entries as the model's state, got {self.birth.means.shape[1]}")
        for name, value in (("survival", self.survival), ("detection", self.detection)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {value!r}")
        if not (np.isfinite(self.clutter_intensity) and self.clutter_intensity >= 0.0):
            raise ValueError(f"clutter_intensity must be finite and >= 0, got {self.clutter_intensity!r}")
        for name, count in (
            ("particles", self.particles),
            ("birth_particles", self.birth_particles),
            ("cluster_iterations", self.cluster_iterations),
        ):
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count!r}")
        if self.capacity <= self.birth_particles:
            raise ValueError(f"capacity must be above birth_particles = {self.birth_particles}, got {self.capacity!r}")

    def initial(self, measurement: ArrayLike) -> ParticlePHDState:
        """State before the first measurement: no particles. Only the measurement's batch axis is read."""
        m, n = self.model.packed.observation.shape
        z, _, single = read_measurements(measurement, m)
        batch = z.shape[0]
        state = ParticlePHDState(
            np.zeros(batch, np.int64),
            np.zeros((batch, self.capacity)),
            np.zeros((batch, self.capacity, n)),
            np.zeros((batch, self.capacity), np.int64),
            np.ones(batch, np.int64),
            np.arange(batch),
            np.zeros(batch, np.int64),
        )
        return first_row(state) if single else state

    def step(
        self, state: ParticlePHDState, measurement: ArrayLike, dt: float | None = None
    ) -> tuple[ParticlePHDState, SetEstimate]:
        """Predict, weigh, extract and resample; arguments, shapes and errors as in `GaussianSetFilter.step`."""
        if dt is not None and dt != self.model.period:
            return self._over(dt).step(state, measurement)
        m, n = self.model.packed.observation.shape
        z, number, single = read_measurements(measurement, m)
        check_runs(state.next_label, z.shape[0], single)
        if single:
            state = add_axis(state)
        new = copied(state)
        room = min(self.capacity, max(round(self.capacity / self.particles), 1))
        extraction = empty_extraction(z.shape[0], room, n)
        for b in range(z.shape[0]):
            # Every run has its own generator, so that its numbers do not depend on the other runs of the batch.
            rng = np.random.default_rng([self.seed, int(state.stream[b]), int(state.time[b])])
            self._advance(new, b, z[b, : number[b]], rng, extraction)
        new.time[...] += 1
        return (first_row(new) if single else new), estimate_from_extraction(extraction, single)

    def _over(self, dt: float) -> ParticlePHD:
        """The same filter for another interval, over which survival and births are in proportion."""
        share = dt / self.model.period
        return replace(
            self,
            model=self.model.at(dt),
            survival=self.survival**share,
            birth=replace(self.birth, weights=np.minimum(share * self.birth.weights, 1.0)),
        )

    def _advance(
        self, new: ParticlePHDState, b: int, z: Array, rng: np.random.Generator, extraction: Extraction
    ) -> None:
        """Advance run b by one step, in place."""
        model = self.model.packed
        n = model.observation.shape[1]
        count = int(new.number[b])
        old = new.particle[b, :count]
        eigenvalues, vectors = np.linalg.eigh(model.noise[:n, :n])
        root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
        survivors = predict_particles(model.transition[:n, :n], root, old, rng.standard_normal((count, n)))
        places = rng.choice(
            len(self.birth.weights), self.birth_particles, p=self.birth.weights / self.birth.weights.sum()
        )
        roots = np.linalg.cholesky(self.birth.covariances)
        noise = rng.standard_normal((self.birth_particles, n))
        births = self.birth.means[places] + np.einsum("prk,pk->pr", roots[places], noise)
        particles = np.concatenate([survivors, births])
        weight = np.concatenate(
            [
                self.survival * new.weight[b, :count],
                np.full(self.birth_particles, self.birth.weights.sum() / self.birth_particles),
            ]
        )
        label = np.concatenate([new.label[b, :count], np.zeros(self.birth_particles, np.int64)])
        weigh_particles(model, particles, weight, z, self.clutter_intensity, self.detection)
        total = float(weight.sum())
        targets = min(int(np.floor(total + 0.5)), extraction.label.shape[1])
        new.next_label[b] = cluster_particles(
            model.observation,
            particles,
            weight,
            label,
            targets,
            self.cluster_iterations,
            new.next_label[b],
            extraction,
            b,
        )
        extraction.expected[b] = total
        kept = min(max(int(np.ceil(self.particles * total)), self.particles), self.capacity - self.birth_particles)
        chosen = resample_systematically(weight, kept, rng.random())
        kept = len(chosen)
        new.number[b] = kept
        for array, values in ((new.particle, particles[chosen]), (new.label, label[chosen])):
            array[b] = 0
            array[b, :kept] = values
        new.weight[b] = 0.0
        new.weight[b, :kept] = total / kept if kept else 0.0
