"""Run the scripts of examples/libraries, each library in an environment of its own, and write docs/libraries.md."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from servotrack.baselines import evaluate
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.files import atomic_path

ROOT = Path(__file__).parents[1]
SCRIPTS = ROOT / "examples" / "libraries"
PAGE = ROOT / "docs" / "libraries.md"
RESULTS = ROOT / "results" / "libraries"
LIMIT = 900.0
"""Time limit of a script, s of the clock; it allows for a machine that does other things, too."""
CLEANRL = "https://github.com/vwxyzjn/cleanrl"


class Library(NamedTuple):
    """A library and the scripts that use it.

    Attributes:
        title: Name in the table.
        package: Distribution whose version is shown.
        scripts: Scripts and their further arguments.
        needs: Remarks for users, for the table.
        requirements: Requirements beside servotrack, installed one after the other; empty if an extra holds all.
        extras: Extras of servotrack.
    """

    title: str
    package: str
    scripts: Mapping[str, tuple[str, ...]]
    needs: str
    requirements: tuple[str, ...] = ()
    extras: str = "core"


TORCH = "torch==2.13.0"
"""Installed by its exact version before what needs it, as in scripts/setup."""
FLAT = "`FlatSets` scales observations"
LIBRARIES = {
    "sb3": Library(
        "Stable-Baselines3",
        "stable-baselines3",
        {"sb3_ppo.py": (), "sb3_sac.py": (), "sb3_td3.py": (), "sb3_her.py": ()},
        f"{FLAT}; `StableBaselinesVecEnv` for many arms at once; the goal form has its scale already",
        extras="rl",
    ),
    "contrib": Library(
        "sb3-contrib",
        "sb3-contrib",
        {"contrib_tqc.py": (), "contrib_recurrent_ppo.py": ()},
        "the same",
        extras="rl",
    ),
    "cleanrl": Library(
        "CleanRL",
        "",
        {
            "cleanrl_script.py ppo_continuous_action.py": ("--total-timesteps", "40000", "--num-envs", "8"),
            "cleanrl_script.py sac_continuous_action.py": ("--total-timesteps", "5000", "--learning-starts", "1000"),
        },
        "its scripts are written for Gymnasium 0.29: a launcher gives three things of newer versions their old names",
        (TORCH, "tyro", "tensorboard", "psutil"),
    ),
    "torchrl": Library(
        "TorchRL",
        "torchrl",
        {"torchrl_ppo.py": ()},
        "`DoubleToFloat`: observations are float64",
        (
            TORCH,
            "torchrl>=0.14,<1",
        ),
    ),
    "skrl": Library(
        "skrl",
        "skrl",
        {"skrl_ppo.py": ()},
        "`FlattenObservation`: its networks read one vector",
        (
            TORCH,
            "skrl[torch]>=2.1,<3",
        ),
    ),
    "tianshou": Library(
        "tianshou",
        "tianshou",
        {"tianshou_ppo.py": ()},
        "a registered id with `FlattenObservation`; its builder needs the extra `eval`",
        (
            TORCH,
            "tianshou[eval]>=2,<3",
        ),
    ),
    "rllib": Library(
        "RLlib",
        "ray",
        {"rllib_ppo.py": ()},
        "`register_env`; `FlattenObservation`",
        (
            TORCH,
            "ray[rllib]>=2.51,<3",
        ),
    ),
    "minari": Library(
        "Minari",
        "minari",
        {"minari_dataset.py": (), "minari_collector.py": ()},
        "its own collector needs the extra `create`; `collect_dataset` collects from many arms at once",
        ("minari[create]",),
        extras="minari",
    ),
}
PRINTED = re.compile(r"(return|episodes).*\d")


def environment(name: str, library: Library) -> Path:
    """Make the environment of a library and return its Python."""
    if library.extras == "rl":
        return ROOT / ".venv" / "bin" / "python"
    folder = ROOT / f".venv-libraries-{name}"
    python = folder / "bin" / "python"
    subprocess.run(["scripts/setup", library.extras], cwd=ROOT, check=True, env={**os.environ, "VENV": folder.name})
    mark = folder / "libraries.txt"
    wanted = "\n".join(library.requirements)
    if library.requirements and not (mark.is_file() and mark.read_text(encoding="utf-8") == wanted):
        for requirement in library.requirements:
            subprocess.run([python, "-m", "pip", "install", "-q", requirement], check=True)
        mark.write_text(wanted, encoding="utf-8")
    return python


def checkout(name: str) -> Path:
    """Return CleanRL's folder of scripts; clone it first if there is none."""
    folder = Path(os.environ.get("CLEANRL") or ROOT / f".venv-libraries-{name}" / "checkout")
    if not folder.is_dir():
        subprocess.run(["git", "clone", "-q", "--depth", "1", CLEANRL, str(folder)], check=True)
    return folder / "cleanrl"


