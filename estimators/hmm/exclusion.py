"""Mutual exclusion of several chains: a cell occupied by another chain becomes uninformative."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d

from servotrack.estimators.hmm.smoothing import CANCELED
from servotrack.estimators.types import Array


def occupancy(marginal: Array, presence: Array, positions: int, spread: int) -> Array:
    """Probability psi that a chain occupies each cell of position and rate, or a neighboring one.

    Args:
        marginal: Probabilities of the states of a grid chain. Shape (T, S).
        presence: Probability that the chain's object is present. Shape (T,).
        positions: Number P of positions of the grid.
        spread: Cells of position that an object occupies to each side; in rate it is one cell. Larger values keep
            chains farther apart.

    Returns:
        Probabilities. Shape (T, S).
    """
    T, S = marginal.shape
    cells = marginal.reshape(T, S // positions, positions)
    held = uniform_filter1d(cells, 2 * spread + 1, axis=2, mode="constant") * (2 * spread + 1)
    wide = np.pad(held, ((0, 0), (1, 1), (0, 0)))
    held = wide[:, :-2] + wide[:, 1:-1] + wide[:, 2:]
    return np.minimum(held * presence[:, None, None], 1.0).reshape(T, S)


def exclude(likelihood: Array, held: Sequence[Array]) -> Array:
    """Make cells occupied by other chains uninformative: 1 + (b - 1) prod_m (1 - psi_m).

    The product b prod_m (1 - psi_m) would push tracks apart where they cross.

    Args:
        likelihood: Likelihood ratios b of the positions. Shape (T, P).
        held: `occupancy` of every other chain. Shape (T, S) each.

    Returns:
        Likelihood ratios of the states. Shape (T, S).
    """
    T, P = likelihood.shape
    free = np.ones_like(held[0])
    for psi in held:
        free *= 1.0 - psi
    share = free.reshape(T, -1, P)
    mixed = 1.0 + (likelihood[:, None, :] - 1.0) * share
    # Where the difference loses digits, the sum of both parts is taken.
    return np.where(mixed > CANCELED, mixed, (1.0 - share) + share * likelihood[:, None, :]).reshape(T, -1)
