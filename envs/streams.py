"""Random streams: each quantity of an episode has its own, so that a new quantity does not change the others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from servotrack.estimators.compilation import njit


class Streams:
    """Random streams of one episode, each created when it is first used.

    Args:
        seed: Seed of the episode, a non-negative integer.

    Raises:
        ValueError: The seed is negative.
    """

    def __init__(self, seed: int) -> None:
        if seed < 0:
            raise ValueError(f"seed must be a non-negative integer, got {seed!r}")
        self.seed = int(seed)
        self._made: dict[tuple[int, ...], np.random.Generator] = {}

    def __getitem__(self, stream: int | tuple[int, ...]) -> np.random.Generator:
        """Return the stream of a quantity, or of one member of it if the key is (quantity, member)."""
        key = tuple(int(part) for part in stream) if isinstance(stream, tuple) else (int(stream),)
        if key not in self._made:
            # NumPy's type hints accept only SeedSequence, but PCG64 takes any ISeedSequence.
            generator = np.random.PCG64(_Seed(self.seed, key))  # type: ignore[arg-type]
            self._made[key] = np.random.Generator(generator)
        return self._made[key]


class _Seed(ISeedSequence):
    """Bit-identical to `numpy.random.SeedSequence(seed, spawn_key=key)`, but three times as fast."""

    def __init__(self, seed: int, key: tuple[int, ...]) -> None:
        words = _words(seed)
        # Short seeds are padded: the key begins after the words that fill the pool.
        words += [0] * (_POOL - len(words))
        for part in key:
            words += _words(part)
        self._entropy = np.array(words, dtype=np.uint32)

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> NDArray[Any]:
        """Same as `numpy.random.SeedSequence.generate_state`."""
        size = np.dtype(dtype).itemsize // 4
        return _state(self._entropy, n_words * size).astype("<u4").view(dtype)


def _words(number: int) -> list[int]:
    """Split a non-negative integer into 32-bit words, lowest first."""
    digits = [number & 0xFFFFFFFF]
    while number := number >> 32:
        digits.append(number & 0xFFFFFFFF)
    return digits


_POOL = 4
_INITIAL, _FACTOR = np.uint32(0x43B0D7E5), np.uint32(0x931E8875)
_INITIAL_OUT, _FACTOR_OUT = np.uint32(0x8B51F9DD), np.uint32(0x58F38DED)
_LEFT, _RIGHT, _HALF = np.uint32(0xCA01F9DD), np.uint32(0x4973F715), np.uint32(16)


@njit(cache=True, nogil=True)
def _hashed(value, constant, factor):  # type: ignore[no-untyped-def]
    """Hash a word; also returns the constant for the next one."""
    following = np.uint32(constant * factor)
    value = np.uint32(np.uint32(value ^ constant) * following)
    return np.uint32(value ^ (value >> _HALF)), following


@njit(cache=True, nogil=True)
def _mixed(x, y):  # type: ignore[no-untyped-def]
    value = np.uint32(_LEFT * x - _RIGHT * y)
    return np.uint32(value ^ (value >> _HALF))


@njit(cache=True, nogil=True)
def _state(entropy, count):  # type: ignore[no-untyped-def]
    """Words that NumPy's SeedSequence generates from its entropy (O'Neill's seed_seq_fe)."""
    pool, constant = np.empty(_POOL, np.uint32), _INITIAL
    for i in range(_POOL):
        pool[i], constant = _hashed(entropy[i], constant, _FACTOR)
    for source in range(_POOL):
        for i in range(_POOL):
            if i != source:
                word, constant = _hashed(pool[source], constant, _FACTOR)
                pool[i] = _mixed(pool[i], word)
    for source in range(_POOL, len(entropy)):
        for i in range(_POOL):
            word, constant = _hashed(entropy[source], constant, _FACTOR)
            pool[i] = _mixed(pool[i], word)
    out, constant = np.empty(count, np.uint32), _INITIAL_OUT
    for k in range(count):
        out[k], constant = _hashed(pool[k % _POOL], constant, _FACTOR_OUT)
    return out


def episode_seed(rng: np.random.Generator) -> int:
    """Draw the seed of the next episode from an environment's generator."""
    return int(rng.integers(0, 2**63))
