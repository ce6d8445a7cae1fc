"""Digest of a machine's floating-point results: equal digests mean that rows must be equal to the bit."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache

import numpy as np

_SCALAR_FUNCTIONS = (math.sin, math.cos, math.exp, math.log, math.atan)
"""Functions of the system's mathematics library, which compiled kernels call."""
_FUNCTIONS = (np.sin, np.cos, np.tan, np.exp, np.log, np.sqrt, np.arctan, np.log1p)
_SIZE = 1000
_MATRICES = 8


@lru_cache(maxsize=1)
def arithmetic_digest() -> str:
    """Return the first 16 hexadecimal digits of a digest over elementary functions and small matrices.

    The last bits of these depend on the processor's vector instructions and on the libraries.
    """
    draws = np.random.Generator(np.random.Philox(key=1))
    values, others = draws.uniform(0.01, 6.0, (2, _SIZE))
    matrices = draws.normal(size=(2, _MATRICES, _MATRICES))
    results = [function(values) for function in _FUNCTIONS]
    results += [np.array([function(value) for value in values]) for function in _SCALAR_FUNCTIONS]
    results += [np.hypot(values, others), np.arctan2(values, others), np.power(values, others)]
    results += [matrices[0] @ matrices[1], np.linalg.solve(matrices[0], matrices[1])]
    digest = hashlib.sha256()
    for result in results:
        digest.update(np.ascontiguousarray(result, dtype="<f8").tobytes())
    return digest.hexdigest()[:16]
