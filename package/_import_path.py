"""Import path of the command line. Python modules in the working directory are other people's code."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


def leave_working_directory() -> None:
    """Remove the entry that `python -m servotrack` puts first: modules there would shadow libraries.

    It changes nothing if Python runs anything else, or runs in isolated or safe-path mode.
    """
    if sys.argv[:1] != ["-m"] or sys.flags.isolated or getattr(sys.flags, "safe_path", False):
        return
    # While the module of -m is located, sys.argv holds "-m" and the arguments; the module stands before them.
    word = sys.orig_argv[-len(sys.argv)]
    module = word.partition("m")[2] if word.startswith("-") else word
    if module.partition(".")[0] == "servotrack" and sys.path[:1] in ([""], [os.getcwd()]):
        del sys.path[0]


_appended: list[str] = []


def append_working_directory() -> None:
    """Make modules of the working directory importable; last, so that they shadow nothing."""
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
        _appended.append(here)


@contextlib.contextmanager
def without_appended() -> Iterator[tuple[str, ...]]:
    """Context without the appended folders, for processes that inherit the import path when they start.

    They append the folders once this package is imported: an editable installation is found after every folder of the
    import path, those in last place included.

    Yields:
        The appended folders.
    """
    folders = tuple(_appended)
    before = list(sys.path)
    sys.path[:] = [entry for entry in sys.path if entry not in folders]
    try:
        yield folders
    finally:
        sys.path[:] = before
