"""Elementary functions that call the C library for each element, and a sum from the first to the last.

NumPy's own `exp`, `log`, `power`, `arctan2` and others choose an implementation by processor, and have changed it from
version to version, with other last bits. Python's own `sum` compensates its rounding from Python 3.12 on, and the order
of NumPy's depends on the processor. What decides the bits of an environment or of an answer uses these.
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


def exponential(values: ArrayLike) -> Array:
    """Exponential function, element by element."""
    x = np.ascontiguousarray(values, np.float64)
    out = np.empty_like(x)
    _exponential(x.reshape(-1), out.reshape(-1))
    return out.reshape(np.shape(values))


def hyperbolic_tangent(values: ArrayLike) -> Array:
    """Hyperbolic tangent, element by element."""
    x = np.ascontiguousarray(values, np.float64)
    out = np.empty_like(x)
    _hyperbolic_tangent(x.reshape(-1), out.reshape(-1))
    return out.reshape(np.shape(values))


def direction(y: ArrayLike, x: ArrayLike) -> Array:
    """Angles of the points (x, y) in rad, from -pi to pi, element by element; both arrays have the same shape."""
    across, along = np.ascontiguousarray(y, np.float64), np.ascontiguousarray(x, np.float64)
    out = np.empty_like(across)
    _direction(across.reshape(-1), along.reshape(-1), out.reshape(-1))
    return out.reshape(np.shape(y))


def power(base: ArrayLike, exponents: ArrayLike) -> Array:
    """Powers of numbers, element by element; both arrays have the same shape."""
    x, y = np.ascontiguousarray(base, np.float64), np.ascontiguousarray(exponents, np.float64)
    out = np.empty_like(x)
    _power(x.reshape(-1), y.reshape(-1), out.reshape(-1))
    return out.reshape(np.shape(base))


def sum_in_order(values: ArrayLike) -> float:
    """Sum of numbers, added one after the other from the first on; 0 for an empty array. Shape (n,)."""
    x = np.asarray(values, np.float64)
    return float(np.cumsum(x)[-1]) if x.size else 0.0


@njit(cache=True, nogil=True)
def _cosine(x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = math.cos(x[i])


@njit(cache=True, nogil=True)
def _exponential(x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = math.exp(x[i])


@njit(cache=True, nogil=True)
def _hyperbolic_tangent(x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = math.tanh(x[i])


@njit(cache=True, nogil=True)
def _direction(y, x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = math.atan2(y[i], x[i])


@njit(cache=True, nogil=True)
def _power(x, y, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = math.pow(x[i], y[i])
