"""Reading of files from unknown sources: regular files only, of limited size, and numbers in plain notation."""

from __future__ import annotations

import os
from pathlib import Path

from servotrack.envs.track.files.recorded import SequenceError

_MAX_NUMBER = 64
"""Largest length of a number, characters."""


def is_folder(path: Path) -> bool:
    """Return True if the path is a folder. Raise SequenceError if it cannot be looked up."""
    try:
        return path.is_dir()
    except (OSError, ValueError) as error:
        raise SequenceError(f"{str(path)!r} cannot be looked up ({error})") from error


def check_file(path: Path) -> Path:
    """Return the path if it is a regular file or a link to one, else raise SequenceError."""
    folder = is_folder(path)
    try:
        regular, there = path.is_file(), path.exists()
    except (OSError, ValueError) as error:
        raise SequenceError(f"{str(path)!r} cannot be a file ({error})") from error
    if folder:
        raise SequenceError(f"{path} is a folder; give the path of a file")
    if not regular and there:
        raise SequenceError(
            f"{path} is not a regular file (a pipe, a socket or a device); copy its content into a file"
        )
    if not regular:
        raise SequenceError(f"{path} does not exist or is not a regular file; check the path")
    return path


def read_bounded(path: Path, most: int, remedy: str) -> bytes:
    """Return the content of a file.

    Args:
        path: Regular file, or link to one.
        most: Largest accepted size, bytes.
        remedy: Remedy for a larger file, for the error message.

    Raises:
        SequenceError: If the file is missing, not regular, not readable, too large, or written while it is read.
    """
    try:
        with check_file(path).open("rb") as stream:
            before = os.fstat(stream.fileno())
            if before.st_size > most:
                raise SequenceError(f"{path} has {before.st_size} bytes, the limit is {most}; {remedy}")
            content = stream.read(before.st_size + 1)
            after = os.fstat(stream.fileno())
    except OSError as error:
        raise SequenceError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    if len(content) != before.st_size or (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise SequenceError(f"{path} changed while it was read; read it again once it is complete")
    return content


def parse_number(text: str) -> float:
    """Return the number that a text spells with ASCII digits. Python's own parser also takes `1_0` and other digits.

    Raises:
        ValueError: If the text is not a number, or longer than 64 characters.
    """
    if len(text) > _MAX_NUMBER or "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text[:_MAX_NUMBER]!r}")
    return float(text)
