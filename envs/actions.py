"""Check of the actions of every arm."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


def check_actions(actions: Any, shape: tuple[int, ...]) -> Array:
    """Return actions as a float64 array, after checks.

    Raises:
        ValueError: A wrong shape, or a value that is not finite.
    """
    values = np.array(actions, dtype=np.float64, order="C")
    if values.shape != shape:
        raise ValueError(f"action must have shape {shape}, one rate for each joint, got {values.shape}")
    if not _finite(values):
        raise ValueError(f"action must be finite, got {values.tolist()}; check the policy for NaN or overflow")
    return values


@njit(cache=True, nogil=True)
def _finite(values):  # type: ignore[no-untyped-def]
    """Return True if all values are finite, in a quarter of NumPy's time for two values."""
    for value in values.flat:  # noqa: SIM110
        if not math.isfinite(value):
            return False
    return True
