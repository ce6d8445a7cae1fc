"""Targets that split off from others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servotrack.estimators.rfs.models import checked_covariance
from servotrack.estimators.types import Array


@dataclass(frozen=True, eq=False)
class Spawn:
    """Splitting of targets: N(d + F_beta x, Q_beta + F_beta P F_beta^T) with weight w_beta (Wu and Hu 2010, step 2.2).

    Args:
        weight: w_beta, expected number of targets split off per target and step, in (0, 1].
        noise: Q_beta, positive definite. Shape (n, n).
        transition: F_beta; None for the identity. Shape (n, n).
        offset: d; None for zero. Shape (n,).

    Raises:
        ValueError: An argument is out of range or has a wrong shape.
    """

    weight: float
    noise: Array
    transition: Array | None = None
    offset: Array | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.weight <= 1.0:
            raise ValueError(f"weight must be in (0, 1], got {self.weight!r}")
        n = np.asarray(self.noise).shape[0]
        noise = np.array(checked_covariance("noise", self.noise, n, definite=True))
        transition = np.eye(n) if self.transition is None else np.array(self.transition, dtype=np.float64)
        offset = np.zeros(n) if self.offset is None else np.array(self.offset, dtype=np.float64)
        if transition.shape != (n, n) or offset.shape != (n,):
            raise ValueError(
                f"transition and offset must match noise of shape ({n}, {n}), got {transition.shape}, {offset.shape}"
            )
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "transition", transition)
        object.__setattr__(self, "offset", offset)


def pack_spawns(spawns: Sequence[Spawn], n: int) -> tuple[Array, Array, Array, Array]:
    """Pack spawn terms for the kernels: weights (S,), offsets (S, n), transitions (S, n, n), noises (S, n, n)."""
    for spawn in spawns:
        if spawn.noise.shape != (n, n):
            raise ValueError(f"spawn noise must have shape ({n}, {n}), got {spawn.noise.shape}")
    terms = len(spawns)
    return (
        np.array([s.weight for s in spawns]),
        np.array([s.offset for s in spawns], dtype=np.float64).reshape(terms, n),
        np.array([s.transition for s in spawns], dtype=np.float64).reshape(terms, n, n),
        np.array([s.noise for s in spawns], dtype=np.float64).reshape(terms, n, n),
    )
