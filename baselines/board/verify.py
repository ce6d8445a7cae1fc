"""`servotrack verify`: submissions are read, replayed and run again in a child process, whose answer is checked."""

from __future__ import annotations

import contextlib
import json
import random
import secrets
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, get_args

from servotrack.baselines.agents.learned.field_rules import Choice, Many, Number, Record, Text
from servotrack.baselines.board.card import Optional, Table
from servotrack.baselines.board.sandbox import bubblewrap, confined, inner_environment
from servotrack.baselines.board.submission import CARD
from servotrack.baselines.board.suites import load_suite, suite_names
from servotrack.baselines.board.verification import Badge, CellState, CellVerdict, Verdict
from servotrack.baselines.board.verify_child import Order
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_document
from servotrack.baselines.reporting.plain_text import printable
from servotrack.baselines.reporting.strict import parse_json

LONGEST = 1800.0
"""Time that a child process has, s."""
LARGEST_ANSWER = 4_000_000
"""Largest accepted answer of a child process, bytes."""
FRESH = 25
"""Fresh episodes in each cell when agents are run again. Raising it finds smaller gains from known seeds."""
VERDICTS_FORMAT, VERDICTS_VERSION = "servotrack-verdicts", 1
_REMEDY = "write it anew by `servotrack verify --output`"
_CHILD = ("-I", "-m", "servotrack.baselines.board.verify_child")
_ANY = Text(1000)
_SCORE = Number(-1e6, 1e6)
_VERDICTS = Many(
    Record(
        {
            "folder": _ANY, "name": _ANY, "kind": _ANY, "suite": _ANY, "seal": _ANY, "refused": _ANY,
            "badge": Choice(get_args(Badge)),
            "notes": Many(_ANY, 0, 20),
            "cells": Table(
                _ANY,
                Record(
                    {
                        "state": Choice(get_args(CellState)), "scores": Table(_ANY, _SCORE, 0, 2), "detail": _ANY,
                        "fresh": Optional(Many(_SCORE, 2, 2)),
                    },
                    required=("state", "scores", "detail", "fresh"),
                ),
                0, 100,
            ),
        },
        required=("folder", "name", "kind", "suite", "seal", "refused", "badge", "notes", "cells"),
    ),
    0, 1000,
)  # fmt: skip


def submission_folders(paths: Sequence[Path]) -> list[Path]:
    """Return the folders of submissions: paths that have a card, and those inside of paths that have none."""
    found = []
    for path in paths:
        inner = [] if (path / CARD).exists() or not path.is_dir() else sorted(p.parent for p in path.glob(f"*/{CARD}"))
        found += inner or [path]
    return found


def verify(
    folders: Sequence[Path],
    suite: str | None = None,
    *,
    run: bool = False,
    fresh: int = FRESH,
    sample: int | None = None,
    seconds: float = LONGEST,
) -> list[Verdict]:
    """Verify submissions in child processes: one that replays all traces, and one per agent that is run again.

    Args:
        folders: Folders of submissions.
        suite: Name or path of the suite; None for the one that each card names.
        run: True to run the agents again, too.
        fresh: Fresh episodes in each cell of an agent that is run again.
        sample: Number of cells of each submission to replay, drawn at random; None for all.
        seconds: Longest time of a child process, s.

    Returns:
        One verdict per folder, in their order.

    Raises:
        ResultsError: A child process that failed or gave no proper answer.
    """
    path = None if suite is None else Path(suite) if suite.endswith(".yaml") else None
    if suite is not None and path is None:
        load_suite(suite)
    cells = None if sample is None else {folder.name: _sampled(folder, sample) for folder in folders}
    common: dict[str, Any] = {"suite": None if path is None else str(path), "cells": cells}
    verdicts = _answered(folders, Order([], **common), seconds)
    if suite is not None and path is None:
        for verdict in verdicts:
            if verdict.suite not in ("", suite):
                verdict.refused, verdict.badge = f"it is for suite {verdict.suite!r}, not {suite!r}", "self-reported"
    if run:
        for k, folder in enumerate(folders):
            if verdicts[k].is_confirmed:
                order = Order(
                    [], **common, run=True, program=verdicts[k].kind == "command", nonce=secrets.token_hex(8),
                    fresh=fresh, seconds=seconds,
                )  # fmt: skip
                verdicts[k] = _answered([folder], order, seconds)[0]
    return verdicts


def _sampled(folder: Path, count: int) -> list[str]:
    """Return names of cells by the names of their files; the child refuses a folder whose files are others."""
    names = sorted(path.stem for path in (folder / "rows").glob("*.json"))
    return random.SystemRandom().sample(names, min(count, len(names)))


