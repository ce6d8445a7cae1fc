"""Compiled kernels: kept where the user can write, rebuilt when damaged or outdated, shared by processes."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from numba.core import config

from servotrack.estimators import kernel_folder as places
from servotrack.estimators.compilation import fingerprint
from servotrack.estimators.kernel_folder import kernel_folder

ROOT = Path(__file__).parents[2]
ROOMS = ("package", "envs", "estimators", "baselines")
INNER = """
from typing import NamedTuple
from servotrack.estimators.compilation import njit

FACTOR = 2.0

class Pair(NamedTuple):
    first: float
    second: float

@njit(cache=True)
def scaled(x):
    return FACTOR * x
"""
OUTER = """
import inner
from servotrack.estimators.compilation import njit

@njit(cache=True)
def doubled(x):
    return inner.scaled(x) + 0.0

@njit(cache=True)
def first(pair):
    return pair.first
"""


def test_every_kernel_uses_this_cache() -> None:
    sources = [path for room in ROOMS for path in (ROOT / room).rglob("*.py") if path.name != "compilation.py"]
    assert len(sources) > 100
    decorators = re.compile(r"numba\.(n?jit|vectorize|guvectorize|cfunc)|from numba import .*(jit|vectorize|cfunc)")
    assert not [path for path in sources if decorators.search(path.read_text(encoding="utf-8"))]


class Kernels:
    """Two modules with kernels in a folder of their own, and the folder in which their compiled code is kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.write(INNER)
        (folder / "outer.py").write_text(OUTER, encoding="utf-8")

    def write(self, inner: str) -> None:
        (self.folder / "inner.py").write_text(inner, encoding="utf-8")

    def load(self) -> ModuleType:
        """Import both modules anew, as another process would."""
        for name in ("inner", "outer"):
            spec = importlib.util.spec_from_file_location(name, self.folder / f"{name}.py")
            assert spec is not None and spec.loader is not None
            sys.modules[name] = module = importlib.util.module_from_spec(spec)
            # Files of the same length written within a second would pass for each other's bytecode.
            exec(compile((self.folder / f"{name}.py").read_text(encoding="utf-8"), name, "exec"), vars(module))
        return sys.modules["outer"]

    @property
    def files(self) -> list[Path]:
        return sorted((self.folder / "cache" / "servotrack").glob("*.nbc"))


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Kernels]:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(places, "_SAID", set())
    kernel_folder.cache_clear()
    yield Kernels(tmp_path)
    kernel_folder.cache_clear()
    for name in ("inner", "outer"):
        sys.modules.pop(name, None)


def hits(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def test_a_second_process_compiles_nothing_and_prints_nothing(
    kernels: Kernels, capsys: pytest.CaptureFixture[str]
) -> None:
    assert kernels.load().doubled(3.0) == 6.0
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and str(kernels.folder / "cache") in said and "once" in said
    again = kernels.load()
    assert again.doubled(3.0) == 6.0 and hits(again.doubled) == 1
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new"), [("FACTOR * x", "FACTOR * x + 1.0"), ("FACTOR = 2.0", "FACTOR = 2.5")], ids=["code", "constant"]
)
def test_an_edit_reaches_kernels_of_other_files(kernels: Kernels, old: str, new: str) -> None:
    """Numba's own cache would answer 6.0."""
    assert kernels.load().doubled(3.0) == 6.0
    kernels.write(INNER.replace(old, new))
    edited = kernels.load()
    assert edited.doubled(3.0) == edited.inner.scaled.py_func(3.0) != 6.0
    kernels.write("# A comment that moves every line.\n" + INNER)
    restored = kernels.load()
    assert restored.doubled(3.0) == 6.0 and hits(restored.doubled) == 1


