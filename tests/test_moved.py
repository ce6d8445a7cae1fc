"""Import paths of version 0.1 still work, and name the new ones."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from servotrack._moved import MOVED, RENAMED

README_OF_0_1 = """
from servotrack.baselines.evaluate import evaluate
from servotrack.baselines.video_trackers import create_detector, create_tracker
from servotrack.envs.track.frames import open_frames
from servotrack.estimators.online import Online
from servotrack.baselines import create_agent
import servotrack.baselines
assert servotrack.baselines.evaluate is not None and callable(servotrack.baselines.evaluate)
assert evaluate.__module__ == "servotrack.baselines.evaluation.evaluate"
assert Online.__name__ == "Stateful"
"""


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_forwards_and_names_the_new_one(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} has moved to {MOVED[old]}") as caught:
        module = importlib.import_module(old)
    assert caught[0].filename == __file__ or "importlib" in caught[0].filename
    new = importlib.import_module(MOVED[old])
    name = next(name for name in vars(new) if not name.startswith("_"))
    assert getattr(module, name) is getattr(new, name)


@pytest.mark.parametrize(("old", "name"), RENAMED)
def test_a_renamed_name_is_found_under_its_old_one(old: str, name: str) -> None:
    with pytest.warns(DeprecationWarning):
        sys.modules.pop(old, None)
        module = importlib.import_module(old)
    assert getattr(module, name) is getattr(importlib.import_module(MOVED[old]), RENAMED[old, name])


def test_what_the_first_readme_imported_still_runs_with_warnings_and_without_failure() -> None:
    run = subprocess.run(
        [sys.executable, "-W", "always", "-c", README_OF_0_1], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert run.stderr.count("DeprecationWarning") == 4
    assert "import servotrack.baselines.evaluation.evaluate instead" in run.stderr


def test_a_path_that_never_was_is_no_module() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("servotrack.baselines.nothing")


def test_names_of_the_face_are_the_functions_themselves() -> None:
    import servotrack.baselines as face

    assert sorted(face.__all__) == sorted(name for name in dir(face) if name in face.__all__)
    for name in face.__all__:
        assert callable(getattr(face, name))
