"""Sealed seeds: digests choose one of some equally difficult forms, and fresh seeds, for every agent by its files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

FIRST = 2**32
"""Smallest derived seed; training, tuning and test seeds lie far below."""
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


def derived_seeds(origin: str, count: int) -> list[int]:
    """Return seeds that follow from a text.

    Seed k is 2^32 plus the first 48 bits of SHA-256("origin/k"). Of two equal ones the later is left out.

    Args:
        origin: The text.
        count: Number of seeds.

    Returns:
        Different seeds, above the ranges for training, tuning and tests.
    """
    found: dict[int, None] = {}
    k = 0
    while len(found) < count:
        found.setdefault(FIRST + _bits(f"{origin}/{k}"))
        k += 1
    return list(found)


def form_of(digest: str, suite: str, forms: int) -> int:
    """Return the number of the form that an agent plays in all cells of a suite, 0 to forms - 1.

    It is the first 48 bits of SHA-256("digest/suite") modulo the number of forms.

    Args:
        digest: Digest of the agent; see `agent_digest`.
        suite: Name of the suite.
        forms: Number of forms.
    """
    return _bits(f"{digest}/{suite}") % forms


def _bits(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode("ascii")).digest()[: _BITS // 8], "big")
