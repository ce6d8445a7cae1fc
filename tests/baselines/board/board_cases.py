"""Small suites and submissions for the tests of the board, and a way to seal changed ones anew."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from servotrack.baselines.board.card import _seal, _text
from servotrack.baselines.board.submit import Candidate, command_candidate, registered_candidate, submit
from servotrack.baselines.board.suites import Suite, behavior_of, load_suite
from servotrack.baselines.board.verification import Verdict, open_submission, replay_all
from servotrack.baselines.board.verify_child import Order, verify_all

ROOT = Path(__file__).parents[3]
EXAMPLES = ROOT / "examples" / "board"
LEVEL, HORIZON = 3, 66
CELL = f"UncalibServo-v0,horizon={HORIZON},level={LEVEL}"
ROWS, TRACE = f"rows/{CELL}.json", f"traces/{CELL}.trace"


def write_suite(folder: Path, **changes: Any) -> Path:
    """Write a suite of one cell with two public and two sealed episodes of 66 steps, in two forms."""
    kwargs = {"level": LEVEL, "horizon": HORIZON}
    cell = {"env_id": "UncalibServo-v0", "env_kwargs": kwargs, "public": 2, "forms": "0110", "anchors": [0.5, 0.002]}
    cell |= {"behavior": behavior_of("UncalibServo-v0", kwargs)} | changes
    head = {"format": "servotrack-suite", "format_version": 1, "name": "tiny", "summary": "for tests", "grid": 32_767}
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump({**head, "cells": [cell]}))
    return path


def submitted(folder: Path, suite: Suite | Path, candidate: Candidate | str = "kf") -> Path:
    """Submit an agent and return the folder."""
    made = registered_candidate(candidate, "tests") if isinstance(candidate, str) else candidate
    submit(made, suite if isinstance(suite, Suite) else load_suite(str(suite)), folder)
    return folder


def program(path: Path, text: str, **claims: Any) -> Candidate:
    """Write a Python program and return it as a candidate, started in the folder of its file."""
    path.write_text(text)
    made = command_candidate("python agent.py", "program", "tests", [path], claims)
    return Candidate(made.name, made.kind, ["python", f"./{path.name}"], made.files, made.claims)


def judged(folder: Path, suite: Path, **options: Any) -> Verdict:
    """Verify one folder in this process."""
    return verify_all(Order([str(folder)], str(suite), **options))[0]


def replayed_verdict(folder: Path, suite: Suite) -> Verdict:
    """Verify one folder as `judged` does, for a suite that is read once for many folders."""
    opened = [open_submission(folder, suite)]
    replay_all(opened)
    return opened[0][1]


def contents_of(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files by name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def write_contents(folder: Path, contents: Mapping[str, bytes]) -> Path:
    """Write a folder anew. Inner folders stay if they are written again: removing them is slow on a disk."""
    kept = {folder / parent for name in contents for parent in Path(name).parents}
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink():
            if path not in kept:
                path.rmdir()
        else:
            path.unlink()
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def rows_content(document: Mapping[str, Any]) -> bytes:
    """Return the content of a file of rows in the form that `submit` writes, also for rows that are none."""
    lines = [
        f'"{name}": [\n  ' + ",\n  ".join(json.dumps(row) for row in value) + "\n ]"
        if name in ("public", "sealed") and isinstance(value, list)
        else f"{json.dumps(name)}: {json.dumps(value)}"
        for name, value in document.items()
    ]
    return ("{\n " + ",\n ".join(lines) + "\n}\n").encode("ascii")


def resealed(contents: Mapping[str, bytes], **changes: Any) -> dict[str, bytes]:
    """Return contents whose card has fields changed, and the digests of all files and its seal computed anew."""
    card: dict[str, Any] = {**json.loads(contents["card.json"]), **changes}
    files = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    card["agent"] = {
        **card["agent"],
        "files": {name[6:]: digest for name, digest in files.items() if name.startswith("agent/")},
    }
    cells = {name[5:-5] for name in files if name.startswith("rows/")}
    card["cells"] = {
        cell: {"rows": files[f"rows/{cell}.json"], "trace": files.get(f"traces/{cell}.trace", "0" * 64)}
        for cell in sorted(cells)
    }
    card.pop("seal", None)
    card["seal"] = _seal(card)
    return {**contents, "card.json": _text(card)}
