"""Files that are still being written: hidden, locked by their writer, and removed once the writer is gone."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

from servotrack.baselines.running import unfinished

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PREFIX = ".unfinished-"
"""First characters of the name of a file that is still being written."""


def _own_prefix() -> str:
    """Return `PREFIX` and eight characters that stand for this machine."""
    return f"{PREFIX}{hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]}-"


@contextlib.contextmanager
def unfinished_file(folder: Path, suffix: str) -> Iterator[Path]:
    """A new empty file that is removed when the block ends, unless it was renamed.

    The writer holds a lock on the file. The kernel drops it when the process ends, however it ends, so that another
    process can tell that nothing more will be written.

    Args:
        folder: Existing folder. Files of writers that are gone are removed from it first.
        suffix: End of the name.

    Raises:
        OSError: The file cannot be created.
    """
    remove_abandoned(folder)
    with contextlib.ExitStack() as stack:
        while True:
            path = folder / f"{_own_prefix()}{secrets.token_hex(6)}{suffix}"
            # Remembered first, so that a signal between the two lines leaves nothing behind.
            unfinished.begin(path)
            stack.callback(_forget, path)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o600)
            if fcntl is None:
                # Windows renames no open file.
                os.close(handle)
                break
            stack.callback(os.close, handle)
            # File systems without locks get none: nothing is removed from them, either.
            with contextlib.suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_EX)
            if os.fstat(handle).st_nlink:
                break
            # Another process took the new file for an abandoned one before it was locked.
        yield path


def _forget(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
    unfinished.end(path)


@contextlib.contextmanager
def unfinished_folder(parent: Path) -> Iterator[Path]:
    """A new empty folder that is removed with its content when the block ends, unless it was renamed.

    It is locked as `unfinished_file` locks a file.

    Args:
        parent: Existing folder. Files and folders of writers that are gone are removed from it first.

    Raises:
        OSError: The folder cannot be created.
    """
    remove_abandoned(parent)
    path = parent / f"{_own_prefix()}{secrets.token_hex(6)}"
    unfinished.begin(path)
    with contextlib.ExitStack() as stack:
        stack.callback(unfinished.end, path)
        stack.callback(shutil.rmtree, path, ignore_errors=True)
        path.mkdir()
        if fcntl is not None:
            handle = os.open(path, os.O_RDONLY)
            stack.callback(os.close, handle)
            with contextlib.suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_EX)
        # Again, if another process took the new folder for an abandoned one before it was locked.
        path.mkdir(exist_ok=True)
        yield path


def remove_abandoned(folder: Path) -> None:
    """Remove unfinished files and folders of this machine whose writer is gone; on Windows all stay.

    Args:
        folder: The folder; subfolders are not searched.
    """
    if fcntl is None:
        return
    try:
        names = [entry.name for entry in os.scandir(folder) if entry.name.startswith(_own_prefix())]
    except OSError:
        return
    for name in names:
        with contextlib.suppress(OSError):
            handle = os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if stat.S_ISDIR(os.fstat(handle).st_mode):
                    shutil.rmtree(folder / name, ignore_errors=True)
                else:
                    os.unlink(folder / name)
            finally:
                os.close(handle)
