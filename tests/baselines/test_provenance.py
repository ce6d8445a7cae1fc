"""What results say of their origin, and the version that follows the sources which decide a row."""

from __future__ import annotations

import os
import shutil
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest

from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.provenance import digest_of_sources, provenance
from servotrack.envs.servo.engine import same_bits


def test_provenance_says_with_what_where_and_how() -> None:
    record = provenance()
    assert {"python", "servotrack", "numpy", "gymnasium"} <= set(record["versions"])
    assert record["machine"]["cores"] == os.cpu_count()
    assert record["command"] and record["created"].endswith("+00:00")


def test_results_say_which_engine_moved_the_arm() -> None:
    """One record of a run serves several cells, and only those with a choice of engines name one."""
    record = provenance()
    default = evaluate("UncalibServo-v0", "random", [0], {"horizon": 70}, timing=False, record=record)
    named = evaluate("UncalibServo-v0", "random", [0], {"horizon": 70, "engine": "pymunk"}, timing=False, record=record)
    clutter = evaluate("ClutterTracking-v0", "raw-measurements", [0], {"horizon": 3}, timing=False, record=record)
    assert default.provenance["engine"] == ("compiled" if same_bits() else "pymunk")
    assert named.provenance["engine"] == "pymunk"
    assert "engine" not in clutter.provenance and "engine" not in record


@pytest.fixture
def copied_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the sources whose files a test may edit, read by `digest_of_sources`."""
    import servotrack.baselines.evaluation.provenance as provenance

    for room in ("envs", "estimators", "baselines"):
        shutil.copytree(Path(str(find_spec(f"servotrack.{room}").origin)).parent, tmp_path / room)  # type: ignore[union-attr]
    monkeypatch.setattr(
        provenance,
        "find_spec",
        lambda name: SimpleNamespace(origin=str(tmp_path / name.rpartition(".")[2] / "__init__.py")),
    )
    return tmp_path


@pytest.mark.parametrize(
    ("source", "stale"),
    [
        ("estimators/jacobian/kf.py", True),
        ("envs/servo/world.py", True),
        ("baselines/agents/servo/jacobian_servo.py", True),
        ("baselines/agents/learned/networks/UncalibServo-v0-level3-ppo.onnx", True),
        ("baselines/evaluation/servo_scores.py", True),
        ("baselines/evaluation/servo3d_scores.py", True),
        ("baselines/reporting/grid.py", False),
        ("baselines/leaderboard/table.py", False),
        ("baselines/papers/claims.py", False),
        ("baselines/track_command/run.py", False),
        ("baselines/worlds.py", False),
    ],
)
def test_the_version_follows_the_sources_that_decide_a_row(source: str, stale: bool, copied_package: Path) -> None:
    before = digest_of_sources()
    assert before == digest_of_sources()
    with (copied_package / source).open("ab") as file:
        file.write(b"\n")
    assert (before != digest_of_sources()) == stale