def test_a_swap_of_record_fields_is_noticed(kernels: Kernels) -> None:
    module = kernels.load()
    assert module.first(module.inner.Pair(first=1.0, second=2.0)) == 1.0
    kernels.write(INNER.replace("first: float\n    second: float", "second: float\n    first: float"))
    module = kernels.load()
    assert module.first(module.inner.Pair(first=1.0, second=2.0)) == 1.0


@pytest.mark.parametrize("damage", ["empty", "cut", "garbage", "one byte", "another kernel", "a folder"])
def test_damaged_files_are_rebuilt(kernels: Kernels, damage: str) -> None:
    kernels.load().doubled(3.0)
    intact = {path: path.read_bytes() for path in kernels.files}
    assert len(intact) == 2
    for (path, content), other in zip(intact.items(), reversed(intact.values()), strict=True):
        middle = len(content) // 2
        broken = {
            "empty": b"",
            "cut": content[:middle],
            "garbage": os.urandom(len(content)),
            "one byte": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "another kernel": other,
        }
        path.unlink()
        if damage in broken:
            path.write_bytes(broken[damage])
        else:
            path.mkdir()
    again = kernels.load()
    assert again.doubled(3.0) == 6.0 and hits(again.doubled) == 0
    if damage != "a folder":
        assert hits_after(kernels) == 1


def hits_after(kernels: Kernels) -> int:
    module = kernels.load()
    module.doubled(3.0)
    return hits(module.doubled)


COMPETITOR = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np
from outer import doubled
sys.stdin.readline()
kinds = [np.float64, np.float32, np.int64, np.int32, np.int16, np.uint8][: int(sys.argv[3])]
turn = int(sys.argv[2]) % len(kinds)
for kind in kinds[turn:] + kinds[:turn]:
    assert doubled(kind(3)) == 6.0, kind
print(sum(doubled.stats.cache_hits.values()))
"""


def compete(kernels: Kernels, processes: int, signatures: int) -> list[int]:
    """Compile in several processes at once, and return how many signatures each one found compiled."""
    started = [
        subprocess.Popen(
            [sys.executable, "-c", COMPETITOR, str(kernels.folder), str(i), str(signatures)], text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env={**os.environ, "NUMBA_CACHE_DIR": str(kernels.folder / "cache")},
        )
        for i in range(processes)
    ]  # fmt: skip
    for process in started:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    ended = [process.communicate(timeout=300) for process in started]
    assert [process.returncode for process in started] == [0] * processes, ended
    return [int(out) for out, _ in ended]


@pytest.mark.parametrize(
    ("processes", "signatures", "rounds"), [(4, 2, 1), pytest.param(8, 6, 10, marks=pytest.mark.slow)]
)
def test_processes_that_compile_at_once_do_not_hurt_each_other(
    kernels: Kernels, processes: int, signatures: int, rounds: int
) -> None:
    """Numba's own cache numbers the files of a kernel, and two processes may take the same number."""
    for _ in range(rounds):
        shutil.rmtree(kernels.folder / "cache", ignore_errors=True)
        compete(kernels, processes, signatures)
        assert not list((kernels.folder / "cache").rglob("*.tmp"))
        assert compete(kernels, 1, signatures) == [signatures]


def test_a_folder_that_is_full_stops_nothing(
    kernels: Kernels, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = kernel_folder().write
    assert folder is not None
    shutil.rmtree(folder)
    folder.write_text("in the way", encoding="utf-8")
    assert kernels.load().doubled(3.0) == 6.0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and str(folder) in said[1]


def test_the_temporary_folder_is_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = places.temporary_folder()
    assert folder is not None
    assert places._reason_against(folder) is None
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o770)
    assert places._reason_against(folder) == "Other users have access"
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(tmp_path / "elsewhere")
    assert places._reason_against(folder) == "Not a directory"
    folder.unlink()
    folder.mkdir(mode=0o700)
    if os.geteuid() == 0:
        os.chown(folder, 65534, 65534)
        assert places._reason_against(folder) == "Belongs to another user"


