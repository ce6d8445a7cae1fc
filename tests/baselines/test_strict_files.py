"""Files of unknown origin: read as one thing only, within bounds, or refused by name."""

from __future__ import annotations

import json
import os
import time
import tracemalloc
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.baselines.papers.claims import SHIPPED
from servotrack.baselines.reporting.files import ResultsError, read_bounded, read_strict_json, read_strict_yaml
from servotrack.baselines.reporting.strict import parse_json
from servotrack.baselines.training.settings import FOLDER

SCALARS = st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
DOCUMENTS = st.recursive(
    SCALARS | st.integers(-(2**64) + 1, 2**64 - 1),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(DOCUMENTS)
@settings(max_examples=60, deadline=None)
def test_every_ordinary_document_is_read_as_it_was_written(document: object) -> None:
    assert parse_json(json.dumps(document).encode()) == document
    assert parse_json(json.dumps(document, ensure_ascii=False).encode()) == document


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1, "b": {"c": 1, "c": 2}}', "'c' appears twice"),
        (b'{"a": NaN}', "NaN is not a number"),
        (b"[-Infinity]", "-Infinity is not a number"),
        (b"[1e400]", "'1e400' is too large"),
        (b"1" + b"0" * 400, "too large for an integer"),
        (b"1" + b"0" * 90_000, "too large for an integer"),
        (b"[" * 100_000, "deeper than 32 levels"),
        (b"[" * 33 + b"]" * 33, "deeper than 32 levels"),
        (b'{"a":' * 500 + b"1" + b"}" * 500, "deeper than 32 levels"),
        (b'"\xff"', "invalid start byte"),
        (b'{"\\ud800": 1}', "surrogates not allowed"),
        (b"", "Expecting value"),
        (b"{} {}", "Extra data"),
    ],
    ids=range(13),
)
def test_json_that_can_be_read_in_two_ways_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=message) as caught:
        read_strict_json(path, 1_000_000)
    assert str(caught.value).startswith(f"{path} is corrupt (") and len(str(caught.value)) < 300 + len(str(path))


def test_only_regular_files_of_a_bounded_size_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"1234")
    assert read_bounded(path, 4) == b"1234"
    with pytest.raises(ResultsError, match="more than 3 bytes"):
        read_bounded(path, 3)
    (tmp_path / "link").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe"):
        with pytest.raises(ResultsError, match=f"{name} is not a regular file"):
            read_bounded(tmp_path / name, 10)
    for name in ("missing", "", "nul\0"):
        with pytest.raises(ResultsError, match="cannot be read"):
            read_bounded(tmp_path / name, 10)


def bomb(line: str) -> str:
    """Nine lines, each of which names the one before it nine times."""
    names = "abcdefghij"
    rows = [f"{name}: &{name} {line % ','.join([f'*{before}'] * 9)}" for before, name in pairwise(names)]
    return "\n".join(["a: &a {x: 1}", *rows])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (bomb("[%s]"), "line 5: more than 20000 values"),
        (bomb("{<<: [%s]}"), "line 5: more than 20000 values"),
        ("a: &a [*a]", "line 1: an alias stands inside"),
        ("a: 1\nb: 2\na: 3", "line 3: 'a' appears twice"),
        ("[" * 20_000, "deeper than 32 levels"),
        ("- " * 20_000, "deeper than 32 levels"),
        ("x: !!python/object/apply:os.system [true]", "could not determine a constructor"),
        (f"x: !{'t' * 100_000}", "could not determine a constructor"),
        ("a" * 600_000, "more than 500000 bytes"),
        ("x: [", "expected the node content"),
    ],
    ids=range(10),
)
def test_yaml_that_multiplies_or_is_ambiguous_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(text)
    tracemalloc.start()
    started = time.process_time()
    with pytest.raises(ResultsError, match=message) as caught:
        read_strict_yaml(path)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
    assert time.process_time() - started < 10.0
    assert str(path) in str(caught.value) and len(str(caught.value)) < 700 + len(str(path))


@pytest.mark.parametrize("path", [SHIPPED, *sorted(FOLDER.glob("*.yml"))], ids=lambda path: path.name)
def test_the_package_s_own_files_read_the_same(path: Path) -> None:
    assert read_strict_yaml(path) == yaml.safe_load(path.read_text(encoding="utf-8"))
