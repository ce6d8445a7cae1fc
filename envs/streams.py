"""Random streams: each quantity of an episode has its own, so that adding one shifts no other."""

from __future__ import annotations

import numpy as np


class Streams:
    """The random streams of one episode, each made when it is first used.

    Args:
        seed: The episode's seed, a non-negative integer.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._made: dict[tuple[int, ...], np.random.Generator] = {}

    def __getitem__(self, stream: int | tuple[int, ...]) -> np.random.Generator:
        """The stream of a quantity, or of one member of it where the key is (quantity, member)."""
        key = tuple(int(part) for part in stream) if isinstance(stream, tuple) else (int(stream),)
        if key not in self._made:
            sequence = np.random.SeedSequence(self.seed, spawn_key=key)
            self._made[key] = np.random.Generator(np.random.PCG64(sequence))
        return self._made[key]


def episode_seed(rng: np.random.Generator) -> int:
    """The seed of the next episode, drawn from an environment's own generator."""
    return int(rng.integers(0, 2**63))
