"""JPEG's lossy step on blocks of 8 x 8 samples: discrete cosine transform, quantization, and inverse transform.

The integer arithmetic is that of libjpeg's accurate method (Loeffler, Ligtenberg and Moschytz, "Practical fast 1-D DCT
algorithms with 11 multiplications", ICASSP 1989), to the bit. Loops run over the columns, or over the blocks, of a
stripe of adjacent blocks, so that the compiler vectorizes them. For that, every intermediate is cast to 32 bits, in
which it fits, and samples and quantization steps share one array, which rules out aliasing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import FloatArray

WIDTH = 64
"""Number of columns of a stripe: eight adjacent blocks."""

_STEPS = 8 * WIDTH  # index of the first quantization step, after the samples
_BITS = 13
_ONE = 1 << _BITS
_UP = 2  # additional bits of precision in the first of two passes
_A, _B, _C = (round(x * _ONE) for x in (0.541196100, 0.765366865, 1.847759065))
_ODD = round(1.175875602 * _ONE)
_OWN = tuple(round(x * _ONE) for x in (0.298631336, 2.053119869, 3.072711026, 1.501321110))
_BOTH = tuple(round(x * _ONE) for x in (0.899976223, 2.562915447, 1.961570560, 0.390180644))
_int = np.int32

_LUMINANCE = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51,
    87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
_CHROMINANCE = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99, 47, 66, *[99] * 38,
)  # fmt: skip


def workspace(quality: int, chrominance: bool) -> tuple[NDArray[np.int32], FloatArray]:
    """Return the working arrays of a stripe, from JPEG's quantization tables (ITU-T T.81, annex K.1).

    Args:
        quality: Quality from 1 to 100, with the scale of libjpeg.
        chrominance: True for the table of chrominance, False for luminance.

    Returns:
        Array with space for the samples, followed by the quantization steps; and inverse steps, by which coefficients
        (eight times too large) are multiplied to give quantization levels.
    """
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    table = np.array(_CHROMINANCE if chrominance else _LUMINANCE)
    steps = np.tile(np.clip((table * scale + 50) // 100, 1, 255).reshape(8, 8), (1, WIDTH // 8)).ravel()
    return np.concatenate([np.zeros(_STEPS), steps]).astype(np.int32), (0.125 / steps).astype(np.float32)


@njit(cache=True, nogil=True, inline="always")
def _rotated(a, b):  # type: ignore[no-untyped-def]
    both = _int(_int(a + b) * _A)
    return _int(both - _int(a * _C)), _int(both + _int(b * _B))


@njit(cache=True, nogil=True, inline="always")
def _odd_part(a, b, c, d):  # type: ignore[no-untyped-def]
    ac, bd = _int(a + c), _int(b + d)
    both = _int(_int(ac + bd) * _ODD)
    ad, bc = _int(_int(a + d) * -_BOTH[0]), _int(_int(b + c) * -_BOTH[1])
    ac, bd = _int(both - _int(ac * _BOTH[2])), _int(both - _int(bd * _BOTH[3]))
    return (
        _int(_int(a * _OWN[0]) + _int(ad + ac)),
        _int(_int(b * _OWN[1]) + _int(bc + bd)),
        _int(_int(c * _OWN[2]) + _int(bc + ac)),
        _int(_int(d * _OWN[3]) + _int(ad + bd)),
    )


@njit(cache=True, nogil=True, inline="always")
def _forward(a, b, c, d, e, f, g, h, shift):  # type: ignore[no-untyped-def]
    """Return the eight DCT coefficients of eight samples, rounded and shifted right."""
    half = 1 << (shift - 1)
    ah, bg, cf, de = _int(a + h), _int(b + g), _int(c + f), _int(d + e)
    outer, inner = _int(ah + de), _int(bg + cf)
    u6, u2 = _rotated(_int(bg - cf), _int(ah - de))
    u7, u5, u3, u1 = _odd_part(_int(d - e), _int(c - f), _int(b - g), _int(a - h))
    return (
        _int(_int(_int(_int(outer + inner) * _ONE) + half) >> shift),
        _int(_int(u1 + half) >> shift),
        _int(_int(u2 + half) >> shift),
        _int(_int(u3 + half) >> shift),
        _int(_int(_int(_int(outer - inner) * _ONE) + half) >> shift),
        _int(_int(u5 + half) >> shift),
        _int(_int(u6 + half) >> shift),
        _int(_int(u7 + half) >> shift),
    )


@njit(cache=True, nogil=True, inline="always")
def _backward(a, b, c, d, e, f, g, h, shift):  # type: ignore[no-untyped-def]
    """Return the eight samples of eight DCT coefficients, shifted right."""
    half = 1 << (shift - 1)
    low, high = _rotated(g, c)
    plus, minus = _int(_int(_int(a + e) * _ONE) + half), _int(_int(_int(a - e) * _ONE) + half)
    v0, v3, v1, v2 = _int(plus + high), _int(plus - high), _int(minus + low), _int(minus - low)
    w3, w2, w1, w0 = _odd_part(h, f, d, b)
    return (
        _int(_int(v0 + w0) >> shift),
        _int(_int(v1 + w1) >> shift),
        _int(_int(v2 + w2) >> shift),
        _int(_int(v3 + w3) >> shift),
        _int(_int(v3 - w3) >> shift),
        _int(_int(v2 - w2) >> shift),
        _int(_int(v1 - w1) >> shift),
        _int(_int(v0 - w0) >> shift),
    )


@njit(cache=True, nogil=True, inline="always")
def _rounded(coefficient, step, inverse):  # type: ignore[no-untyped-def]
    """Quantize a coefficient, eight times too large, to the nearest multiple of its step, halves away from zero."""
    sign = _int(coefficient >> 31)
    size = _int(_int(_int(coefficient ^ sign) - sign) + _int(step * 4))
    # The added half keeps quotients away from whole numbers, so that float rounding cannot change the result.
    level = _int((np.float32(size) + np.float32(0.5)) * inverse)
    return _int(_int(_int(level * step) ^ sign) - sign)


@njit(cache=True, nogil=True)
def code_stripe(plane, top, left, room, inverses):  # type: ignore[no-untyped-def]
    """Replace the samples (minus 128) of a row of blocks by their values after coding.

    Args:
        plane: Samples, shape (rows, columns), int16; changed in place.
        top: First row.
        left: First column; `WIDTH` columns are coded.
        room: First array of `workspace`.
        inverses: Second array of `workspace`.
    """
    q = room
    for i in range(8):
        row = plane[top + i, left : left + WIDTH]
        for j in range(WIDTH):
            q[WIDTH * i + j] = row[j]
    for i in range(8):
        for block in range(WIDTH // 8):
            k = WIDTH * i + 8 * block
            q[k], q[k + 1], q[k + 2], q[k + 3], q[k + 4], q[k + 5], q[k + 6], q[k + 7] = _forward(
                q[k], q[k + 1], q[k + 2], q[k + 3], q[k + 4], q[k + 5], q[k + 6], q[k + 7], _BITS - _UP
            )
    for k in range(WIDTH):
        a, b, c, d, e, f, g, h = _forward(
            q[k],
            q[k + WIDTH],
            q[k + 2 * WIDTH],
            q[k + 3 * WIDTH],
            q[k + 4 * WIDTH],
            q[k + 5 * WIDTH],
            q[k + 6 * WIDTH],
            q[k + 7 * WIDTH],
            _BITS + _UP,
        )
        (
            q[k],
            q[k + WIDTH],
            q[k + 2 * WIDTH],
            q[k + 3 * WIDTH],
            q[k + 4 * WIDTH],
            q[k + 5 * WIDTH],
            q[k + 6 * WIDTH],
            q[k + 7 * WIDTH],
        ) = _backward(
            _rounded(a, q[_STEPS + k], inverses[k]),
            _rounded(b, q[_STEPS + WIDTH + k], inverses[WIDTH + k]),
            _rounded(c, q[_STEPS + 2 * WIDTH + k], inverses[2 * WIDTH + k]),
            _rounded(d, q[_STEPS + 3 * WIDTH + k], inverses[3 * WIDTH + k]),
            _rounded(e, q[_STEPS + 4 * WIDTH + k], inverses[4 * WIDTH + k]),
            _rounded(f, q[_STEPS + 5 * WIDTH + k], inverses[5 * WIDTH + k]),
            _rounded(g, q[_STEPS + 6 * WIDTH + k], inverses[6 * WIDTH + k]),
            _rounded(h, q[_STEPS + 7 * WIDTH + k], inverses[7 * WIDTH + k]),
            _BITS - _UP,
        )
    for i in range(8):
        for block in range(WIDTH // 8):
            k = WIDTH * i + 8 * block
            q[k], q[k + 1], q[k + 2], q[k + 3], q[k + 4], q[k + 5], q[k + 6], q[k + 7] = _backward(
                q[k], q[k + 1], q[k + 2], q[k + 3], q[k + 4], q[k + 5], q[k + 6], q[k + 7], _BITS + _UP + 3
            )
    low, high = _int(-128), _int(127)
    for i in range(8):
        row = plane[top + i, left : left + WIDTH]
        for j in range(WIDTH):
            row[j] = min(max(q[WIDTH * i + j], low), high)
