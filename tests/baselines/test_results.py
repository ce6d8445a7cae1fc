"""Results on disk: whole or not at all, and never silently somebody else's."""

from __future__ import annotations

import json
import os
import shutil
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servotrack.baselines.evaluation.provenance import digest_of_sources, provenance
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder, read_cell
from servotrack.baselines.reporting.files import ResultsError, atomic_path

ENV, KWARGS, AGENT = "UncalibServo-v0", {"level": 3}, "kf"


def make_cell(seeds: tuple[int, ...] = (1, 2), **changes: Any) -> CellResults:
    rows = [{"seed": seed, "return": 1.5, "length": 10} for seed in seeds]
    card = {"information": "model-free", "requires": [], "tuning_steps": 0, "summary": "a filter"}
    fields: dict[str, Any] = {"provenance": provenance(), "rows": rows, "max_steps": 252, "env_kwargs": dict(KWARGS)}
    return CellResults(env_id=ENV, agent=AGENT, card=card, **{**fields, **changes})


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path / "new" / "results")
    cell = make_cell()
    path = folder.save(cell)
    assert folder.load(ENV, KWARGS, AGENT) == cell
    assert folder.load(ENV, KWARGS, "pf") is None
    assert sorted(p.name for p in path.parent.iterdir()) == ["kf.json"]


def test_provenance_says_with_what_where_and_how() -> None:
    record = provenance()
    assert {"python", "servotrack", "numpy", "gymnasium"} <= set(record["versions"])
    assert record["machine"]["cores"] == os.cpu_count()
    assert record["command"] and record["created"].endswith("+00:00")


def test_a_failed_write_leaves_the_old_file_and_no_debris(tmp_path: Path) -> None:
    target = tmp_path / "file.json"
    target.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_arguments_with_odd_characters_get_a_file_of_their_own(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    paths = {folder.file_of(ENV, {"target": value}, "my.module:Agent") for value in ("a/b", "a_b", "a:b", "x" * 300)}
    assert len(paths) == 4
    assert all(path.parent.parent == tmp_path and len(path.parent.name) < 120 for path in paths)


def damage(path: Path, **changes: Any) -> None:
    document = json.loads(path.read_text())
    document.update(changes)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("break_file", "message"),
    [
        (lambda path: path.write_text(path.read_text()[:100]), "is corrupt"),
        (lambda path: path.write_bytes(b"\xff\xfe\x00"), "is corrupt"),
        (lambda path: path.write_text('{"name": "somebody else"}'), "is not a servotrack result"),
        (lambda path: damage(path, format_version=99), "has format version 99, this servotrack reads 1"),
        (lambda path: damage(path, rows=[{"return": 1.0}]), "rows without a seed"),
        (lambda path: damage(path, agent="pf"), "holds 'pf'"),
        (lambda path: damage(path, env_kwargs={"level": 4}), "level=4"),
        (lambda path: damage(path, provenance={"versions": {"servotrack": "0.0.1"}}), "written by servotrack 0.0.1"),
    ],
    ids=["cut off", "binary", "foreign", "other format", "bad rows", "other agent", "other arguments", "other version"],
)
def test_a_file_that_cannot_be_trusted_is_named_and_left_alone(tmp_path: Path, break_file: Any, message: str) -> None:
    folder = ResultsFolder(tmp_path)
    path = folder.save(make_cell())
    break_file(path)
    before = path.read_bytes()
    with pytest.raises(ResultsError, match=message) as caught:
        folder.load(ENV, KWARGS, AGENT)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def test_a_field_that_is_missing_is_named(tmp_path: Path) -> None:
    path = ResultsFolder(tmp_path).save(make_cell())
    document = json.loads(path.read_text())
    del document["rows"]
    path.write_text(json.dumps(document))
    with pytest.raises(ResultsError, match=r"is corrupt \(no rows\)"):
        read_cell(path)


def test_a_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("a file")
    with pytest.raises(ResultsError, match="is a file, not a results folder"):
        ResultsFolder(tmp_path / "results")
    with pytest.raises(ResultsError, match="cannot be a folder"):
        ResultsFolder(tmp_path / "results" / "inside").check_writable()


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_read_only_folder_is_refused_before_any_work(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    folder.mkdir()
    folder.chmod(0o500)
    with pytest.raises(ResultsError, match="not writable"):
        ResultsFolder(folder).check_writable()
    folder.chmod(0o700)


def test_a_folder_where_nothing_can_be_made_is_refused() -> None:
    with pytest.raises(ResultsError, match="not writable"):
        ResultsFolder("/proc/servotrack").check_writable()


def test_an_empty_folder_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="run `servotrack bench`"):
        ResultsFolder(tmp_path).load_all()


def test_versions_are_not_mixed_on_one_leaderboard(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    folder.save(make_cell())
    other = make_cell()
    other.agent = "pf"
    path = folder.save(other)
    assert len(folder.load_all()) == 2
    damage(path, provenance={"versions": {"servotrack": "0.0.1"}})
    with pytest.raises(ResultsError, match="mixes results of several servotrack versions"):
        folder.load_all()


def test_arguments_that_json_changes_stay_one_environment(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    kwargs = {"latency": (0, 2)}
    path = folder.save(make_cell(env_kwargs={"latency": [0, 2]}))
    assert folder.file_of(ENV, kwargs, AGENT) == path
    loaded = folder.load(ENV, kwargs, AGENT)
    assert loaded is not None
    assert folder.save(loaded) == path
    with pytest.raises(ValueError, match="env_kwargs must be numbers"):
        folder.file_of(ENV, {"latency": object()}, AGENT)


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