def _answered(folders: Sequence[Path], order: Order, seconds: float) -> list[Verdict]:
    """Start a child process and return its verdicts."""
    fields = asdict(order)
    # A foreign program gets a namespace of its own. Its parent stays outside, for namespaces do not nest everywhere.
    inside = bubblewrap() is not None and not order.program
    if inside:
        _compile_kernels()
        places = {f"/submissions/{k}/{folder.name}": folder.absolute() for k, folder in enumerate(folders)}
        if order.suite is not None:
            places["/suite.yaml"] = Path(order.suite).absolute()
            fields["suite"] = "/suite.yaml"
        fields["folders"] = list(places)[: len(folders)]
        command = confined([sys.executable, *_CHILD], places, "/tmp")
    else:
        fields["folders"] = [str(folder.absolute()) for folder in folders]
        fields["suite"] = None if order.suite is None else str(Path(order.suite).absolute())
        command = [sys.executable, *_CHILD]
    with tempfile.TemporaryDirectory() as empty, tempfile.TemporaryFile() as said:
        code, answer = _run(command, json.dumps(fields).encode("ascii") + b"\n", seconds, empty, said)
        said.seek(0)
        words = said.read()[-2000:].decode("utf-8", "replace").strip().splitlines()
    if code:
        reason = words[-1] if words else "without a word"
        raise ResultsError(f"the process that verifies ended with code {code}: {printable(reason[:300])}")
    return _checked(answer, folders)


@lru_cache(maxsize=1)
def _compile_kernels() -> None:
    """Compile the kernels of the servo worlds, if need be: a confined process can read but not keep them."""
    load_suite(suite_names()[0]).cells[0].is_stale()


def _run(command: Sequence[str], order: bytes, seconds: float, folder: str, said: IO[bytes]) -> tuple[int, bytes]:
    """Run a child process and return its exit code and the beginning of its answer.

    Raises:
        ResultsError: It takes longer than `seconds`, or says more than `LARGEST_ANSWER`.
    """
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, cwd=folder, env=inner_environment()
    )
    assert process.stdin is not None and process.stdout is not None
    late = threading.Event()

    def end() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    answer = b""
    try:
        with contextlib.suppress(OSError):
            process.stdin.write(order)
            process.stdin.close()
        answer = process.stdout.read(LARGEST_ANSWER + 1)
        if len(answer) <= LARGEST_ANSWER:
            process.wait()
    finally:
        timer.cancel()
        # It has ended, says too much, or this process is being stopped.
        process.kill()
        process.stdout.close()
        code = process.wait()
    if late.is_set():
        raise ResultsError(f"verification took more than {seconds:g} s; verify fewer folders at once")
    return code if len(answer) <= LARGEST_ANSWER else 0, answer


def _checked(answer: bytes, folders: Sequence[Path]) -> list[Verdict]:
    try:
        if len(answer) > LARGEST_ANSWER:
            raise ValueError(f"it has more than {LARGEST_ANSWER} bytes")
        document = parse_json(answer)
        _VERDICTS.check(document, "verdicts")
        if [fields["folder"] for fields in document] != [folder.name for folder in folders]:
            raise ValueError("it is about other folders")
    except ValueError as error:
        raise ResultsError(f"the process that verifies gave no proper answer ({error})") from error
    return [_as_verdict(fields) for fields in document]


def _as_verdict(fields: dict[str, Any]) -> Verdict:
    cells = {
        name: CellVerdict(**{**cell, "fresh": None if cell["fresh"] is None else tuple(cell["fresh"])})
        for name, cell in fields["cells"].items()
    }
    return Verdict(**{**fields, "cells": cells})


def write_verdicts(verdicts: Sequence[Verdict], path: Path) -> None:
    """Write verdicts, which belong to the verifier and lie outside of the submissions.

    Raises:
        ResultsError: The file cannot be written.
    """
    record = provenance()
    head = {"format": VERDICTS_FORMAT, "format_version": VERDICTS_VERSION}
    head |= {"servotrack": record["versions"]["servotrack"], "created": record["created"]}
    lines = ",\n  ".join(json.dumps(asdict(verdict), allow_nan=False) for verdict in verdicts)
    text = "{\n " + "\n ".join(f"{json.dumps(name)}: {json.dumps(value)}," for name, value in head.items())
    with atomic_path(path) as temporary:
        temporary.write_text(f'{text}\n "verdicts": [\n  {lines}\n ]\n}}\n', encoding="ascii")


def read_verdicts(path: Path) -> dict[str, Verdict]:
    """Return the verdicts of a file by the seal of the submission. A submission of another seal is self-reported.

    Raises:
        ResultsError: A missing or invalid file.
    """
    document = read_document(path, VERDICTS_FORMAT, VERDICTS_VERSION, "not a file of verdicts", _REMEDY)
    try:
        _VERDICTS.check(document.get("verdicts"), "verdicts")
    except ValueError as error:
        raise ResultsError(f"{path} is corrupt ({error}); {_REMEDY}") from error
    return {fields["seal"]: _as_verdict(fields) for fields in document["verdicts"] if fields["seal"]}
