"""Numba's decorator with a cache of our own, which holds where Numba's does not.

Numba's cache refuses to compile where nothing is writable, ends the process on damaged files, checks only the file of
the kernel that is called, and lets two processes that compile different signatures overwrite each other. Here each
compiled signature is a file of its own, named after everything that decides its code, with a checksum, and written at
once.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from enum import EnumMeta
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from servotrack.estimators.kernel_folder import PACKAGE_FOLDER, announce_compilation, kernel_folder, say_once

_SUFFIX = ".nbc"
_DIGEST_SIZE = hashlib.sha256().digest_size
_ABANDONED = 3600.0
"""Age at which a file that was never renamed belongs to a process that is gone, s."""


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function with Numba at its first call. Use it as `numba.njit`.

    Args:
        cache: Keep the compiled code in `kernel_folder`, for all processes.
        **options: Options of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        # With NUMBA_DISABLE_JIT the function stays as it is.
        if cache and isinstance(dispatcher, Dispatcher):
            dispatcher._cache = KernelCache(dispatcher)  # type: ignore[attr-defined]
        return dispatcher

    return decorate


class KernelCache(_Cache):  # type: ignore[misc]
    """Compiled code of one kernel, one file for each signature.

    Args:
        dispatcher: The kernel.
    """

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher = dispatcher
        self._fingerprint: str | None = None
        self._enabled = True

    @property
    def cache_path(self) -> str | None:
        """Folder into which compiled code is written, None if no folder is writable."""
        folder = kernel_folder().write
        return None if folder is None else str(folder)

    def enable(self) -> None:
        """Use the files."""
        self._enabled = True

    def disable(self) -> None:
        """Neither read nor write files."""
        self._enabled = False

    def flush(self) -> None:
        """Remove the files of this kernel."""
        if (folder := kernel_folder().write) is not None:
            self._remove_files(folder, lambda path: True)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code of a signature, None if it must be compiled. Damaged files count as missing."""
        target_context.refresh()
        if self._enabled:
            key = self._key(sig, target_context.codegen())
            for folder in kernel_folder().read:
                payload = _read(folder / self._file_name(key), key)
                if payload is not None:
                    # What the file refers to, such as a class, may have moved since.
                    with contextlib.suppress(Exception):
                        return CompileResult._rebuild(target_context, *payload)
        announce_compilation()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled code of a signature."""
        folder = kernel_folder().write
        if not self._enabled or folder is None or data.lifted or data.library.has_dynamic_globals:
            return
        key = self._key(sig, data.codegen)
        try:
            _write(folder / self._file_name(key), key, data._reduce())
        except OSError as error:
            self.disable()
            say_once(
                "unkept",
                f"{folder} cannot keep compiled kernels ({error.strerror}), so every process will compile them again",
            )
        else:
            self._remove_stale(folder)

    def _remove_stale(self, folder: Path) -> None:
        """Remove what earlier versions of the kernel left in the package's own folder.

        Other folders may serve several versions of the package at the same time.
        """
        version = f".{self._version()}."
        self._remove_files(folder, lambda path: folder == PACKAGE_FOLDER and version not in path.name)

    def _remove_files(self, folder: Path, chosen: Callable[[Path], bool]) -> None:
        with contextlib.suppress(OSError):
            for path in folder.glob(f"{self._base()}.*"):
                unfinished = path.suffix != _SUFFIX and time.time() - path.stat().st_mtime > _ABANDONED
                if unfinished or (path.suffix == _SUFFIX and chosen(path)):
                    path.unlink(missing_ok=True)

    def _base(self) -> str:
        function = self._dispatcher.py_func
        name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")
        return f"{name}-{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"

    def _version(self) -> str:
        if self._fingerprint is None:
            self._fingerprint = fingerprint(self._dispatcher)
        return self._fingerprint[:12]

    def _key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        records = tuple(_record_fields(sig.args if hasattr(sig, "args") else sig))
        versions = numba.__version__, np.__version__
        self._version()
        return self._fingerprint, versions, sig, records, codegen.magic_tuple()

    def _file_name(self, key: tuple[Any, ...]) -> str:
        signature = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return f"{self._base()}.{self._version()}.{signature}{_SUFFIX}"


def _read(path: Path, key: tuple[Any, ...]) -> tuple[Any, ...] | None:
    """Return what `_write` wrote, None if the file is missing, damaged or of another key."""
    try:
        content = path.read_bytes()
        digest, data = content[:_DIGEST_SIZE], content[_DIGEST_SIZE:]
        # Damaged machine code would crash the process.
        if hashlib.sha256(data).digest() != digest:
            return None
        stored, payload = pickle.loads(data)
    except Exception:
        return None
    return payload if stored == key else None


def _write(path: Path, key: tuple[Any, ...], payload: tuple[Any, ...]) -> None:
    data = dumps((key, payload))
    unfinished = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        unfinished.write_bytes(hashlib.sha256(data).digest() + data)
        os.replace(unfinished, path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise


def fingerprint(dispatcher: Any) -> str:
    """Hash everything that decides the compiled code of a kernel, apart from the types of its arguments.

    That is its own code, the constants that it takes from its module, and the same of all kernels that it calls.

    Returns:
        SHA-256, hexadecimal.
    """
    found: dict[int, str] = {}
    waiting = [dispatcher]
    while waiting:
        kernel = waiting.pop()
        if id(kernel) in found:
            continue
        parts, called = _local_parts(kernel)
        found[id(kernel)] = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        waiting += called
    return hashlib.sha256("\n".join([found[id(dispatcher)], *sorted(found.values())]).encode()).hexdigest()


def _local_parts(kernel: Any) -> tuple[list[str], list[Any]]:
    """Describe one kernel, and list the kernels that it calls."""
    function: FunctionType = kernel.py_func
    parts = [function.__module__, function.__qualname__, repr(sorted(kernel.targetoptions.items()))]
    parts += [repr(function.__defaults__), *_code_parts(function.__code__)]
    called = []
    for name, value in _globals_used(function):
        if isinstance(value, Dispatcher):
            parts.append(f"{name} calls {value.py_func.__module__}.{value.py_func.__qualname__}")
            called.append(value)
        elif (text := _constant(value)) is not None:
            parts.append(f"{name} = {text}")
    return parts, called


def _code_parts(code: CodeType) -> Iterator[str]:
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars))
    # Exceptions are handled by a table since Python 3.11.
    yield repr(getattr(code, "co_exceptiontable", b""))
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _code_parts(value)
        else:
            yield repr(sorted(map(repr, value)) if isinstance(value, frozenset) else value)


def _names(code: CodeType) -> set[str]:
    inner = [_names(value) for value in code.co_consts if isinstance(value, CodeType)]
    return set(code.co_names).union(*inner)


def _globals_used(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Iterate over what a function takes from its module and from functions around it, by name."""
    names = sorted(_names(function.__code__))
    for name in names:
        if name not in function.__globals__:
            continue
        value = function.__globals__[name]
        if isinstance(value, ModuleType):
            yield from ((f"{name}.{inner}", vars(value)[inner]) for inner in names if inner in vars(value))
        else:
            yield name, value
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents


def _constant(value: Any) -> str | None:
    """Text of a value that Numba compiles in, None for functions, modules and other classes."""
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, np.generic)):
        return repr(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str}{value.shape}{hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, tuple):
        return f"{type(value).__name__}({', '.join(str(_constant(part)) for part in value)})"
    if isinstance(value, EnumMeta):
        return repr([(member.name, member.value) for member in value])  # type: ignore[var-annotated]
    if isinstance(value, type) and hasattr(value, "_fields"):
        return f"{value.__name__}{value._fields}"
    return None


def _record_fields(types: Any) -> Iterator[tuple[str, ...]]:
    """Iterate over the field names of all named tuples among argument types, which the types' names leave out."""
    for kind in types:
        if hasattr(kind, "fields") and not isinstance(kind.fields, dict):
            yield tuple(str(field) for field in kind.fields)
        inner = getattr(kind, "types", None)
        if inner is None and hasattr(kind, "dtype"):
            inner = (kind.dtype,)
        # Scalars of some kinds are their own element type.
        yield from _record_fields(part for part in inner or () if part is not kind)
