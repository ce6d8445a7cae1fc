"""Mutual exclusion of many chains: a cell that another chain holds says nothing new."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d

from servotrack.estimators.types import Array


def occupancy(marginal: Array, presence: Array, positions: int, spread: int) -> Array:
    """Probability psi that a chain holds each cell of position and rate, or one next to it.

    Args:
        marginal: Of the states of a grid chain. Shape (T, S).
        presence: That the chain's object is there. Shape (T,).
        positions: Positions P of the grid.
        spread: Cells of position to each side that an object holds; of rate it is one.

    Returns:
        Shape (T, S).
    """
    T, S = marginal.shape
    cells = marginal.reshape(T, S // positions, positions)
    held = uniform_filter1d(cells, 2 * spread + 1, axis=2, mode="constant") * (2 * spread + 1)
    wide = np.pad(held, ((0, 0), (1, 1), (0, 0)))
    held = wide[:, :-2] + wide[:, 1:-1] + wide[:, 2:]
    return np.minimum(held * presence[:, None, None], 1.0).reshape(T, S)


def exclude(likelihood: Array, held: Sequence[Array]) -> Array:
    """Likelihood in which what others hold is uninformative: 1 + (b - 1) prod_m (1 - psi_m).

    A product b prod_m (1 - psi_m) instead would push tracks apart where they cross.

    Args:
        likelihood: Of the positions. Shape (T, P).
        held: `occupancy` of every other chain. Shape (T, S) each.

    Returns:
        Of the states. Shape (T, S).
    """
    T, P = likelihood.shape
    free = np.ones_like(held[0])
    for psi in held:
        free *= 1.0 - psi
    return (1.0 + (likelihood[:, None, :] - 1.0) * free.reshape(T, -1, P)).reshape(T, -1)
