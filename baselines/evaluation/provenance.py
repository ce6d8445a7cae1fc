"""Provenance of results: versions, machine, command, and a digest of the sources that decide a row."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shlex
import sys
from datetime import datetime, timezone
from functools import lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

RECORDED_PACKAGES = ("gymnasium", "numpy", "scipy", "numba", "pymunk", "opencv-python-headless")


DECISIVE = (
    "envs",
    "estimators",
    "baselines/agents",
    "baselines/evaluation/episodes.py",
    "baselines/evaluation/evaluate.py",
    "baselines/evaluation/seeds.py",
    "baselines/evaluation/*_scores.py",
)
"""Sources that decide what a row of results holds: worlds, estimators, agents with their networks, and scoring."""
_CARRIED = {".py", ".json", ".onnx"}


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the package's version and a digest of the sources that decide a row.

    Tables, figures, papers and commands may change without making results stale.
    """
    return f"{metadata.version('servotrack')}+{digest_of_sources()}"


def digest_of_sources() -> str:
    """Return the first 12 hexadecimal digits of the SHA-256 over `DECISIVE`."""
    digest = hashlib.sha256()
    for name in DECISIVE:
        room, _, inner = name.partition("/")
        folder = Path(str(find_spec(f"servotrack.{room}").origin)).parent  # type: ignore[union-attr]
        # A pattern stands for files, so that a new kind of world counts by itself; a folder for all that is in it.
        pattern = f"{inner}/**/*" if (folder / inner).is_dir() else inner
        for source in sorted(p for p in folder.glob(pattern.lstrip("/")) if p.is_file() and p.suffix in _CARRIED):
            digest.update(f"{room}/{source.relative_to(folder).as_posix()}".encode())
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def provenance() -> dict[str, Any]:
    """Versions, machine, command and time of the present process."""
    versions = {"python": platform.python_version()}
    for package in RECORDED_PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    versions["servotrack"] = code_version()
    return {
        "versions": versions,
        "machine": {
            "system": platform.platform(),
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
        },
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