def version(python: Path, package: str) -> str:
    """Return the installed version of a distribution."""
    code = f"import importlib.metadata as m; print(m.version({package!r}))"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def run(name: str, library: Library, python: Path, script: str, options: tuple[str, ...]) -> dict[str, Any]:
    """Run one script in an empty folder and return its row."""
    file, *theirs = script.split()
    command = [
        str(python),
        "-W",
        "ignore",
        str(SCRIPTS / file),
        *(str(checkout(name) / one) for one in theirs),
        *options,
    ]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        variables = {**os.environ, "MINARI_DATASETS_PATH": folder, "RAY_ADDRESS": "local", "RAY_AUTH_MODE": "disabled"}
        done = subprocess.run(
            command, cwd=folder, env=variables, capture_output=True, text=True, timeout=LIMIT, check=False
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        sys.exit(f"{script} of {library.title} ended with {done.returncode}:\n{done.stderr[-3000:]}")
    lines = [line for line in done.stdout.splitlines() if PRINTED.search(line)]
    if not lines:
        sys.exit(f"{script} of {library.title} printed no result:\n{done.stdout[-3000:]}")
    return {
        "printed": lines[-1].strip(),
        "seconds": round(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime),
        "version": version(python, library.package) if library.package else "",
        "sha256": digest(script),
    }


def digest(script: str) -> str:
    """Return the digest of a script's file."""
    return hashlib.sha256((SCRIPTS / script.split()[0]).read_bytes()).hexdigest()


def known(path: Path, script: str) -> bool:
    """Return whether a row of the script as it is now exists."""
    return path.is_file() and json.loads(path.read_text(encoding="utf-8"))["sha256"] == digest(script)


def table() -> str:
    """Return the table of all rows that exist."""
    lines = ["| library | script | printed | processor time, s | needs |", "|---|---|---|---|---|"]
    for name, library in LIBRARIES.items():
        for position, script in enumerate(library.scripts):
            path = RESULTS / f"{name} {script}.json"
            if not known(path, script):
                continue
            row = json.loads(path.read_text(encoding="utf-8"))
            title = f"{library.title} {row['version']}".strip()
            needs = library.needs if position == 0 else ""
            lines.append(f"| {title} | `{script}` | {row['printed']} | {row['seconds']} | {needs} |")
    return "\n".join(lines)


def references() -> str:
    """Return a table of the returns of agents of the package, so that those of the scripts can be read."""
    lines = ["| agent | level 2: return | level 6: return |", "|---|---|---|"]
    for agent in ("random", "kf", "lifted-kf"):
        returns = []
        for level in (2, 6):
            cell = evaluate("UncalibServo-v0", agent, take("tune", 100), {"level": level})
            returns.append(f"{sum(row['return'] for row in cell.rows) / len(cell.rows):.1f}")
        lines.append(f"| `{agent}` | {' | '.join(returns)} |")
    return "\n".join(lines)


def main() -> None:
    """Run the scripts that have no row yet, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=LIBRARIES, help="one library")
    parser.add_argument("--again", action="store_true", help="also scripts that have run before")
    options = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name, library in LIBRARIES.items():
        if options.only not in (None, name):
            continue
        python = None
        for script, arguments in library.scripts.items():
            path = RESULTS / f"{name} {script}.json"
            if known(path, script) and not options.again:
                continue
            python = python or environment(name, library)
            row = run(name, library, python, script, arguments)
            print(f"{library.title} {row['version']}, {script}: {row['printed']}, {row['seconds']} s", flush=True)
            with atomic_path(path) as unfinished:
                unfinished.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    embed(table(), PAGE, "libraries")
    embed(references(), PAGE, "references")


if __name__ == "__main__":
    main()
