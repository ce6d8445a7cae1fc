"""Results on disk: whole or not at all, and never silently somebody else's."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
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


def unsealed(path: Path, **changes: Any) -> None:
    """Write the file as servotrack 0.1.0 did: format version 1, without digests."""
    document = json.loads(path.read_text()) | {"format_version": 1}
    del document["sha256"]
    for row in document["rows"]:
        del row["sha256"]
    path.write_text(json.dumps(document | changes))


@pytest.mark.parametrize(
    ("break_file", "message"),
    [
        (lambda path: path.write_text(path.read_text()[:100]), "is corrupt"),
        (lambda path: path.write_bytes(b"\xff\xfe\x00"), "is corrupt"),
        (lambda path: path.write_text('{"name": "somebody else"}'), "is not a servotrack result"),
        (lambda path: damage(path, format_version=99), "has format version 99, this servotrack reads 2 and 1"),
        (lambda path: damage(path, format_version=1), "unknown field 'sha256'"),
        (lambda path: unsealed(path, rows=[{"return": 1.0}]), r"rows\[0\]\.seed must be an integer"),
        (lambda path: unsealed(path, agent="pf"), r"holds 'pf' in .*, whose file is .*pf\.json"),
        (lambda path: unsealed(path, env_kwargs={"level": 4}), r"holds 'kf' in UncalibServo-v0,level=4"),
        (lambda path: unsealed(path, env_kwargs={"level": "3"}), "holds 'kf' in UncalibServo-v0,level=3, not"),
        (
            lambda path: unsealed(path, provenance={"versions": {"servotrack": "0.0.1"}}),
            r"written by servotrack 0\.0\.1",
        ),
        (lambda path: path.write_text('{"rows": ' + "[" * 10_000), "deeper than 32 levels"),
        (lambda path: path.write_text(path.read_text().replace('"rows"', '"agent": "kf", "rows"')), "appears twice"),
        (lambda path: path.write_text(path.read_text().replace("252", "1" + "0" * 400)), "too large"),
        (lambda path: unsealed(path, provenance={"versions": None}), "provenance must name the version"),
        (lambda path: unsealed(path, card=[]), "card must be an object"),
        (lambda path: unsealed(path, kind="nothing"), "kind must be one of"),
        (lambda path: unsealed(path, kind="other"), "kind must be 'servo', the kind of UncalibServo-v0"),
    ],
    ids=range(17),
)
def test_a_file_that_cannot_be_trusted_is_named_and_left_alone(tmp_path: Path, break_file: Any, message: str) -> None:
    folder = ResultsFolder(tmp_path)
    path = folder.save(make_cell())
    break_file(path)
    before = path.read_bytes()
    for use in (lambda: folder.load(ENV, KWARGS, AGENT), lambda: folder.save(make_cell((7,)))):
        with pytest.raises(ResultsError, match=message) as caught:
            use()
        assert str(path) in str(caught.value)
    assert path.read_bytes() == before


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values in a document, those of lists and objects included."""
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from leaves(inner, (*path, key))


