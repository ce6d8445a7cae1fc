"""Files of results that were cut, edited, copied or made by others: each is named, and none is read in part."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stored_cells import AGENT, ENV, KWARGS, make_cell, unsealed

from servotrack.baselines.evaluation.results import ResultsFolder, read_cell
from servotrack.baselines.reporting.files import ResultsError


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
