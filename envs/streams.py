"""Random streams: each quantity of an episode has its own, so that a new quantity does not change the others."""

from __future__ import annotations

import math
from pathlib import Path
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
    """Bit-identical to `numpy.random.SeedSequence(seed, spawn_key=key)`, but many times as fast."""

    def __init__(self, seed: int, key: tuple[int, ...]) -> None:
        self._seed, self._key = seed, key

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> NDArray[Any]:
        """Same as `numpy.random.SeedSequence.generate_state`."""
        if n_words == 4 and dtype is np.uint64 and len(self._key) == 1 and self._seed < 2**63 > self._key[0]:
            return np.array(_seed_words(self._seed, self._key[0]), np.uint64)
        words = _words(self._seed)
        # Short seeds are padded: the key begins after the words that fill the pool.
        words += [0] * (_POOL - len(words))
        for part in self._key:
            words += _words(part)
        size = np.dtype(dtype).itemsize // 4
        return _state(np.array(words, dtype=np.uint32), n_words * size).astype("<u4").view(dtype)


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


@njit(cache=True, nogil=True)
def _seed_words(seed, stream):  # type: ignore[no-untyped-def]
    """Four words of 64 bits for a seed and a stream below 2^64, see `_Seed`."""
    long_key = np.uint64(stream) >> _WORD > np.uint64(0)
    entropy = np.zeros(_POOL + 2 if long_key else _POOL + 1, np.uint32)
    entropy[0], entropy[1] = np.uint32(np.uint64(seed) & _LOW), np.uint32(np.uint64(seed) >> _WORD)
    entropy[_POOL] = np.uint32(np.uint64(stream) & _LOW)
    if long_key:
        entropy[_POOL + 1] = np.uint32(np.uint64(stream) >> _WORD)
    out = _state(entropy, 8)
    return (
        np.uint64(out[0]) | np.uint64(out[1]) << _WORD,
        np.uint64(out[2]) | np.uint64(out[3]) << _WORD,
        np.uint64(out[4]) | np.uint64(out[5]) << _WORD,
        np.uint64(out[6]) | np.uint64(out[7]) << _WORD,
    )


_WORD, _LOW = np.uint64(32), np.uint64(0xFFFFFFFF)
_ONE, _ALL_BITS, _UNUSED_BITS, _TURN = np.uint64(1), np.uint64(63), np.uint64(11), np.uint64(58)
_MULTIPLIER_HIGH, _MULTIPLIER_LOW = np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645)


@njit(cache=True, nogil=True)
def start_stream(seed, stream, state):  # type: ignore[no-untyped-def]
    """Start a stream for compiled draws: the same numbers as `Streams(seed)[stream]`.

    Args:
        seed: Seed of the episode, below 2^64.
        stream: Number of the stream.
        state: Output: state and increment of PCG64 (O'Neill 2014), high and low words each. Shape (4,), uint64.
    """
    first, second, third, fourth = _seed_words(seed, stream)
    state[2], state[3] = third << _ONE | fourth >> _ALL_BITS, fourth << _ONE | _ONE
    # From zero, the first step gives the increment.
    state[0], state[1] = _sum(state[2], state[3], first, second)
    _advance(state)


@njit(cache=True, nogil=True)
def _sum(high, low, other_high, other_low):  # type: ignore[no-untyped-def]
    """Sum of two numbers of 128 bits."""
    total = low + other_low
    return high + other_high + np.uint64(total < low), total


@njit(cache=True, nogil=True)
def _advance(state):  # type: ignore[no-untyped-def]
    """Multiply by PCG64's factor and add the increment, modulo 2^128."""
    low, factor = state[1], _MULTIPLIER_LOW
    a, b, c, d = low >> _WORD, low & _LOW, factor >> _WORD, factor & _LOW
    middle = a * d + (b * d >> _WORD)
    carry = (middle & _LOW) + b * c
    high = a * c + (middle >> _WORD) + (carry >> _WORD)
    high += state[0] * factor + low * _MULTIPLIER_HIGH
    state[0], state[1] = _sum(high, low * factor, state[2], state[3])


@njit(cache=True, nogil=True)
def _draw_word(state):  # type: ignore[no-untyped-def]
    """Draw a number of 64 bits."""
    _advance(state)
    word, turn = state[0] ^ state[1], state[0] >> _TURN
    return word >> turn | word << (np.uint64(64) - turn & _ALL_BITS)


@njit(cache=True, nogil=True)
def draw_share(state):  # type: ignore[no-untyped-def]
    """Draw from [0, 1): `Generator.random()`."""
    return (_draw_word(state) >> _UNUSED_BITS) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def draw_uniform(state, low, high):  # type: ignore[no-untyped-def]
    """Draw from [low, high): `Generator.uniform(low, high)`."""
    return low + (high - low) * draw_share(state)


