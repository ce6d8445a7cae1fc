"""Files that are written whole or not at all, and JSON documents that name their own format."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from servotrack.baselines.reporting.strict import parse_json, parse_yaml
from servotrack.baselines.reporting.temporary import unfinished_file, unfinished_folder

LARGEST_DOCUMENT = 64_000_000
"""Largest accepted size of a JSON document of this package, bytes: results of some 200,000 episodes."""
LARGEST_YAML = 500_000
"""Largest accepted size of a YAML file, bytes."""


_MACHINE_TROUBLE = frozenset(
    getattr(errno, name)
    for name in ("ENOSPC", "EDQUOT", "EROFS", "EIO", "EFBIG", "ESTALE", "ENODEV", "ENXIO", "EMFILE", "ENFILE", "ENOLCK")
    if hasattr(errno, name)
)
_LOCK = ".lock"
_LONGEST_WAIT = 120.0
"""Time that a process waits for the lock of a folder, s. It is held for one save, a second for 100,000 episodes."""


class ResultsError(Exception):
    """A results folder or file that cannot be used; the message names the path and the remedy."""


class StorageError(ResultsError):
    """Trouble of the machine: a full disk, a quota, a folder that is read-only or vanished. Commands exit with 1."""


def storage_error(path: Path, error: OSError) -> StorageError:
    """Return the error to raise when `path` could not be written."""
    return StorageError(
        f"{path} cannot be written ({error.strerror or error}); free space, mend the folder or choose another one, and "
        "run the command again: files that were complete are as they were"
    )


def is_machine_trouble(error: OSError) -> bool:
    """Return True for a full disk, an exceeded quota, a read-only or failing file system."""
    return error.errno in _MACHINE_TROUBLE


@contextlib.contextmanager
def temporary_in(folder: Path, suffix: str) -> Iterator[Path]:
    """A new empty file in `folder`, which is made where it is missing. The file is removed at the end of the block.

    Raises:
        ResultsError: The folder's name is that of a file.
        StorageError: The folder cannot be made or written.
    """
    with contextlib.ExitStack() as stack:
        yield _entered(stack, folder, lambda: unfinished_file(folder, suffix))


@contextlib.contextmanager
def temporary_folder_in(folder: Path) -> Iterator[Path]:
    """A new empty folder in `folder`, which is made where it is missing. It is removed at the end of the block.

    Raises:
        ResultsError: The folder's name is that of a file.
        StorageError: The folder cannot be made or written.
    """
    with contextlib.ExitStack() as stack:
        yield _entered(stack, folder, lambda: unfinished_folder(folder))


def _entered(
    stack: contextlib.ExitStack, folder: Path, unfinished: Callable[[], contextlib.AbstractContextManager[Path]]
) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return stack.enter_context(unfinished())
    except (FileExistsError, NotADirectoryError) as error:
        raise ResultsError(f"{folder} cannot be a folder: a file has that name; choose another folder") from error
    except OSError as error:
        raise StorageError(
            f"{folder} is not writable ({error.strerror}); change its permissions or choose another folder"
        ) from error


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block succeeds and vanishes when it fails.

    Raises:
        ResultsError: The folder's name is that of a file.
        StorageError: The folder is read-only or vanished, the disk is full, or a quota is exceeded. An earlier file is
            as it was.
    """
    try:
        with temporary_in(path.parent, path.suffix) as temporary:
            yield temporary
            _sync(temporary)
            # Temporary files can be read by their owner only.
            temporary.chmod(0o666 & ~_umask())
            temporary.replace(path)
    except OSError as error:
        own = error.filename is not None and Path(os.fsdecode(error.filename)).parent == path.parent
        if own or is_machine_trouble(error):
            raise storage_error(path, error) from error
        raise


