"""Functions of symmetric matrices in compiled loops: the same bits with every linear algebra library and thread count.

Products and decompositions of NumPy and SciPy sum in an order that depends on the library's version, on the processor
and on the number of threads. What decides the bits of an environment is computed here instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

_SWEEPS = 60
"""Largest number of QL iterations for one eigenvalue; two are usual."""


def weighted_rows(weights: Array, rows: Array) -> Array:
    """Return `weights @ rows`, added row by row.

    Args:
        weights: Factors. Shape (n,).
        rows: Shape (n, m).

    Returns:
        Weighted sum of the rows. Shape (m,).
    """
    out = np.zeros(rows.shape[1])
    _add_rows(np.ascontiguousarray(weights), np.ascontiguousarray(rows), out)
    return out


def mirrored_function(matrix: Array, function: Callable[[Array], Array]) -> Array:
    """Apply a function to the eigenvalues of a symmetric matrix that is also symmetric about its other diagonal.

    Such a matrix, with A[i, j] = A[n - 1 - i, n - 1 - j], splits into one of mirrored and one of antisymmetric vectors,
    which takes a quarter of the time. The correlation of beams that lie symmetrically about broadside is one.

    Args:
        matrix: Shape (n, n). Deviations from the symmetries, such as rounding, are averaged out.
        function: Function of an array of eigenvalues, element by element.

    Returns:
        The function of the matrix. Shape (n, n).

    Raises:
        ValueError: The matrix is not square, or an entry is NaN or infinite.
    """
    _check(matrix)
    n, half = len(matrix), len(matrix) // 2
    middle = n - half
    a = (matrix + matrix.T) / 2.0
    a = (a + a[::-1, ::-1]) / 2.0
    near, far = a[:half, :half], a[:half, ::-1][:, :half]
    even = np.empty((middle, middle))
    even[:half, :half] = near + far
    if middle > half:
        even[:half, half] = even[half, :half] = math.sqrt(2.0) * a[:half, half]
        even[half, half] = a[half, half]
    same, opposite = symmetric_function(even, function), symmetric_function(near - far, function)
    out = np.empty_like(a)
    out[:half, :half] = (same[:half, :half] + opposite) / 2.0
    out[:half, n - half :] = ((same[:half, :half] - opposite) / 2.0)[:, ::-1]
    if middle > half:
        out[:half, half] = same[:half, half] / math.sqrt(2.0)
        out[half, half] = same[half, half]
        out[half, :half] = out[:half, half]
        out[half, middle:] = out[half, :half][::-1]
    out[middle:] = out[:half][::-1, ::-1]
    return out


def symmetric_function(matrix: Array, function: Callable[[Array], Array]) -> Array:
    """Apply a function to the eigenvalues of a symmetric matrix.

    Args:
        matrix: Symmetric matrix. Shape (n, n).
        function: Function of an array of eigenvalues, element by element.

    Returns:
        The function of the matrix. Shape (n, n).

    Raises:
        ValueError: The matrix is not square, or an entry is NaN or infinite.
    """
    _check(matrix)
    vectors = np.array(matrix, np.float64, order="C")
    if not len(vectors):
        return vectors
    values, beside = np.zeros(len(vectors)), np.zeros(len(vectors))
    _tridiagonalize(vectors, values, beside)
    vectors = np.ascontiguousarray(vectors.T)
    if not _diagonalize(vectors, values, beside):
        raise ArithmeticError(f"no eigenvalue was found in {_SWEEPS} iterations; scale the matrix")
    out = np.zeros_like(vectors)
    _compose(vectors, np.ascontiguousarray(function(values)), out)
    return out


def _check(matrix: Array) -> None:
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"matrix must be square, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError("matrix must be finite, got NaN or infinity")


@njit(cache=True, nogil=True)
def _add_rows(weights, rows, out):  # type: ignore[no-untyped-def]
    for i in range(len(weights)):
        weight = weights[i]
        for j in range(len(out)):
            out[j] += weight * rows[i, j]


@njit(cache=True, nogil=True)
def _compose(vectors, values, out):  # type: ignore[no-untyped-def]
    """Sum values[k] v_k v_k^T over the rows v_k of `vectors`."""
    n = len(values)
    for i in range(n):
        row = out[i]
        for k in range(n):
            weight = values[k] * vectors[k, i]
            for j in range(n):
                row[j] += weight * vectors[k, j]


@njit(cache=True, nogil=True)
def eigenvectors(matrix, values):  # type: ignore[no-untyped-def]
    """Decompose a symmetric matrix in compiled code.

    Args:
        matrix: Finite symmetric matrix; it stays as it is. Shape (n, n).
        values: Filled with the eigenvalues, in no particular order. Shape (n,).

    Returns:
        Eigenvectors as rows. Shape (n, n).
    """
    vectors, beside = matrix.copy(), np.zeros(len(values))
    _tridiagonalize(vectors, values, beside)
    vectors = vectors.T.copy()
    _diagonalize(vectors, values, beside)
    return vectors


@njit(cache=True, nogil=True)
def _tridiagonalize(a, diagonal, beside):  # type: ignore[no-untyped-def]
    """Householder's reduction of a symmetric matrix, in place: A = Q T Q^T, and Q replaces A.

    `beside[i]` is the entry of T between the rows i - 1 and i (Golub and Van Loan, Matrix Computations, sec. 8.3.1).
    """
    n = len(diagonal)
    reflections, lengths = np.zeros((n, n)), np.zeros(n)
    product = np.empty(n)
    for k in range(n - 2):
        # The reflection maps the column below the diagonal to its first entry.
        v = reflections[k]
        scale = 0.0
        for i in range(k + 1, n):
            scale = max(scale, abs(a[k, i]))
        if scale == 0.0:
            continue
        norm = 0.0
        for i in range(k + 1, n):
            v[i] = a[k, i] / scale
            norm += v[i] * v[i]
        norm = math.sqrt(norm)
        if v[k + 1] > 0.0:
            norm = -norm
        v[k + 1] -= norm
        length = -norm * v[k + 1]
        lengths[k] = length
        product[k + 1 :] = 0.0
        for i in range(k + 1, n):
            weight = v[i] / length
            for j in range(k + 1, n):
                product[j] += weight * a[i, j]
        inner = 0.0
        for i in range(k + 1, n):
            inner += v[i] * product[i]
        half = inner / (2.0 * length)
        for i in range(k + 1, n):
            product[i] -= half * v[i]
        for i in range(k + 1, n):
            one, other = v[i], product[i]
            for j in range(k + 1, n):
                a[i, j] -= one * product[j] + other * v[j]
        beside[k + 1] = scale * norm
    if n > 1:
        beside[n - 1] = a[n - 2, n - 1]
        if n > 2 and lengths[n - 3] == 0.0:
            beside[n - 2] = a[n - 3, n - 2]
    for i in range(n):
        diagonal[i] = a[i, i]
    a[:] = 0.0
    for i in range(n):
        a[i, i] = 1.0
    for k in range(n - 3, -1, -1):
        if lengths[k] == 0.0:
            continue
        v = reflections[k]
        product[k + 1 :] = 0.0
        for i in range(k + 1, n):
            weight = v[i] / lengths[k]
            for j in range(k + 1, n):
                product[j] += weight * a[i, j]
        for i in range(k + 1, n):
            weight = v[i]
            for j in range(k + 1, n):
                a[i, j] -= weight * product[j]


@njit(cache=True, nogil=True)
def _diagonalize(vectors, diagonal, beside):  # type: ignore[no-untyped-def]
    """Find the eigenvalues of a tridiagonal matrix by the implicit QL algorithm, and turn the rows of `vectors` along.

    Returns False if an iteration does not end (Golub and Van Loan, sec. 8.3.3; Bowdler et al., Num. Math. 11, 1968).
    """
    n = len(diagonal)
    for i in range(1, n):
        beside[i - 1] = beside[i]
    beside[n - 1] = 0.0
    for low in range(n):
        for turn in range(_SWEEPS + 1):
            high = low
            while high < n - 1:
                around = abs(diagonal[high]) + abs(diagonal[high + 1])
                if abs(beside[high]) <= 2.3e-16 * around:
                    break
                high += 1
            if high == low:
                break
            if turn == _SWEEPS:
                return False
            shift = (diagonal[low + 1] - diagonal[low]) / (2.0 * beside[low])
            root = math.sqrt(shift * shift + 1.0)
            g = diagonal[high] - diagonal[low] + beside[low] / (shift + (root if shift >= 0.0 else -root))
            sine, cosine, p = 1.0, 1.0, 0.0
            split = False
            for i in range(high - 1, low - 1, -1):
                f, b = sine * beside[i], cosine * beside[i]
                root = math.sqrt(f * f + g * g)
                beside[i + 1] = root
                if root == 0.0:
                    diagonal[i + 1] -= p
                    beside[high] = 0.0
                    split = True
                    break
                sine, cosine = f / root, g / root
                g = diagonal[i + 1] - p
                root = (diagonal[i] - g) * sine + 2.0 * cosine * b
                p = sine * root
                diagonal[i + 1] = g + p
                g = cosine * root - b
                one, other = vectors[i], vectors[i + 1]
                for j in range(n):
                    after = other[j]
                    other[j] = sine * one[j] + cosine * after
                    one[j] = cosine * one[j] - sine * after
            if split:
                continue
            diagonal[low] -= p
            beside[low] = g
            beside[high] = 0.0
    return True