@njit(cache=True, nogil=True)
def draw_index(state, count):  # type: ignore[no-untyped-def]
    """Draw from 0 to `count` - 1, at most 2^32: `Generator.integers(count)` (Lemire 2019).

    Args:
        state: State of a stream, followed by two words that are zeros at first, (6,) uint64. They keep the second half
            of a number of 64 bits for the next draw.
        count: Number of values.
    """
    if count == 1:
        return 0
    bound = np.uint64(count)
    least = (np.uint64(2**32) - bound) % bound
    while True:
        if state[4] > np.uint64(0):
            half, state[4] = state[5], np.uint64(0)
        else:
            word = _draw_word(state)
            half, state[4], state[5] = word & _LOW, _ONE, word >> _WORD
        product = half * bound
        if (product & _LOW) >= least:
            return np.int64(product >> _WORD)


_LAYERS = np.load(Path(__file__).with_name("ziggurat.npy"))
"""NumPy's tables of the ziggurat method (Marsaglia and Tsang 2000), 256 layers of the normal and of the exponential
density: shares of a layer that need no test, widths, and heights at the edges. They are stored because no formula
gives their last bits."""
_NORMAL_BOUNDS, _NORMAL_WIDTHS, _NORMAL_HEIGHTS, _EXPONENTIAL_BOUNDS, _EXPONENTIAL_WIDTHS, _EXPONENTIAL_HEIGHTS = (
    np.ascontiguousarray(_LAYERS[name]) for name in _LAYERS.dtype.names
)
_NORMAL_TAIL, _NORMAL_TAIL_INVERSE, _EXPONENTIAL_TAIL = 3.6541528853610088, 0.27366123732975828, 7.69711747013104972
_LAYER, _LAYER_BITS, _SHARE = np.uint64(0xFF), np.uint64(8), np.uint64(2**52 - 1)


@njit(cache=True, nogil=True)
def draw_normal(state):  # type: ignore[no-untyped-def]
    """Draw from the standard normal distribution: `Generator.standard_normal()`."""
    while True:
        word = _draw_word(state)
        layer, word = word & _LAYER, word >> _LAYER_BITS
        share = word >> _ONE & _SHARE
        x = np.float64(share) * _NORMAL_WIDTHS[layer]
        if word & _ONE:
            x = -x
        if share < _NORMAL_BOUNDS[layer]:
            return x
        if layer == 0:
            while True:
                beyond = -_NORMAL_TAIL_INVERSE * math.log1p(-draw_share(state))
                height = -math.log1p(-draw_share(state))
                if height + height > beyond * beyond:
                    return -(_NORMAL_TAIL + beyond) if share >> _LAYER_BITS & _ONE else _NORMAL_TAIL + beyond
        upper, lower = _NORMAL_HEIGHTS[layer - _ONE], _NORMAL_HEIGHTS[layer]
        if (upper - lower) * draw_share(state) + lower < math.exp(-0.5 * x * x):
            return x


@njit(cache=True, nogil=True)
def draw_exponential(state):  # type: ignore[no-untyped-def]
    """Draw from the exponential distribution with mean 1: `Generator.standard_exponential()`."""
    while True:
        word = _draw_word(state) >> np.uint64(3)
        layer, share = word & _LAYER, word >> _LAYER_BITS
        x = np.float64(share) * _EXPONENTIAL_WIDTHS[layer]
        if share < _EXPONENTIAL_BOUNDS[layer]:
            return x
        if layer == 0:
            return _EXPONENTIAL_TAIL - math.log1p(-draw_share(state))
        upper, lower = _EXPONENTIAL_HEIGHTS[layer - _ONE], _EXPONENTIAL_HEIGHTS[layer]
        if (upper - lower) * draw_share(state) + lower < math.exp(-x):
            return x


@njit(cache=True, nogil=True)
def draw_laplace(state, scale):  # type: ignore[no-untyped-def]
    """Draw from the Laplace distribution about 0: `Generator.laplace(0.0, scale)`."""
    while True:
        share = draw_share(state)
        if share >= 0.5:
            return 0.0 - scale * math.log(2.0 - share - share)
        if share > 0.0:
            return 0.0 + scale * math.log(share + share)


def episode_seed(rng: np.random.Generator) -> int:
    """Draw the seed of the next episode from an environment's generator."""
    bits = rng.bit_generator
    if isinstance(bits, np.random.PCG64):
        # The same number in a fifth of the time.
        return int(bits.random_raw()) >> 1
    return int(rng.integers(0, 2**63))