def _sync(path: Path) -> None:
    """Wait until a file is on the disk. Network file systems report quotas and full disks here at the latest."""
    handle = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, in which one process at a time reads, merges and replaces files.

    The lock is the hidden file `.lock`. The kernel releases it when a process ends, however it ends; a file system
    without locks gets a file that says who holds it.

    Args:
        folder: Made where it is missing.

    Raises:
        ResultsError: The folder's name is that of a file.
        StorageError: The folder cannot be written, supports no locks, or another process keeps the lock for minutes.
    """
    from filelock import FileLock, Timeout

    path = folder / _LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path, timeout=_LONGEST_WAIT, mode=0o666 & ~_umask())
        lock.acquire(poll_interval=0.01)
    except (FileExistsError, NotADirectoryError) as error:
        raise ResultsError(f"{folder} cannot be a folder: a file has that name; choose another folder") from error
    except Timeout as error:
        raise StorageError(
            f"{path} has been held by another process for {_LONGEST_WAIT:.0f} s; end that process, or remove the file "
            "if no process uses the folder"
        ) from error
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise StorageError(
            f"{path} cannot be locked ({reason}); make the folder writable, or choose one on a file system with locks"
        ) from error
    try:
        yield
    finally:
        lock.release()


def read_bounded(path: Path, limit: int, follow: bool = True) -> bytes:
    """Read a regular file of at most `limit` bytes. Pipes and devices are refused without waiting.

    Args:
        path: The file.
        limit: Largest accepted size, bytes.
        follow: False refuses a path that is a symbolic link itself; its folders may be links.

    Raises:
        ResultsError: The file is missing, unreadable, not a regular file, or too large. The message begins with the
            path.
    """
    # Without O_NONBLOCK, opening a named pipe waits for its writer. Windows has neither flag, but O_BINARY.
    flags = ("O_NONBLOCK", "O_BINARY", *([] if follow else ["O_NOFOLLOW"]))
    try:
        if not follow and path.is_symlink():
            raise ResultsError(f"{path} is a symbolic link; give the path of the file itself")
        handle = os.open(path, sum((getattr(os, flag, 0) for flag in flags), os.O_RDONLY))
        with os.fdopen(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise ResultsError(f"{path} is not a regular file; give the path of a file")
            content = file.read(limit + 1)
    except (OSError, ValueError) as error:
        # ValueError: a path with a null character.
        reason = getattr(error, "strerror", None) or error
        raise ResultsError(f"{path} cannot be read ({reason}); check the path and its permissions") from error
    if len(content) > limit:
        raise ResultsError(f"{path} has more than {limit} bytes, the most that is read of such a file")
    return content


def read_strict_json(path: Path, limit: int) -> Any:
    """Read a JSON file of unknown origin.

    Args:
        path: The file. Links are followed.
        limit: Largest accepted size, bytes. The parsed document takes up to 25 times as much memory.

    Returns:
        The document; see `servotrack.baselines.reporting.strict.parse_json`.

    Raises:
        ResultsError: A file that cannot be read (see `read_bounded`) or parsed. The message begins with the path.
    """
    try:
        return parse_json(read_bounded(path, limit))
    except ValueError as error:
        raise ResultsError(f"{path} is corrupt ({error})") from error


def read_strict_yaml(path: Path) -> Any:
    """Read a YAML file of unknown origin, of at most 500 kB.

    Args:
        path: The file. Links are followed.

    Returns:
        The document; see `servotrack.baselines.reporting.strict.parse_yaml`.

    Raises:
        ResultsError: A file that cannot be read (see `read_bounded`) or parsed. The message begins with the path.
    """
    try:
        return parse_yaml(read_bounded(path, LARGEST_YAML))
    except ValueError as error:
        raise ResultsError(f"{path} is not valid YAML ({error})") from error


def read_document(
    path: Path, kind: str, version: int, otherwise: str, remedy: str, older: Sequence[int] = ()
) -> dict[str, Any]:
    """Read a JSON file that says of itself what it is.

    Args:
        path: The file.
        kind: Required value of `format`.
        version: Value of `format_version` in new files.
        otherwise: Description of a file of another format, for the error message.
        remedy: Remedy for an unusable file, for the error message.
        older: Format versions that are read, too.

    Raises:
        ResultsError: The file is unreadable, larger than 64 MB, corrupt, foreign or of another format version.
    """
    try:
        document = parse_json(read_bounded(path, LARGEST_DOCUMENT))
    except ValueError as error:
        raise ResultsError(f"{path} is corrupt ({error}); {remedy}") from error
    if not isinstance(document, dict) or document.get("format") != kind:
        raise ResultsError(f"{path} is {otherwise}; {remedy}")
    found, accepted = document.get("format_version"), (version, *older)
    if type(found) is not int or found not in accepted:
        raise ResultsError(
            f"{path} has format version {str(found)[:40]}, this servotrack reads {' and '.join(map(str, accepted))}; "
            f"use the servotrack that wrote it, or {remedy}"
        )
    return document
