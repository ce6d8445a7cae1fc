"""Folder in which compiled kernels are kept: the first of several places in which this user can write."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import stat
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from numba.core import config
from numba.misc.appdirs import AppDirs

VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable that names the folder, as for Numba's own cache."""
DURATION = "10 to 60 s"
"""Usual time to compile what one kind of environment and its agents need."""
PACKAGE_FOLDER = Path(__file__).parent / "__pycache__"
"""Folder of compiled kernels inside the installed package."""
_QUIET = 60.0
"""Worker processes announce nothing for this long after another one has announced its compilation, s."""
_SAID: set[tuple[int, str]] = set()
"""Processes and topics of the lines that were written. A forked child has its own."""


@dataclass(frozen=True)
class KernelFolder:
    """Places of compiled kernels.

    Attributes:
        read: Folders that are searched for compiled kernels, in this order.
        write: Folder into which new ones are written; None if no place is writable.
        refused: Places that came before it, each with the reason why it is not used.
    """

    read: tuple[Path, ...]
    write: Path | None
    refused: tuple[str, ...]


@lru_cache(maxsize=1)
def kernel_folder() -> KernelFolder:
    """Choose the folder of compiled kernels, once in a process.

    The order is: `NUMBA_CACHE_DIR` if it is set, the `__pycache__` folder of the installed package, the user's cache
    folder, and a folder of the user's own in the system's folder for temporary files. The package's folder is searched
    for kernels even where it is not writable, so that an image or a system-wide installation can bring them along.
    """
    refused: list[str] = []
    read: list[Path] = []
    for place in _places():
        reason = _reason_against(place)
        # Other users may have made what cannot be used as the temporary folder.
        if reason is None or place != temporary_folder():
            read.append(place)
        if reason is None:
            return KernelFolder(tuple(read), place, tuple(refused))
        refused.append(f"{place}: {reason}")
    return KernelFolder(tuple(read), None, tuple(refused))


def announce_compilation() -> None:
    """Print one line on stderr that kernels are being compiled, how long it takes and where they are kept.

    The first call of a process prints. In worker processes the first of them prints, for all.
    """
    folder = kernel_folder()
    if multiprocessing.parent_process() is not None and (folder.write is None or _announced_lately(folder.write)):
        return
    if folder.write is None:
        text = (
            f"compiling kernels, which takes {DURATION} in every process, because no folder for them is writable "
            f"({'; '.join(folder.refused)}). Set {VARIABLE} to a folder that only you can write to"
        )
    else:
        text = f"compiling kernels for this machine, once; this takes {DURATION}. They are kept in {folder.write}"
        if folder.refused:
            text += f" (not in {'; '.join(folder.refused)}; {VARIABLE} names another folder)"
    say_once("compiling", text)


def say_once(topic: str, text: str) -> None:
    """Write one line to stderr, if there is one, unless this process has written one on the same topic."""
    if (os.getpid(), topic) in _SAID:
        return
    _SAID.add((os.getpid(), topic))
    # A closed or missing stderr is no reason to stop a computation.
    with contextlib.suppress(OSError, ValueError):
        if sys.stderr is not None:
            print(f"servotrack: {text}", file=sys.stderr, flush=True)


def _announced_lately(folder: Path) -> bool:
    mark = folder / "servotrack-compiling"
    with contextlib.suppress(OSError):
        recent = mark.exists() and time.time() - mark.stat().st_mtime < _QUIET
        if not recent:
            mark.touch()
        return recent
    return False


def _places() -> list[Path]:
    chosen: str = config.CACHE_DIR  # type: ignore[attr-defined]
    named = [Path(chosen).absolute() / "servotrack"] if chosen else []
    home = os.path.expanduser("~")
    cache = Path(AppDirs(appname="servotrack", appauthor=False).user_cache_dir)
    # An account without an entry in the user database has no home, and its "~" stays as it is.
    user = [cache] if os.path.isdir(home) and cache.is_absolute() else []
    temporary = temporary_folder()
    return [*named, PACKAGE_FOLDER, *user, *([] if temporary is None else [temporary])]


def temporary_folder() -> Path | None:
    """Return the user's own folder of compiled kernels among the temporary files; it need not exist."""
    owner = os.geteuid() if hasattr(os, "geteuid") else "user"
    try:
        return Path(tempfile.gettempdir()) / f"servotrack-kernels-{owner}"
    except FileNotFoundError:
        # No folder for temporary files is writable either.
        return None


def _reason_against(place: Path) -> str | None:
    """Make a folder and return why it cannot be used; None if it can."""
    try:
        if place == temporary_folder():
            if (reason := _make_private(place)) is not None:
                return reason
        else:
            place.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        return error.strerror or type(error).__name__
    return None


def _make_private(folder: Path) -> str | None:
    """Make a folder that only the user can enter, and return why an existing one is not trusted.

    Compiled kernels are code. Other users can write to the folder of temporary files and know this name.
    """
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    if not hasattr(os, "geteuid"):
        return None
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return "Not a directory"
    if found.st_uid != os.geteuid():
        return "Belongs to another user"
    if stat.S_IMODE(found.st_mode) & 0o077:
        return "Other users have access"
    return None
