"""Submissions that are not what they say: every one is refused or found different, and none ends in a traceback."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_cases import CELL, ROWS, TRACE, judged, resealed, rows_content, write_contents, write_suite

from servotrack.baselines.board.submission import read_submission
from servotrack.baselines.board.suites import load_suite
from servotrack.baselines.board.trace_files import Trace, decoded, encoded
from servotrack.baselines.board.verify import submission_folders, verify

Contents = dict[str, bytes]
Change = Callable[[Contents], Contents]
AGENT = "agent/agent.json"


def _card(**changes: Any) -> Change:
    return lambda contents: resealed(contents, **changes)


def _claims(**changes: Any) -> Change:
    return lambda contents: resealed(contents, claims={**json.loads(contents["card.json"])["claims"], **changes})


def _file(name: str, change: Callable[[bytes], bytes]) -> Change:
    return lambda contents: resealed({**contents, name: change(contents[name])})


def _rows(change: Callable[[dict[str, Any]], Any]) -> Change:
    def changed(content: bytes) -> bytes:
        document = json.loads(content)
        change(document)
        return rows_content(document)

    return _file(ROWS, changed)


def _row(part: str, column: str, value: Callable[[Any], Any]) -> Change:
    def change(document: dict[str, Any]) -> None:
        row, at = document[part][0], document["columns"].index(column)
        row[at] = value(row[at])

    return _rows(change)


def _episodes(change: Callable[[list[Any]], Any]) -> Change:
    def changed(content: bytes) -> bytes:
        episodes = [episode.copy() for episode in decoded(content, 4, 2, 32_767, 1000).episodes]
        return encoded(Trace(32_767, tuple(change(episodes) or episodes)))

    return _file(TRACE, changed)


def _nudge(episodes: list[Any]) -> None:
    # In the episode before it the arm rests at a joint limit, where another rate beyond it changes nothing.
    episodes[3][40, 1] += 1


def _header(index: int, value: int) -> Change:
    def changed(content: bytes) -> bytes:
        values = list(struct.unpack_from("<8sIIII", content))
        values[index] = value
        return struct.pack("<8sIIII", *values) + content[24:]

    return _file(TRACE, changed)


def _bomb(content: bytes) -> bytes:
    return content[:40] + zlib.compress(bytes(20_000_000))


def _swap(document: dict[str, Any]) -> None:
    document["public"], document["sealed"] = document["sealed"], document["public"]


def _without_seal(contents: Contents) -> Contents:
    card = json.loads(contents["card.json"])
    card["claims"]["summary"] = "the best agent"
    return {**contents, "card.json": (json.dumps(card, indent=1, sort_keys=True) + "\n").encode()}


def _text(old: str, new: str) -> Change:
    return lambda contents: {**contents, "card.json": contents["card.json"].replace(old.encode(), new.encode(), 1)}


DEEP = b"[" * 100_000 + b"]" * 100_000
CHANGES: dict[str, Change] = {
    # Folder
    "no card": lambda c: {name: content for name, content in c.items() if name != "card.json"},
    "no trace": lambda c: {name: content for name, content in c.items() if name != TRACE},
    "another file": lambda c: {**c, "run.sh": b"#!/bin/sh\n"},
    "another folder": lambda c: {**c, "more/file": b"x"},
    "a nested folder": lambda c: {**c, "agent/more/file": b"x"},
    "many files": lambda c: {**c, **{f"agent/{k}": b"x" for k in range(400)}},
    "a large card": lambda c: {**c, "card.json": c["card.json"] + b" " * 300_000},
    # JSON
    "not JSON": lambda c: {**c, "card.json": b"\x00\xff"},
    "deep JSON": lambda c: {**c, "card.json": DEEP},
    "NaN in the card": _text('"tuning_steps": ', '"tuning_steps": NaN, "x": '),
    "a repeated key": _text('"name": "kf"', '"name": "kf", "name": "kf"'),
    "another spacing": _text('"name": "kf"', '"name":  "kf"'),
    "a list": lambda c: {**c, "card.json": b"[]"},
    # Card
    "an unsealed change": _without_seal,
    "an unknown field": _card(rank=1),
    "a name with markup": _card(name="<script>alert(1)</script>"),
    "a name that leaves the folder": _card(name="../../kf"),
    "another agent's name": _card(name="lifted-kf"),
    "a file's name": _card(name="kf.json"),
    "a module's name": _card(name="os:system"),
    "an unknown law": _card(name="kf+lucky"),
    "an unknown suite": _card(suite="2026z"),
    "another format": _card(format="servotrack-results"),
    "another version": _card(format_version=2),
    "a true version": _card(format_version=True),
    "a network that is none": _card(name="x", agent={"kind": "network", "entry": ["agent.json"], "files": {}}),
    "a network that is missing": _card(name="x", agent={"kind": "network", "entry": ["x.json"], "files": {}}),
    "a command with a path": _card(name="x", agent={"kind": "command", "entry": ["/bin/sh"], "files": {}}),
    "a command that climbs": _card(name="x", agent={"kind": "command", "entry": ["../sh"], "files": {}}),
    "less information than used": _claims(information="undeclared"),
    "the truth claimed away": _claims(requires=["truth"]),
    "infinite cost": _text('"step_seconds": ', '"step_seconds": 1e999, "x": '),
    # Agent
    "metadata in the agent's file": _file(AGENT, lambda content: content.replace(b"{", b'{ "comment": 7,')),
    "spaces in the agent's file": _file(AGENT, lambda content: content + b" "),
    "another version of the package": _file(AGENT, lambda content: content.replace(b'"0.', b'"9.')),
    "a version that never was": _file(AGENT, lambda content: content.replace(b'"0.', b'"0.4711.')),
    "a version that is free text": _file(AGENT, lambda content: content.replace(b'"0.', b'"lucky-4711-')),
    # Rows
    "another spacing of rows": _file(ROWS, lambda content: content.replace(b", ", b",", 1)),
    "a number written otherwise": _file(ROWS, lambda content: content.replace(b"[200000, ", b"[200000.0, ", 1)),
    "a better score": _row("public", "steady", lambda value: value * 0.9),
    "a score better by the last bit": _row("sealed", "steady", lambda value: float(np.nextafter(value, 0.0))),
    "a success": _row("public", "success", lambda value: not value),
    "a whole number for a true value": _row("public", "success", int),
    "a longer episode": _row("public", "length", lambda value: value + 1),
    "an endless episode": _row("public", "length", lambda value: 10**15),
    "a true length": _row("public", "length", lambda value: True),
    "a negative error": _row("public", "steady", lambda value: -value),
    "an error of zero": _row("public", "steady", lambda value: 0.0),
    "an infinite return": _file(ROWS, lambda content: content.replace(b"200000, ", b"200000, 1e999, ", 1)),
    "chosen public seeds": _row("public", "seed", lambda value: value + 5),
    "chosen sealed seeds": _row("sealed", "seed", lambda value: value + 1),
    "a row twice": _rows(lambda d: d["public"].append(d["public"][0])),
    "a row less": _rows(lambda d: d["public"].pop()),
    "exchanged parts": _rows(_swap),
    "no errors": _rows(lambda d: d["columns"].__setitem__(d["columns"].index("steady"), "other")),
    "a column twice": _rows(lambda d: d["columns"].__setitem__(1, "seed")),
    "rows that are texts": _rows(lambda d: d["public"].__setitem__(0, "row")),
    "rows of another cell": _rows(lambda d: d.__setitem__("cell", "UncalibServo-v0,level=0")),
    "an unknown column": _rows(lambda d: [d["columns"].append("bonus"), *[r.append(1.0) for r in d["public"]],
                                          *[r.append(1.0) for r in d["sealed"]]]),
    # Traces
    "one action moved by a step of the grid": _episodes(_nudge),
    "exchanged episodes": _episodes(lambda e: [e[1], e[0], *e[2:]]),
    "an action out of bounds": _file(TRACE, lambda content: encoded(Trace(32_767, tuple(
        np.full((66, 2), -32_768, np.int16) for _ in range(4))))),
    "a shorter episode": _episodes(lambda e: [e[0][:-1], *e[1:]]),
    "a longer episode in the trace": _episodes(lambda e: [np.concatenate([e[0], e[0][:1]]), *e[1:]]),
    "an episode less": _episodes(lambda e: e[:-1]),
    "no magic": _header(0, b"STTRACE2"),  # type: ignore[arg-type]
    "a wrong number of episodes": _header(1, 3),
    "four billion episodes": _header(1, 2**32 - 1),
    "three components": _header(2, 3),
    "another grid": _header(3, 1),
    "another number of steps": _header(4, 2**32 - 1),
    "a bomb": _file(TRACE, _bomb),
    "half a trace": _file(TRACE, lambda content: content[: len(content) // 2]),
    "a trace with more behind it": _file(TRACE, lambda content: content + b"x"),
    "an empty trace": _file(TRACE, lambda content: b""),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_hostile_submissions_are_caught(
    name: str, folder: Callable[[Contents], Path], original: Contents, suite: Path
) -> None:
    changed = CHANGES[name](original)
    assert changed != original
    verdict = judged(folder(changed), suite)
    assert not verdict.is_confirmed
    assert verdict.badge == "self-reported"
    assert verdict.refused or any(cell.detail for cell in verdict.cells.values())
    assert len(verdict.refused) < 1000


def test_the_tests_write_rows_as_submit_does(original: Contents) -> None:
    assert rows_content(json.loads(original[ROWS])) == original[ROWS]


def test_agents_of_an_earlier_version_are_still_replayed(
    folder: Callable[[Contents], Path], original: Contents, suite: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import servotrack
    from servotrack.baselines.board import verification

    monkeypatch.setattr(verification, "EARLIER_VERSIONS", (servotrack.__version__,))
    monkeypatch.setattr(servotrack, "__version__", "99.0.0")
    assert judged(folder(original), suite).badge == "replayed"
    changed = _file(AGENT, lambda content: content.replace(b"{", b'{ "comment": 7,'))(original)
    assert not judged(folder(changed), suite).is_confirmed


def test_what_is_not_a_file_is_refused(folder: Callable[[Contents], Path], original: Contents, suite: Path) -> None:
    def check(expected: str) -> None:
        verdict = judged(path, suite)
        assert expected in verdict.refused, verdict.refused

    for name in ("card.json", ROWS, AGENT):
        path = folder(original)
        outside = path.parent / "outside"
        (path / name).rename(outside)
        (path / name).symlink_to(outside)
        check("not a regular file")
        (path / name).unlink()
        os.mkfifo(path / name)
        check("not a regular file")
    path = folder(original)
    (path / "rows").rename(path.parent / "rows")
    (path / "rows").symlink_to(path.parent / "rows")
    check("not a regular file")
    path = folder(original)
    real = path.rename(path.parent / "real")
    path.symlink_to(real)
    check("not a folder")
    path = path.parent / "nothing"
    check("cannot be read")


def test_actions_that_no_agent_gave_are_found_by_running_it(
    folder: Callable[[Contents], Path], original: Contents, suite: Path
) -> None:
    from servotrack.baselines.agents.registry import agent_card
    from servotrack.baselines.board.recording import AgentPlayer
    from servotrack.baselines.board.submit import recorded

    path = folder(original)
    frozen = load_suite(str(suite))
    sealed = [episode.seed for episode in read_submission(path, frozen).cells[0].episodes("sealed")]
    # The oracle's actions and their true rows under the name of the Kalman filter.
    rows, trace = recorded(
        frozen,
        frozen.cells[0],
        AgentPlayer(agent_card("oracle")).play(frozen, frozen.cells[0], [*frozen.cells[0].public_seeds, *sealed]),
    )
    path = folder(resealed({**original, ROWS: rows, TRACE: trace}))
    assert judged(path, suite).badge == "replayed"
    verdict = judged(path, suite, run=True)
    assert verdict.badge == "replayed"
    assert verdict.notes == ["The agent gives other actions than the submitted ones."]
    assert "has another action at step" in verdict.cells[CELL].detail
    assert judged(folder(original), suite, run=True, nonce="7", fresh=3).badge == "re-run"


def test_rows_of_other_machines_may_differ_in_the_last_digits(
    folder: Callable[[Contents], Path], original: Contents, suite: Path
) -> None:
    record = json.loads(original["card.json"])["provenance"]
    record["machine"]["arithmetic"] = "0" * 16
    for factor, state in ((1.0, "equal"), (1.0 + 1e-9, "close"), (1.0 + 1e-5, "different")):
        changed = _row("public", "steady", lambda value, factor=factor: value * factor)(original)
        verdict = judged(folder(resealed(changed, provenance=record)), suite)
        assert verdict.cells[CELL].state == state


def test_rows_of_another_world_are_stale(
    tmp_path: Path, folder: Callable[[Contents], Path], original: Contents
) -> None:
    verdict = judged(folder(original), write_suite(tmp_path, behavior="0" * 64))
    assert verdict.cells[CELL].state == "stale"
    assert not verdict.is_confirmed
    assert verdict.badge == "self-reported"


def test_the_child_process_gives_the_same_verdicts(tmp_path: Path, original: Contents, suite: Path) -> None:
    names = ("a bomb", "a better score", "deep JSON", "metadata in the agent's file")
    for k, name in enumerate(names):
        write_contents(tmp_path / "board" / f"kf-{k}", CHANGES[name](original))
    write_contents(tmp_path / "board" / "honest", original)
    folders = submission_folders([tmp_path / "board"])
    verdicts = {verdict.folder: verdict for verdict in verify(folders, str(suite))}
    assert [verdict.is_confirmed for verdict in verdicts.values()] == [True] + [False] * len(names)
    assert verdicts["honest"].badge == "replayed"
    for k in range(len(names)):
        assert verdicts[f"kf-{k}"] == judged(tmp_path / "board" / f"kf-{k}", suite)


@pytest.mark.parametrize(
    ("code", "seconds", "message"),
    [
        ("import os; os.kill(os.getpid(), 9)", 60.0, "ended with code"),
        ("raise SystemExit('out of order')", 60.0, "ended with code 1: out of order"),
        ("print('x' * 5_000_000)", 60.0, "no proper answer .*more than 4000000 bytes"),
        ("print('[' * 5000)", 60.0, "no proper answer .*nested deeper"),
        ("print('[]')", 60.0, "about other folders"),
        ("print('[{}]')", 60.0, "no proper answer .*folder is missing"),
        ("import time; time.sleep(60)", 0.5, "took more than 0.5 s"),
    ],
)
def test_a_child_process_that_was_taken_over_gives_no_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, seconds: float, message: str
) -> None:
    from servotrack.baselines.board import verify as module
    from servotrack.baselines.reporting.files import ResultsError

    monkeypatch.setattr(module, "_CHILD", ("-I", "-c", code))
    (tmp_path / "kf").mkdir()
    with pytest.raises(ResultsError, match=message):
        verify([tmp_path / "kf"], seconds=seconds)


def test_without_bubblewrap_limits_hold(
    folder: Callable[[Contents], Path], original: Contents, suite: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from servotrack.baselines.board import verify as module

    monkeypatch.setattr(module, "bubblewrap", lambda: None)
    assert verify([folder(original)], str(suite))[0].badge == "replayed"
