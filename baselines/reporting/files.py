"""Files that are written whole or not at all, and JSON documents that name their own format."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any


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


def read_document(path: Path, kind: str, version: int, otherwise: str, remedy: str) -> dict[str, Any]:
    """Read a JSON file that says of itself what it is.

    Args:
        path: The file.
        kind: Required value of `format`.
        version: Required value of `format_version`.
        otherwise: Description of a file of another format, for the error message.
        remedy: Remedy for an unusable file, for the error message.

    Raises:
        ResultsError: The file is unreadable, corrupt, foreign or of another format version.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultsError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    except ValueError as error:
        raise ResultsError(f"{path} is corrupt ({error}); {remedy}") from error
    if not isinstance(document, dict) or document.get("format") != kind:
        raise ResultsError(f"{path} is {otherwise}; {remedy}")
    if document.get("format_version") != version:
        raise ResultsError(
            f"{path} has format version {document.get('format_version')}, this servotrack reads {version}; "
            f"use the servotrack that wrote it, or {remedy}"
        )
    return document
