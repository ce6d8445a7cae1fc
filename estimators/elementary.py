"""Elementary functions that call the C library for each element.

NumPy's own `exp`, `log`, `power`, `arctan2` and others choose an implementation by processor, and have changed it from
version to version, with other last bits. What decides the bits of an environment or of an answer uses these.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


def cosine(angles: ArrayLike) -> Array:
    """Cosine of angles in rad, element by element."""
    x = np.ascontiguousarray(angles, np.float64)
    out = np.empty_like(x)
    _cosine(x.reshape(-1), out.reshape(-1))
    return out.reshape(np.shape(angles))


@njit(cache=True, nogil=True)
def _cosine(x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = math.cos(x[i])
