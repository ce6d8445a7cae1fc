"""Sealed seeds: they follow from the bytes of an agent's files, so that no agent can have been tuned on its own."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

FIRST = 2**32
"""Smallest sealed seed; training, tuning and test seeds lie far below."""
_BITS = 48
"""Random bits of a seed. JavaScript holds whole numbers up to 2^53."""


def agent_digest(files: Mapping[str, bytes]) -> str:
    """Return the SHA-256 digest of an agent's files, with their names.

    Args:
        files: Contents by name.
    """
    digest = hashlib.sha256()
    for name in sorted(files):
        for part in (name.encode("utf-8"), files[name]):
            digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def sealed_seeds(digest: str, suite: str, cell: str, count: int) -> list[int]:
    """Return the sealed seeds of an agent in a cell.

    Seed k is 2^32 plus the first 48 bits of SHA-256("digest/suite/cell/k"). Of two equal ones the later is left out.

    Args:
        digest: Digest of the agent; see `agent_digest`.
        suite: Name of the suite.
        cell: Name of the cell.
        count: Number of seeds.

    Returns:
        Different seeds, above the ranges for training, tuning and tests.
    """
    found: dict[int, None] = {}
    k = 0
    while len(found) < count:
        drawn = hashlib.sha256(f"{digest}/{suite}/{cell}/{k}".encode("ascii")).digest()
        found.setdefault(FIRST + int.from_bytes(drawn[: _BITS // 8], "big"))
        k += 1
    return list(found)
