"""Files that are written whole or not at all, and JSON documents that name their own format."""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from servotrack.baselines.reporting.strict import parse_json, parse_yaml

LARGEST_DOCUMENT = 64_000_000
"""Largest accepted size of a JSON document of this package, bytes: results of some 200,000 episodes."""
LARGEST_YAML = 500_000
"""Largest accepted size of a YAML file, bytes."""


class ResultsError(Exception):
    """A results folder or file that cannot be used; the message names the path and the remedy."""


def temporary_in(folder: Path, suffix: str) -> Path:
    """A new empty file in `folder`, which is made where it is missing; ResultsError when that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=".unfinished-", suffix=suffix, dir=folder)
    except (FileExistsError, NotADirectoryError) as error:
        raise ResultsError(f"{folder} cannot be a folder: a file has that name; choose another folder") from error
    except OSError as error:
        raise ResultsError(
            f"{folder} is not writable ({error.strerror}); change its permissions or choose another folder"
        ) from error
    os.close(handle)
    return Path(name)


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block succeeds and vanishes when it fails.

    Raises:
        ResultsError: The folder is a file, read-only, or otherwise not writable.
    """
    temporary = temporary_in(path.parent, path.suffix)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        # mkstemp makes files that only their owner can read.
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


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
    path: Path, kind: str, version: int, otherwise: str, remedy: str, limit: int = LARGEST_DOCUMENT
) -> dict[str, Any]:
    """Read a JSON file that says of itself what it is.

    Args:
        path: The file.
        kind: Required value of `format`.
        version: Required value of `format_version`.
        otherwise: Description of a file of another format, for the error message.
        remedy: Remedy for an unusable file, for the error message.
        limit: Largest accepted size, bytes.

    Raises:
        ResultsError: The file is unreadable, corrupt, foreign or of another format version.
    """
    try:
        document = parse_json(read_bounded(path, limit))
    except ValueError as error:
        raise ResultsError(f"{path} is corrupt ({error}); {remedy}") from error
    if not isinstance(document, dict) or document.get("format") != kind:
        raise ResultsError(f"{path} is {otherwise}; {remedy}")
    if type(document.get("format_version")) is not int or document["format_version"] != version:
        raise ResultsError(
            f"{path} has format version {document.get('format_version')!r}, this servotrack reads {version}; "
            f"use the servotrack that wrote it, or {remedy}"
        )
    return document
