"""Files and folders that this process has begun to write. A stopped command removes them."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

_begun: dict[Path, Path | None] = {}


def begin(path: Path, keep_as: Path | None = None) -> None:
    """Remember a path before it is created.

    Args:
        path: Temporary path of a file or folder.
        keep_as: Final path, for a file that is valid after every write; None removes what is unfinished.
    """
    _begun[path] = keep_as


def end(path: Path) -> None:
    """Forget a path that was finished or removed."""
    _begun.pop(path, None)


def clear() -> None:
    """Remove everything that is unfinished; files with a final path move there."""
    while _begun:
        path, kept = _begun.popitem()
        with contextlib.suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif kept is not None:
                path.replace(kept)
            else:
                path.unlink(missing_ok=True)
