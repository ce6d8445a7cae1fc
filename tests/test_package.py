"""The package as a whole: what is shipped, what an import costs, what every environment's page has to say."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import pytest

import servotrack
from servotrack.envs.registration import ENVIRONMENTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
ROOMS = {
    "servotrack": "package",
    "servotrack.envs": "envs",
    "servotrack.estimators": "estimators",
    "servotrack.baselines": "baselines",
}
HEAVY = {
    "torch", "stable_baselines3", "matplotlib", "pygame", "numba", "cv2", "scipy", "pymunk", "rich", "typer",
    "onnxruntime",
}  # fmt: skip
OPTIONAL = {"torch", "stable_baselines3", "sb3_contrib", "onnx", "pygame", "mujoco", "pytest"}
TRAINING = "servotrack.baselines.training"
"""The only package that imports torch, Stable-Baselines3, sb3_contrib or onnx."""
OTHER_INTERPRETERS = {
    "servotrack.baselines.speed.stone_soup",
    "servotrack.baselines.leaderboard.stone_soup_tracks",
    "servotrack.estimators.rfs.stone_soup",
}
"""Modules for the virtual environment of a library that they are compared with or adapted to."""
CACHES = {"__pycache__", ".mypy_cache", ".ruff_cache"}
SECTIONS = [
    "Description",
    "Action Space",
    "Observation Space",
    "Rewards",
    "Starting State",
    "Episode End",
    "Arguments",
    "References",
    "Version History",
]


@pytest.fixture(scope="module")
def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_folder_with_code_is_a_listed_package(pyproject: dict[str, Any]) -> None:
    found = set()
    for name, folder in ROOMS.items():
        for module in (ROOT / folder).rglob("*.py"):
            found.add(".".join([name, *module.parent.relative_to(ROOT / folder).parts]))
    assert set(pyproject["tool"]["setuptools"]["packages"]) == found
    assert pyproject["tool"]["setuptools"]["package-dir"] == ROOMS


def test_every_data_file_is_shipped(pyproject: dict[str, Any]) -> None:
    patterns = pyproject["tool"]["setuptools"]["package-data"]
    shipped = {path for package, globs in patterns.items() for glob in globs for path in _folder(package).glob(glob)}
    data = {
        path
        for folder in ROOMS.values()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".py" and not CACHES & set(path.relative_to(ROOT).parts)
    }
    assert data == shipped


def _folder(package: str) -> Path:
    room = max((name for name in ROOMS if f"{package}.".startswith(f"{name}.")), key=len)
    return ROOT.joinpath(ROOMS[room], *package[len(room) + 1 :].split("."))


def test_version_is_said_everywhere_alike(pyproject: dict[str, Any]) -> None:
    version = pyproject["project"]["version"]
    assert servotrack.__version__ == version == metadata.version("servotrack")
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_types_are_shipped() -> None:
    assert resources.files("servotrack").joinpath("py.typed").is_file()


def test_import_is_light() -> None:
    probe = "import sys, servotrack; print(*{name.partition('.')[0] for name in sys.modules})"
    modules = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True).stdout.split()
    assert not HEAVY & set(modules)


def test_no_module_outside_training_needs_an_optional_library_to_be_imported() -> None:
    modules = {
        ".".join([name, *path.relative_to(ROOT / folder).with_suffix("").parts])
        for name, folder in ROOMS.items()
        for path in (ROOT / folder).rglob("*.py")
        if path.stem not in {"__init__", "__main__"}
    }
    assert modules > OTHER_INTERPRETERS
    names = sorted(name for name in modules - OTHER_INTERPRETERS if not name.startswith(f"{TRAINING}."))
    probe = (
        f"import importlib, sys; [importlib.import_module(name) for name in {names}]; "
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    loaded = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True).stdout.split()
    assert not OPTIONAL & set(loaded)


def test_import_is_fast() -> None:
    # Processor time and the best of five: what the import costs, not what else the machine was doing.
    probe = "import time; start = time.process_time(); import servotrack; print(time.process_time() - start)"
    runs = [subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True) for _ in range(5)]
    assert min(float(run.stdout) for run in runs) < 0.4


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_environment_has_gymnasium_s_sections_in_order(env_id: str) -> None:
    module, _, name = ENVIRONMENTS[env_id]["entry_point"].partition(":")
    doc = inspect.cleandoc(getattr(importlib.import_module(module), name).__doc__)
    assert re.findall(r"^## (.+)$", doc, re.MULTILINE) == SECTIONS
    for section in SECTIONS:
        body = re.search(rf"^## {section}\n(.*?)(?=^## |\Z)", doc, re.MULTILINE | re.DOTALL)
        assert body is not None and body.group(1).strip(), f"section {section} of {env_id} is empty"