def parent_of(document: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        document = document[key]
    return document


REPLACEMENTS: list[Any] = [None, True, 0, -1, 3, 1.5, 1e300, "", "x", [], [1], {}, {"a": 1}]


def test_every_edit_is_detected_and_named(tmp_path: Path) -> None:
    path = ResultsFolder(tmp_path).save(make_cell((1, 2, 5), step_seconds=[1e-3, 2e-3]))
    good = path.read_text()
    edits = 0

    def refused(document: Any, field: str) -> None:
        nonlocal edits
        edits += 1
        path.write_text(json.dumps(document))
        with pytest.raises(ResultsError) as caught:
            read_cell(path)
        assert str(caught.value).startswith(str(path)) and len(str(caught.value)) < 500 + len(str(path))
        # Of a file of another format no field is named.
        shown = {"format": "not a servotrack result", "format_version": "format version"}.get(field, field)
        assert shown in str(caught.value), (field, str(caught.value))

    paths = list(leaves(json.loads(good)))
    assert len(paths) > 50
    for where in paths:
        # A row is named by its number or by its seed, a digest by its field.
        field = where[-1] if where[0] == "sha256" else "row" if where[0] == "rows" else where[0]
        for value in REPLACEMENTS:
            document = json.loads(good)
            parent = parent_of(document, where)
            if json.dumps(parent[where[-1]]) != json.dumps(value):
                parent[where[-1]] = value
                refused(document, field)
        document = json.loads(good)
        del parent_of(document, where)[where[-1]]
        # Without one digest or with one more, the digests themselves are what is wrong.
        whole = "sha256" if where[0] == "sha256" else field
        refused(document, whole)
        parent = parent_of(document := json.loads(good), where)
        if isinstance(parent, dict):
            parent["an unknown name"] = 1
            refused(document, whole if len(where) > 1 else "an unknown name")
    for change in (lambda rows: rows.reverse(), lambda rows: rows.append(rows[0]), lambda rows: rows.clear()):
        document = json.loads(good)
        change(document["rows"])
        refused(document, "rows")
    assert edits > 700
    path.write_text(json.dumps(json.loads(good), indent=4))
    assert read_cell(path).seeds == [1, 2, 5], "layout is no content"


def test_a_row_of_another_agent_is_refused_although_its_own_digest_fits(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    documents = []
    for agent in (AGENT, "pf"):
        cell = make_cell()
        cell.agent = agent
        cell.rows[0]["return"] = float(len(documents))
        documents.append(json.loads(folder.save(cell).read_text()))
    documents[0]["rows"][0] = documents[1]["rows"][0]
    path = folder.file_of(ENV, KWARGS, AGENT)
    path.write_text(json.dumps(documents[0]))
    with pytest.raises(ResultsError, match="the row of seed 1 or its digest was changed"):
        read_cell(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steady": -1e-3}, r"rows\[0\]\.steady must lie in 1e-15 to 1e\+09 \(seed 1\), got -0.001"),
        ({"steady": 1e-300}, r"rows\[0\]\.steady must lie in 1e-15 to"),
        ({"success": 1}, r"rows\[0\]\.success must be true or false"),
        ({"length": 0}, r"rows\[0\]\.length must lie in 1 to inf"),
        ({"return": float("nan")}, r"rows\[0\]\.return must be a finite number \(seed 1\), got nan"),
        ({"seed": -1}, r"rows\[0\]\.seed must be an integer >= 0"),
        ({"seed": True}, r"rows\[0\]\.seed must be an integer >= 0"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    folder = ResultsFolder(tmp_path)
    cell = make_cell()
    cell.rows[0] |= change
    with pytest.raises(ResultsError, match=message):
        folder.save(cell)
    assert not list(tmp_path.glob("*/*"))


def test_results_of_version_0_1_0_are_read_and_said_to_have_no_digests(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    path = folder.save(make_cell())
    sealed_cell = read_cell(path)
    unsealed(path)
    found = read_cell(path)
    assert found == sealed_cell and (sealed_cell.has_digests, found.has_digests) == (True, False)
    document = json.loads(path.read_text())
    del document["kind"]
    path.write_text(json.dumps(document))
    assert read_cell(path).kind == "servo"


def test_a_file_does_not_import_what_it_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evil_world.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    path = ResultsFolder(tmp_path).save(make_cell())
    unsealed(path, env_id="evil_world:Evil-v0", kind="")
    assert read_cell(path).kind == "other"


def test_a_copied_file_does_not_pass_for_another_agent_s(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    path = folder.save(make_cell())
    shutil.copy(path, path.with_name("oracle.json"))
    with pytest.raises(ResultsError, match=r"oracle\.json holds 'kf' in .*, whose file is .*kf\.json"):
        folder.load_all()
    with pytest.raises(ResultsError, match="holds 'kf'"):
        folder.load(ENV, KWARGS, "oracle")


@pytest.mark.parametrize("changes", [{"kind": "servo"}, {"env_kwargs": {"size": "3"}}])
def test_files_that_contradict_each_other_about_their_world_are_named(tmp_path: Path, changes: dict[str, Any]) -> None:
    folder = ResultsFolder(tmp_path)
    for agent, fields in (("kf", {}), ("ukf", changes)):
        cell = make_cell(env_kwargs={"size": 3}, kind="other")
        cell.env_id, cell.agent = "Foreign-v0", agent
        for name, value in fields.items():
            setattr(cell, name, value)
        path = folder.save(cell)
    with pytest.raises(ResultsError, match=r"ukf\.json says kind .* in the same environment says") as caught:
        folder.load_all()
    assert str(path) in str(caught.value)


TOKENS = [
    b"NaN",
    b"1e999",
    b"{}",
    b"[]",
    b"null",
    b"true",
    b'"',
    b",",
    b"}",
    b"[" * 40,
    b"\xff",
    b'"rows": [],',
    b"-",
    b"0",
]


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Change, remove, insert or repeat bytes at random places."""
    for _ in range(int(rng.integers(1, 4))):
        start = int(rng.integers(len(content)))
        end = start + int(rng.integers(1, 30))
        kind = int(rng.integers(6))
        flipped = bytes([content[start] ^ 1]) + content[start + 1 : end]
        token = TOKENS[int(rng.integers(len(TOKENS)))]
        random = bytes(rng.integers(256, size=end - start, dtype=np.uint8))
        middle = [flipped, token + content[start:end], token, random, b"", content[start:end] * 2][kind]
        content = content[:start] + middle + content[end:]
    return content


def try_damaged_files(folder: Path, count: int) -> int:
    """Read damaged files; return how many still said the same."""
    path = ResultsFolder(folder).save(make_cell((1, 2), step_seconds=[1e-3]))
    good, cell = path.read_bytes(), read_cell(path)
    rng = np.random.default_rng(0)
    same = 0
    for _ in range(count):
        path.write_bytes(mutated(good, rng))
        try:
            found = read_cell(path)
        except ResultsError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)
        else:
            assert found == cell
            same += 1
    return same


def test_damaged_files_are_refused_or_say_the_same(tmp_path: Path) -> None:
    assert try_damaged_files(tmp_path, 500) < 50


@pytest.mark.slow
def test_100_000_damaged_files_are_refused_or_say_the_same(tmp_path: Path) -> None:
    assert try_damaged_files(tmp_path, 100_000) < 10_000


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