def test_workers_announce_once_for_all(tmp_path: Path) -> None:
    assert [places._announced_lately(tmp_path) for _ in range(3)] == [False, True, True]
    (mark,) = tmp_path.iterdir()
    os.utime(mark, (0, 0))
    assert not places._announced_lately(tmp_path)


UNPRIVILEGED = ["setpriv", "--inh-caps=-all", "--bounding-set=-all"]
"""Takes root's right to write anywhere; other users do not have it."""


@pytest.fixture
def installed() -> Iterator[Path]:
    """Copy of the package without its compiled code, in which nothing is writable."""
    if os.name != "posix":
        pytest.skip("needs permissions of files")
    if os.geteuid() == 0 and shutil.which(UNPRIVILEGED[0]) is None:
        pytest.skip("root writes everywhere, and setpriv is not there to prevent it")
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "site" / "servotrack"
        leave = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / "package", package, ignore=leave)
        for room in ROOMS[1:]:
            shutil.copytree(ROOT / room, package / room, ignore=leave)
        folders = [path for path in (package.parent, *package.parent.rglob("*")) if path.is_dir()]
        for path in folders:
            path.chmod(0o555)
        yield package.parent
        for path in folders:
            path.chmod(0o755)


WALK = """
import numpy as np
import servotrack
from servotrack.estimators.detect.runs import __file__ as source
from servotrack.envs.streams import Streams
print(source, Streams(7)[0].integers(1000))
"""


@pytest.mark.parametrize("temporary", ["free", "taken"])
def test_a_read_only_installation_without_home_runs(installed: Path, tmp_path: Path, temporary: str) -> None:
    own = tmp_path / f"servotrack-kernels-{os.geteuid()}"
    if temporary == "taken":
        own.mkdir(mode=0o777)
        own.chmod(0o777)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA_", "XDG_"))}
    environment |= {"HOME": "/nonexistent", "TMPDIR": str(tmp_path), "PYTHONPATH": str(installed)}
    command = [*(UNPRIVILEGED if os.geteuid() == 0 else []), sys.executable, "-P", "-c", WALK]
    if sys.version_info < (3, 11):
        command.remove("-P")
    runs = [
        subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd="/", timeout=120)
        for _ in range(2)
    ]
    for run in runs:
        assert run.returncode == 0, run.stderr
        assert run.stdout.startswith(str(installed))
    assert runs[0].stdout == runs[1].stdout
    lines = [run.stderr.splitlines() for run in runs]
    if temporary == "free":
        # The first run says what it does and why there; the second one has nothing to compile.
        assert [len(said) for said in lines] == [1, 0], lines
        assert str(own) in lines[0][0]
        assert str(installed) in lines[0][0] and "NUMBA_CACHE_DIR" in lines[0][0]
    else:
        assert [len(said) for said in lines] == [1, 1], lines
        assert "NUMBA_CACHE_DIR" in lines[0][0] and "every process" in lines[0][0]
    assert not list(installed.rglob("*.nbc"))


def test_fingerprints_are_the_same_in_every_process() -> None:
    """An address in one of them would make every process compile again."""
    probe = (
        "from servotrack.estimators.compilation import fingerprint\n"
        "from servotrack.estimators.rfs.pmb_kernel import *\n"
        "from servotrack.estimators.rfs import pmb_kernel\n"
        "from numba.core.dispatcher import Dispatcher\n"
        "print(*sorted(fingerprint(k) for k in vars(pmb_kernel).values() if isinstance(k, Dispatcher)))\n"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", probe], capture_output=True, text=True, check=True, timeout=60,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("0", "1")
    }  # fmt: skip
    assert len(found) == 1 and found.pop().count(" ") > 3


def test_fingerprints_differ_between_kernels(kernels: Kernels) -> None:
    module = kernels.load()
    assert len({fingerprint(kernel) for kernel in (module.doubled, module.first, module.inner.scaled)}) == 3
