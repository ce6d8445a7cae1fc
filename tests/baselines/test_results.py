"""Results on disk: whole or not at all, merged by seed, and of one version."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from stored_cells import AGENT, ENV, KWARGS, make_cell, unsealed

from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import ResultsError, atomic_path


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path / "new" / "results")
    cell = make_cell()
    path = folder.save(cell)
    assert folder.load(ENV, KWARGS, AGENT) == cell
    assert folder.load(ENV, KWARGS, "pf") is None
    assert sorted(p.name for p in path.parent.iterdir()) == ["kf.json"]


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


def test_saving_merges_by_seed(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    first, second = make_cell((3, 1), step_seconds=[1e-3]), make_cell((2, 3))
    first.provenance = {**first.provenance, "command": "the first"}
    folder.save(first)
    folder.save(second)
    stored = folder.load(ENV, KWARGS, AGENT)
    assert stored is not None
    assert stored == second
    assert stored.seeds == [1, 2, 3]
    assert stored.step_seconds == [1e-3] and stored.provenance["command"] == "the first"
    second.step_seconds = [5e-3]
    folder.save(second)
    newest = folder.load(ENV, KWARGS, AGENT)
    assert newest is not None and newest.step_seconds == [5e-3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda cell: cell.rows[0].update({"return": 1.5 + 2e-16}),
            "seed 1 has return 1.5 there and 1.5000000000000002",
        ),
        (lambda cell: cell.rows[1].update({"steady": 0.1}), "seed 2 has steady None there and 0.1"),
        (lambda cell: cell.card.update({"summary": "another filter"}), "card is .* another agent"),
        (lambda cell: setattr(cell, "max_steps", 100), "max_steps is 252 there and 100"),
    ],
)
def test_contradictions_are_named_and_the_file_stays(tmp_path: Path, change: Any, message: str) -> None:
    folder = ResultsFolder(tmp_path)
    path = folder.save(make_cell())
    before = path.read_bytes()
    cell = make_cell((1, 2, 3))
    change(cell)
    with pytest.raises(ResultsError, match=message) as caught:
        folder.save(cell)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def test_results_of_another_version_are_not_extended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ResultsFolder(tmp_path)
    folder.save(make_cell())
    monkeypatch.setattr("servotrack.baselines.evaluation.results.code_version", lambda: "9.9.9")
    with pytest.raises(ResultsError, match=r"was written by servotrack .*, this is 9\.9\.9"):
        folder.save(make_cell((5,)))


def test_unfinished_files_are_removed_once_their_writer_is_gone(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path\n"
        "from servotrack.baselines.reporting.files import atomic_path\n"
        "with atomic_path(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half'); print('begun', flush=True); time.sleep(60)\n"
    )
    cell_folder = tmp_path / "world"
    writer = subprocess.Popen(
        [sys.executable, "-c", code, str(cell_folder / "a.json")], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None and writer.stdout.readline() == "begun\n"
    (cell_folder / ".unfinished-0badcafe-1.json").write_text("of another machine")
    folder = ResultsFolder(tmp_path)
    folder.check_writable()
    assert len(list(cell_folder.iterdir())) == 2, "a file was removed under its writer"
    writer.kill()
    writer.wait()
    writer.stdout.close()
    folder.check_writable()
    assert [path.name for path in cell_folder.iterdir()] == [".unfinished-0badcafe-1.json"]


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
    unsealed(path, provenance={"versions": {"servotrack": "0.0.1"}})
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
