"""Errors about who exists that no tracker can avoid: of the number of targets, of existence and position together.

A target that may or may not be there is a Markov chain of two states. Who knows where it would be and what every other
target does sees at each scan the measurements near that place, and its posterior probability r follows by Bayes' rule
(the Bernoulli filter; Ristic, Vo, Vo and Farina 2013). The error of the best answer to r bounds that of every tracker,
which knows less (Rezaeian and Vo 2010; Tong, Zhang and Liu 2012).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotrack.estimators.rfs.cramer_rao import whitened_scans
from servotrack.estimators.types import Array, Mask


@dataclass(frozen=True)
class Presence:
    """A target at a known place that appears and vanishes.

    Args:
        birth: Probability per scan that it appears if it is absent, p_B. It is absent before the first scan.
        survival: Probability per scan that it stays, p_S.
        detection: Probability that it is detected, p_D.
        clutter: Expected false measurements within the volume sqrt(det(2 pi R)) of a measurement's noise R, that is
            kappa sqrt(det(2 pi R)). Raising it makes detections say less.
        dimensions: Number of coordinates of a measurement, m.

    Raises:
        ValueError: A probability is not in [0, 1], or clutter is negative.
    """

    birth: float
    survival: float
    detection: float
    clutter: float = 0.0
    dimensions: int = 2

    def __post_init__(self) -> None:
        for name in ("birth", "survival", "detection"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)!r}")
        if not (math.isfinite(self.clutter) and self.clutter >= 0.0):
            raise ValueError(f"clutter must be finite and >= 0, got {self.clutter!r}")
        if self.dimensions < 1:
            raise ValueError(f"dimensions must be at least 1, got {self.dimensions!r}")

    def simulate(self, scans: int, runs: int, seed: int = 0) -> tuple[Array, Array]:
        """Simulate runs and the exact posterior probability of existence.

        Args:
            scans: Number of scans, S.
            runs: Number of independent runs.
            seed: Seed of the simulation.

        Returns:
            Existence, 0 or 1, and its probability given all measurements up to the scan, each of shape (runs, S).
        """
        if scans < 1 or runs < 1:
            raise ValueError(f"scans and runs must be at least 1, got {scans!r} and {runs!r}")
        rng = np.random.default_rng(seed)
        exists, r = np.zeros(runs, np.bool_), np.zeros(runs)
        truth, chance = np.empty((runs, scans)), np.empty((runs, scans))
        for k in range(scans):
            exists = rng.random(runs) < np.where(exists, self.survival, self.birth)
            r = self.survival * r + self.birth * (1.0 - r)
            present, absent = self._likelihoods(rng, exists)
            total = r * present + (1.0 - r) * absent
            r = np.divide(r * present, total, out=np.zeros_like(r), where=total > 0.0)
            truth[:, k], chance[:, k] = exists, r
        return truth, chance

    def _likelihoods(self, rng: np.random.Generator, exists: Mask) -> tuple[Array, Array]:
        """Likelihood of a simulated scan of each run if the target exists and if not, up to a common factor."""
        runs, m = len(exists), self.dimensions
        detected = exists & (rng.random(runs) < self.detection)
        if self.clutter == 0.0:
            # A measurement is the target's for certain.
            return np.where(detected, 1.0, 1.0 - self.detection), np.where(detected, 0.0, 1.0)
        owner, u = whitened_scans(rng, detected, self.clutter, m)
        ratio = np.bincount(owner, np.exp(-0.5 * (u * u).sum(axis=1)), runs) / self.clutter
        return 1.0 - self.detection + self.detection * ratio, np.ones(runs)


def number_error(existence: Array) -> Array:
    """Smallest expected absolute error of the number of targets whose existences are independent.

    The number has a Poisson-binomial distribution, and its median is the best answer. The errors of the targets do not
    add: two of probability 1/2 have an error of 1/2 together, not of 1.

    Args:
        existence: Posterior probability of each target. Shape (*batch, targets).

    Returns:
        Shape (*batch,).

    Raises:
        ValueError: A probability is not in [0, 1].
    """
    r = _checked(existence)
    targets = r.shape[-1]
    chance = np.zeros((*r.shape[:-1], targets + 1))
    chance[..., 0] = 1.0
    for i in range(targets):
        moved = chance[..., :-1] * r[..., i, None]
        chance = chance * (1.0 - r[..., i, None])
        chance[..., 1:] += moved
    numbers = np.arange(targets + 1)
    median = (np.cumsum(chance, axis=-1) < 0.5).sum(axis=-1)
    return np.asarray((chance * np.abs(numbers - median[..., None])).sum(axis=-1))


def joint_error(existence: Array, distance: Array, cutoff: float) -> Array:
    """Smallest expected GOSPA (order 1, alpha 2) of one target: report it, or not.

    An absent target that is reported and a present one that is not cost c / 2 each; a present one that is reported
    costs its distance, at most c. Errors of targets that are not near each other add.

    Args:
        existence: r, posterior probability of the target. Shape (*batch,).
        distance: Expected distance min(c, |x - a|) of the best position, m; `expected_distance`. Shape (*batch,).
        cutoff: c, m.

    Returns:
        min(r c / 2, (1 - r) c / 2 + r d). Shape (*batch,), m.

    Raises:
        ValueError: A probability is not in [0, 1], a distance is negative, or the cutoff is not positive.
    """
    if not cutoff > 0.0:
        raise ValueError(f"cutoff must be > 0, got {cutoff!r}")
    r, d = _checked(existence), np.asarray(distance, dtype=np.float64)
    if not np.all(d >= 0.0):
        raise ValueError(f"distance must be >= 0, got {d.min()}")
    return np.asarray(np.minimum(0.5 * cutoff * r, 0.5 * cutoff * (1.0 - r) + r * np.minimum(d, cutoff)))


def _checked(existence: Array) -> Array:
    r = np.asarray(existence, dtype=np.float64)
    if not np.all((r >= 0.0) & (r <= 1.0)):
        raise ValueError(f"existence must be in [0, 1], got {r.min()} to {r.max()}")
    return r
