"""Trace files: the actions of all episodes of a cell, compressed without loss.

A file begins with the eight bytes "STTRACE1" and four little-endian 32-bit integers: episodes E, numbers per action n,
steps of the grid, and steps S of all episodes together. Then come the E lengths, 32 bits each, and a zlib stream of
2 n S bytes. The numbers are ordered by component, then episode, then step. Each is the difference from the one before
in the same episode (the first from 0), modulo 2^16, with the sign in the lowest bit (0, -1, 1, -2 become 0, 1, 2, 3).
First come the high bytes of all numbers, then the low bytes.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAGIC = b"STTRACE1"
MOST_NUMBERS = 5_000_000
"""Largest accepted number of grid points in a trace: 10 MB."""
LARGEST_TRACE = 12_000_000
"""Largest accepted size of a trace file, bytes."""
_HEADER = struct.Struct("<8sIIII")
_LEVEL = 9


@dataclass(frozen=True)
class Trace:
    """Actions of the episodes of a cell, as grid points.

    Attributes:
        grid: Steps of the grid; see `ActionGrid`.
        episodes: One array per episode, shape (steps, n), int16.
    """

    grid: int
    episodes: tuple[NDArray[np.int16], ...]

    @property
    def lengths(self) -> list[int]:
        """Steps of each episode."""
        return [len(episode) for episode in self.episodes]


def encoded(trace: Trace) -> bytes:
    """Return the content of a trace file.

    Args:
        trace: At least one episode of at least one step.
    """
    width = trace.episodes[0].shape[1]
    changes = [np.diff(episode, axis=0, prepend=np.zeros((1, width), np.int16)) for episode in trace.episodes]
    numbers = np.concatenate(changes).T.reshape(-1)
    folded = ((numbers << 1) ^ (numbers >> 15)).view(np.uint16)
    planes = (folded >> 8).astype(np.uint8).tobytes() + (folded & 255).astype(np.uint8).tobytes()
    lengths = np.array(trace.lengths, "<u4")
    header = _HEADER.pack(MAGIC, len(lengths), width, trace.grid, int(lengths.sum()))
    return header + lengths.tobytes() + zlib.compress(planes, _LEVEL)


def decoded(content: bytes, episodes: int, width: int, grid: int, longest: int) -> Trace:
    """Read a trace file of unknown origin.

    Args:
        content: Content of the file.
        episodes: Required number of episodes.
        width: Required numbers per action.
        grid: Required steps of the grid.
        longest: Largest number of steps of an episode.

    Raises:
        ValueError: Not a trace file, damaged, or other than required; nothing larger than declared is inflated.
    """
    if len(content) < _HEADER.size:
        raise ValueError(f"a trace file has at least {_HEADER.size} bytes, got {len(content)}")
    magic, count, numbers, steps, total = _HEADER.unpack_from(content)
    if magic != MAGIC:
        raise ValueError(f"a trace file begins with {MAGIC.decode()}")
    found = {"episodes": count, "numbers per action": numbers, "steps of the grid": steps}
    for (name, value), required in zip(found.items(), (episodes, width, grid), strict=True):
        if value != required:
            raise ValueError(f"{name} must be {required}, got {value}")
    begin = _HEADER.size + 4 * episodes
    if len(content) < begin:
        raise ValueError("the file ends within the lengths of its episodes")
    lengths = np.frombuffer(content, "<u4", episodes, _HEADER.size).astype(np.int64)
    if lengths.min() < 1 or lengths.max() > longest or lengths.sum() != total or total * width > MOST_NUMBERS:
        raise ValueError(f"lengths of episodes must be 1 to {longest} and add up to {total}")
    folded = _inflated(content[begin:], 2 * total * width).astype(np.uint16)
    high, low = folded[: total * width], folded[total * width :]
    joined = (high << 8) | low
    changes = ((joined >> 1) ^ (np.uint16(0) - (joined & 1))).view(np.int16).reshape(width, total).T
    points = tuple(
        np.cumsum(part, axis=0, dtype=np.int16) for part in np.split(changes, np.cumsum(lengths)[:-1].tolist())
    )
    _check_points(points, grid)
    return Trace(grid, points)


def _inflated(stream: bytes, size: int) -> NDArray[np.uint8]:
    inflater = zlib.decompressobj()
    try:
        plain = inflater.decompress(stream, size + 1)
    except zlib.error as error:
        raise ValueError(f"its zlib stream is damaged ({error})") from error
    if len(plain) != size or not inflater.eof or inflater.unused_data:
        raise ValueError(f"its zlib stream must hold {size} bytes and end with the file")
    return np.frombuffer(plain, np.uint8)


def _check_points(points: Sequence[NDArray[np.int16]], grid: int) -> None:
    for k, episode in enumerate(points):
        if (np.abs(episode.astype(np.int32)) > grid).any():
            raise ValueError(f"actions of episode {k} must lie within {grid} steps of the grid")
