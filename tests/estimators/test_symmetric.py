"""Functions of symmetric matrices agree with SciPy and keep their bits when the number of threads changes."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import expm, sqrtm

from servotrack.estimators.symmetric import mirrored_function, symmetric_function, weighted_rows
from servotrack.estimators.types import Array

SIZES = (0, 1, 2, 3, 4, 5, 20, 61)


def drawn(n: int, seed: int = 0) -> Array:
    a = np.random.default_rng(seed).standard_normal((n, n))
    return (a + a.T) / (2.0 * np.sqrt(max(n, 1)))


@pytest.mark.parametrize("n", SIZES)
def test_functions_agree_with_scipy(n: int) -> None:
    a = drawn(n)
    np.testing.assert_allclose(symmetric_function(a, lambda values: values), a, atol=1e-13)
    if n > 0:
        np.testing.assert_allclose(symmetric_function(a, np.exp), expm(a), rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(symmetric_function(a @ a, np.sqrt), sqrtm(a @ a), atol=1e-7)


@pytest.mark.parametrize("n", SIZES)
def test_mirrored_matrices_give_the_same(n: int) -> None:
    a = drawn(n, 1)
    a = a + a[::-1, ::-1]
    np.testing.assert_allclose(mirrored_function(a, np.exp), symmetric_function(a, np.exp), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("diagonal", [[0.0, 0.0, 0.0], [4.0, 1.0, 9.0, 1.0], [1e-300, 1.0], [1e150, 1e-150, 1.0]])
def test_diagonal_and_repeated_values(diagonal: list[float]) -> None:
    np.testing.assert_allclose(symmetric_function(np.diag(diagonal), np.sqrt), np.diag(np.sqrt(diagonal)))


def test_blocks_without_links_between_them() -> None:
    a = np.zeros((6, 6))
    a[:2, :2] = a[4:, 4:] = [[2.0, 1.0], [1.0, 2.0]]
    np.testing.assert_allclose(symmetric_function(a, np.exp), expm(a), atol=1e-13)


def test_rows_are_weighted() -> None:
    rng = np.random.default_rng(2)
    weights, rows = rng.standard_normal(7), rng.standard_normal((7, 4))
    np.testing.assert_allclose(weighted_rows(weights, rows), weights @ rows, atol=1e-14)


@pytest.mark.parametrize(
    ("matrix", "message"), [(np.zeros((2, 3)), "square"), (np.full((2, 2), np.nan), "finite"), (np.zeros(3), "square")]
)
def test_other_matrices_are_refused(matrix: Array, message: str) -> None:
    for function in (symmetric_function, mirrored_function):
        with pytest.raises(ValueError, match=message):
            function(matrix, np.exp)


PROBE = """
import hashlib
import numpy as np
from servotrack.estimators.symmetric import mirrored_function, symmetric_function
a = np.random.Generator(np.random.PCG64(5)).random((300, 300))
a = a + a.T
print(*(hashlib.sha256(f(a, np.abs).tobytes()).hexdigest() for f in (symmetric_function, mirrored_function)))
"""


def test_the_number_of_threads_changes_no_bit() -> None:
    """The bits of NumPy's own eigh and products depend on it."""
    found = {
        subprocess.run(
            [sys.executable, "-c", PROBE], capture_output=True, text=True, check=True, timeout=120,
            env={**os.environ, "OMP_NUM_THREADS": count, "OPENBLAS_NUM_THREADS": count},
        ).stdout
        for count in ("1", "2")
    }  # fmt: skip
    assert len(found) == 1
