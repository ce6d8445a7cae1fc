"""Compare digests of all worlds and classical agents over Pythons, libraries, threads, start methods and locales.

    scripts/test --matrix [--only TEXT] [--jobs N]

Environments are made by scripts/setup: .venv, .venv-3.X for every other Python on PATH or under pyenv, .venv-lowest
with the lowest versions of all dependencies, .venv-numpy-lowest with the lowest NumPy and the newest of the others.
Prints one line for each run, names what the machine does not have, and exits with 1 if a digest differs.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
LOCALES = ("C", "de_DE.UTF-8", "tr_TR.UTF-8")
LOWEST_NUMPY = re.search(r'"numpy>=([\d.]+)', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Run:
    """One run of scripts/digests.py.

    Attributes:
        label: Difference from the reference, for the printed line.
        python: Interpreter.
        threads: Threads of the linear algebra library.
        options: Options of scripts/digests.py.
        variables: Environment variables.
    """

    label: str
    python: Path
    threads: int = 1
    options: tuple[str, ...] = ()
    variables: Mapping[str, str] = field(default_factory=dict)


def base_python(version: str) -> Path | None:
    """Find a Python of a version that can make environments, on PATH or under pyenv."""
    name = f"python{version}"
    found = [Path(folder) / name for folder in os.environ.get("PATH", "").split(os.pathsep)]
    if shutil.which("pyenv"):
        root = subprocess.run(["pyenv", "root"], capture_output=True, text=True, check=False).stdout.strip()
        found += sorted(Path(root).glob(f"versions/{version}*/bin/{name}"))
    probe = f"import sys, venv, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != '{version}')"
    for path in found:
        if path.is_file() and subprocess.run([path, "-c", probe], capture_output=True, check=False).returncode == 0:
            return path
    return None


def environment(folder: str, python: Path | None = None, **variables: str) -> Path | str:
    """Make an environment with scripts/setup and return its Python, or why there is none."""
    given = {"VENV": folder, **({} if python is None else {"PYTHON": str(python)}), **variables}
    run = subprocess.run(
        ["scripts/setup", "core"], cwd=ROOT, capture_output=True, text=True, check=False, env={**os.environ, **given}
    )
    if run.returncode != 0:
        return (run.stderr.strip().splitlines() or ["scripts/setup failed"])[-1]
    return ROOT / folder / "bin" / "python"


def lowest_numpy(python: Path | None) -> Path | str:
    """Make an environment with the lowest NumPy, which packages that are newer may not ask for although they run."""
    made = environment(".venv-numpy-lowest", python)
    if isinstance(made, str) or LOWEST_NUMPY is None:
        return made
    bound = LOWEST_NUMPY[1].rsplit(".", 1)[0] if LOWEST_NUMPY[1].count(".") > 1 else LOWEST_NUMPY[1]
    install = [made, "-m", "pip", "install", "-q", "--no-deps", f"numpy=={bound}.*"]
    run = subprocess.run(install, capture_output=True, text=True, check=False)
    return made if run.returncode == 0 else f"numpy=={bound}.* could not be installed"


def plan() -> tuple[list[Run], list[str]]:
    """All runs, the reference first, and one line for each thing that this machine does not have."""
    reference = ROOT / ".venv" / "bin" / "python"
    ask = [reference, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    own = subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip()
    pythons: list[tuple[str, Path]] = [("", reference)]
    missing = []
    for version in PYTHONS:
        if version == own:
            continue
        base = base_python(version)
        made = "no such program" if base is None else environment(f".venv-{version}", base)
        if isinstance(made, str):
            missing.append(f"Python {version}: {made}")
        else:
            pythons.append(("", made))
    for label, made in (
        ("lowest versions", environment(".venv-lowest", LOWEST="1")),
        ("lowest NumPy", lowest_numpy(base_python(own))),
    ):
        if isinstance(made, str):
            missing.append(f"{label}: {made}")
        else:
            pythons.append((label, made))
    runs = [Run(label, python, threads) for threads, (label, python) in itertools.product((1, 2), pythons)]
    runs += [
        Run(f"{way} process", reference, options=("--start-method", way)) for way in ("fork", "spawn", "forkserver")
    ]
    known = (
        subprocess.run(["locale", "-a"], capture_output=True, text=True, check=False).stdout.lower().replace("-", "")
    )
    for name in LOCALES:
        if name.lower().replace("-", "") in known.split():
            runs.append(Run(f"locale {name}", reference, variables={"LC_ALL": name}))
        else:
            missing.append(f"locale {name}: not installed")
    return runs, missing


def measure(run: Run, only: str) -> dict[str, Any] | str:
    """Run scripts/digests.py and return what it prints, or its last error."""
    threads = {name: str(run.threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    done = subprocess.run(
        [run.python, "scripts/digests.py", "--only", only, *run.options],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, **threads, **run.variables, "SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "Agg"},
    )  # fmt: skip
    if done.returncode != 0:
        return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def describe(run: Run, versions: Mapping[str, str]) -> str:
    """Versions, threads and what else is special about a run, in one line."""
    text = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{text}, {run.threads} thread{'s' * (run.threads > 1)}" + (f", {run.label}" if run.label else "")


def main() -> int:
    """Measure, compare and print; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="only worlds and agents whose line contains this text")
    parser.add_argument("--jobs", type=int, default=2, help="runs at the same time")
    arguments = parser.parse_args()
    runs, missing = plan()
    for line in missing:
        print(f"missing  {line}", flush=True)
    failed, reference = False, None
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for run, found in zip(runs, pool.map(lambda run: measure(run, arguments.only), runs), strict=True):
            if isinstance(found, str):
                print(f"FAILED   {run.label or run.python}: {found}", flush=True)
                failed = True
                continue
            if reference is None:
                reference = found
            failed |= not report(run, found, reference)
    return int(failed)


def report(run: Run, found: Mapping[str, Any], reference: Mapping[str, Any]) -> bool:
    """Print one line, and the names that differ; return False if something differs that should not."""
    ours, theirs = reference["digests"], found["digests"]
    common = [name for name in ours if ours[name] is not None and theirs.get(name) is not None]
    differ = [name for name in common if ours[name] != theirs[name]]
    drawn: list[str] = []
    if found["versions"]["OpenCV"] != reference["versions"]["OpenCV"]:
        # Versions of OpenCV draw differently; what an agent makes of another picture differs, too.
        drawn = [name for name in differ if name in found["pictures"]]
    wrong = [name for name in differ if name not in drawn]
    text = f"{len(common) - len(differ)} of {len(common)} equal"
    if drawn:
        text += f" ({len(drawn)} drawn differently by another OpenCV)"
    print(f"{'DIFFERS ' if wrong else 'equal   '} {text}: {describe(run, found['versions'])}", flush=True)
    for name in wrong:
        print(f"         {name}", flush=True)
    return not wrong


if __name__ == "__main__":
    sys.exit(main())
