"""Limits of processes that handle foreign files or are foreign: memory, time, files, and a namespace of their own.

bubblewrap (the command `bwrap`) gives a process a file system with the programs and libraries of this machine, read
only, and its own files, and no network. Where it is missing, only the limits hold.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

from servotrack.estimators.kernel_folder import VARIABLE, kernel_folder

PACKAGES = ("servotrack", "servotrack.envs", "servotrack.estimators", "servotrack.baselines")
_SYSTEM = ("/usr", "/bin", "/lib", "/lib64", "/lib32", "/etc/ld.so.cache", "/etc/alternatives")
_NAMESPACES = ("--unshare-all", "--die-with-parent", "--new-session")
_EMPTY = ("--proc", "/proc", "--dev", "/dev", "--remount-ro", "/dev", "--size", "16000000", "--tmpfs", "/tmp")
"""Options for a new /proc and /dev, and an empty /tmp of 16 MB."""
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_STARTING = 20.0
"""Time within which bubblewrap shows that it works, s."""


@dataclass(frozen=True)
class Limits:
    """Limits of a process. Raising one lets larger or slower agents through, and hostile ones do more harm.

    Attributes:
        memory: Address space, bytes. Programs with a just-in-time compiler reserve several times what they use.
        seconds: Processor time, s.
        file_size: Size of a file that is written, bytes.
        files: Number of open files.
    """

    memory: int
    seconds: int
    file_size: int = 1_000_000
    files: int = 256

    def apply(self) -> None:
        """Set the limits for the present process and those that it starts."""
        if resource is None:
            return
        wanted = {
            resource.RLIMIT_AS: self.memory,
            resource.RLIMIT_CPU: self.seconds,
            resource.RLIMIT_FSIZE: self.file_size,
            resource.RLIMIT_NOFILE: self.files,
            resource.RLIMIT_CORE: 0,
        }
        for kind, value in wanted.items():
            _, hard = resource.getrlimit(kind)
            bound = value if hard == resource.RLIM_INFINITY else min(value, hard)
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(kind, (bound, bound))


@lru_cache(maxsize=1)
def bubblewrap() -> str | None:
    """Return the path of bubblewrap if it works here, None otherwise."""
    path = shutil.which("bwrap")
    if path is None:
        return None
    try:
        command = [path, *_NAMESPACES, "--ro-bind", "/", "/", *_EMPTY, "--", "/bin/true"]
        done = subprocess.run(command, capture_output=True, timeout=_STARTING, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return path if done.returncode == 0 else None


def confined(command: Sequence[str], folders: Mapping[str, Path], working: str) -> list[str]:
    """Return the command line that runs a command in a namespace of its own.

    It sees the system's programs, this Python with its packages, and the given folders, all read only, an otherwise
    empty /tmp, and neither network nor other processes.

    Args:
        command: The command.
        folders: Folders or files of this machine by their path inside.
        working: Working directory inside.

    Raises:
        RuntimeError: There is no bubblewrap.
    """
    program = bubblewrap()
    if program is None:
        raise RuntimeError("bubblewrap is not installed or may not make namespaces here")
    line = [program, *_NAMESPACES, "--clearenv"]
    for name, value in inner_environment().items():
        line += ["--setenv", name, value]
    # First: Python may be installed under /tmp.
    line += _EMPTY
    for path in _visible():
        line += ["--ro-bind-try", path, path]
    for inside, outside in folders.items():
        line += ["--ro-bind-try", str(outside), inside]
    return [*line, "--chdir", working, "--", *command]


def inner_environment() -> dict[str, str]:
    """Return the environment variables of a confined process."""
    path = os.pathsep.join([str(Path(sys.executable).parent), "/usr/local/bin", "/usr/bin", "/bin"])
    found = {"PATH": path, "LANG": "C.UTF-8", "HOME": os.path.expanduser("~"), **_ONE_THREAD}
    if VARIABLE in os.environ:
        found[VARIABLE] = os.environ[VARIABLE]
    return found


def _visible() -> list[str]:
    """Return paths of this machine that every confined process may read: programs, Python, packages, kernels."""
    rooms = [str(Path(str(spec.origin)).parent) for name in PACKAGES if (spec := find_spec(name)) is not None]
    kernels = [str(folder) for folder in kernel_folder().read]
    return list(dict.fromkeys([*_SYSTEM, sys.base_prefix, sys.prefix, *rooms, *kernels]))


def limited(limits: Limits) -> Callable[[], None] | None:
    """Return a function that sets limits in a new process before its program starts; None where there are none."""
    return None if resource is None else limits.apply
