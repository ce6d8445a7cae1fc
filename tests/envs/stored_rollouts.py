"""Stored rollouts: reading, writing, and hashes from another process."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Rollout = Callable[[Any], Mapping[str, Any]]


def stored_rollout(file: Path, case: Any) -> dict[str, Any]:
    """Return the stored arrays of a case, by quantity."""
    with np.load(file) as stored:
        return {name.split("/")[1]: stored[name] for name in stored if name.startswith(f"{case}/")}


def assert_as_stored(
    file: Path, case: Any, history: Mapping[str, Any], images: Iterable[str] = (), tolerance: float = 1e-6
) -> None:
    """Compare a rollout with the stored one: numbers to a relative tolerance, images to a mean difference below 1."""
    stored = stored_rollout(file, case)
    assert stored.keys() == history.keys()
    for name, values in history.items():
        if name in images:
            assert np.abs(np.asarray(values, dtype=np.float64) - stored[name]).mean() < 1.0
        else:
            np.testing.assert_allclose(values, stored[name], rtol=tolerance, atol=1e-3 * tolerance, err_msg=name)


def digests(rollout: Rollout, cases: Iterable[Any]) -> list[str]:
    """Hash all bits of each case."""
    found = []
    for case in cases:
        sha = hashlib.sha256()
        for name, values in sorted(rollout(case).items()):
            sha.update(name.encode() + np.ascontiguousarray(values).tobytes())
        found.append(sha.hexdigest())
    return found


def digests_elsewhere(script: str, **variables: str) -> list[str]:
    """Return the hashes that a test file prints when run with --digests in another process with these variables."""
    out = subprocess.run(
        [sys.executable, script, "--digests"], capture_output=True, text=True, check=True, timeout=300,
        env={**os.environ, **variables},
    )  # fmt: skip
    return out.stdout.split()


def print_or_store(file: Path, rollout: Rollout, cases: Iterable[Any]) -> None:
    """Main function of a test file: with --digests print the hashes, else write the stored rollouts anew."""
    if "--digests" in sys.argv:
        print("\n".join(digests(rollout, cases)))
        return
    arrays = {f"{case}/{name}": values for case in cases for name, values in rollout(case).items()}
    np.savez_compressed(file, **arrays)
