"""The scenario of paper 004: twelve targets in clutter on a square of 4 km, drawn from a hidden or pairwise Markov model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.rfs import Birth, HiddenMarkovModel, PairwiseMarkovModel

Array = NDArray[np.float64]

STEPS = 100
HALF_WIDTH = 2000.0
AREA = (2.0 * HALF_WIDTH) ** 2
BIRTH_PLACES = ((0.0, 0.0), (400.0, -600.0), (-800.0, -200.0), (-200.0, 800.0))
TARGETS = (  # first step, last step, initial state (x, vx, y, vy)
    (1, 70, (0, 0, 0, -10)),
    (1, 70, (400, -10, -600, 5)),
    (1, 100, (-800, 20, -200, -5)),
    (20, 100, (400, -7, -600, -4)),
    (20, 100, (400, -2.5, -600, 10)),
    (20, 100, (0, 7.5, 0, -5)),
    (40, 100, (-800, 12, -200, 7)),
    (40, 100, (-200, 15, 800, -10)),
    (60, 100, (-800, 3, -200, 15)),
    (60, 100, (-200, -3, 800, -15)),
    (80, 100, (0, -20, 0, -15)),
    (80, 100, (-200, 15, 800, -5)),
)


class Run(NamedTuple):
    """One draw: truth (STEPS, targets, 4) with NaN where absent, and a list of measurements (Z, 2) per step."""

    truth: Array
    measurements: list[Array]


def scenario_birth(weight: float = 0.03) -> Birth:
    """Births at the four places, standard deviation 10 on all states."""
    means = np.array([(x, 0.0, y, 0.0) for x, y in BIRTH_PLACES])
    return Birth(np.full(4, weight), means, 100.0 * np.eye(4))


def draw_run(
    model: HiddenMarkovModel | PairwiseMarkovModel,
    rng: np.random.Generator,
    *,
    detection: float = 0.98,
    clutter: float = 20.0,
) -> Run:
    """Draw truth and measurements; a track that leaves the region is redrawn."""
    packed = model.packed
    root = np.linalg.cholesky(packed.noise)
    noise_root = np.linalg.cholesky(packed.measurement_noise)
    truth = np.full((STEPS, len(TARGETS), 4), np.nan)
    returns = np.full((STEPS, len(TARGETS), 2), np.nan)
    for k, (first, last, start) in enumerate(TARGETS):
        while True:
            xi = np.empty((last - first + 1, 6))
            xi[0, :4] = start
            xi[0, 4:] = packed.observation @ xi[0, :4] + noise_root @ rng.standard_normal(2)
            for i, w in enumerate(rng.standard_normal((last - first, 6)), start=1):
                xi[i] = packed.transition @ xi[i - 1] + root @ w
            if np.all(np.abs(xi[:, [0, 2]]) <= HALF_WIDTH):
                break
        truth[first - 1 : last, k], returns[first - 1 : last, k] = xi[:, :4], xi[:, 4:]
    measurements = []
    for step in range(STEPS):
        seen = np.isfinite(returns[step, :, 0]) & (rng.random(len(TARGETS)) < detection)
        false = rng.uniform(-HALF_WIDTH, HALF_WIDTH, (rng.poisson(clutter), 2))
        measurements.append(rng.permutation(np.concatenate([returns[step, seen], false])))
    return Run(truth, measurements)
