"""Hostile cards and networks: each is refused by name, nothing in it runs, within 5 s and 1 GB.

The file is also the program that the tests start: `python test_hostile_files.py FOLDER...` loads the agents in folders,
one process each, and prints what happened.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from hostile_cards import CARDS, with_encoding
from hostile_networks import NETWORKS, PLAIN

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, digest
from servotrack.baselines.agents.learned.marker_network import open_marker_network
from servotrack.baselines.agents.registry import agent_card, create_agent

resource = pytest.importorskip("resource")

SECONDS, MEMORY = 5, 10**9
EXECUTED = "executed"
EVIL = (
    f"from pathlib import Path\nPath(__file__).with_name({EXECUTED!r}).touch()\n\ndef make(*args):\n    return None\n"
)


def write_plain(folder: Path, content: bytes = PLAIN, **fields: Any) -> dict[str, Any]:
    """Write a linear network and its card, and return the card; both are valid unless the arguments are not."""
    card = LearnedCard(
        "linear", "a linear network", "UncalibServo-v0", {"level": 3}, {"kind": "servo", "lags": [1]}, "agent.onnx",
        digest(content), **fields,
    )  # fmt: skip
    (folder / "agent.onnx").write_bytes(content)
    (folder / "agent.json").write_text(card.as_json())
    (folder / "evil.py").write_text(EVIL)
    document: dict[str, Any] = json.loads(card.as_json())
    return document


def hostile_card(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    changed = change(write_plain(folder))
    (folder / "agent.json").write_bytes(changed if isinstance(changed, bytes) else json.dumps(changed).encode())


def hostile_network(folder: Path, content: bytes) -> None:
    document = write_plain(folder, content)
    document["encoding"] = {"kind": "servo"}
    (folder / "agent.json").write_text(json.dumps(document))


def as_link(folder: Path, name: str, target: str) -> None:
    write_plain(folder)
    if Path(target).is_absolute():
        (folder / name).unlink()
    else:
        (folder / name).rename(folder / target)
    (folder / name).symlink_to(target)


def as_pipe(folder: Path, name: str) -> None:
    write_plain(folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)


def as_folder(folder: Path, name: str) -> None:
    write_plain(folder)
    (folder / name).unlink()
    (folder / name).mkdir()


def as_large(folder: Path, name: str) -> None:
    write_plain(folder)
    os.truncate(folder / name, 2**31)


PLACES: dict[str, tuple[Callable[[Path], None], str]] = {
    f"{name} is {what}": (lambda folder, make=make, name=name: make(folder, name), message)
    for name in ("agent.json", "agent.onnx")
    for what, make, message in (
        ("a link to a device", lambda folder, name: as_link(folder, name, "/dev/zero"), "symbolic link"),
        ("a link to a file", lambda folder, name: as_link(folder, name, "other"), "symbolic link"),
        ("a pipe", as_pipe, "not a regular file"),
        ("a folder", as_folder, "cannot be read|not a regular file"),
        ("2 GB long", as_large, "more than 20*000 bytes"),
    )
}

CASES: dict[str, tuple[Callable[[Path], None], str]] = {
    **{
        f"card: {name}": (lambda folder, change=change: hostile_card(folder, change), message)
        for name, (change, message) in CARDS.items()
    },
    **{
        f"network: {name}": (lambda folder, make=make: hostile_network(folder, make()), message)
        for name, (make, message) in NETWORKS.items()
    },
    **{f"place: {name}": case for name, case in PLACES.items()},
}


def load(path: Path, env: Any) -> str:
    """Load an agent, let it act, and return what came of it."""
    try:
        agent = create_agent(agent_card(str(path)), env)
        observation, _ = env.reset(seed=100_000)
        state: Any = None
        for _ in range(2):
            action, state = agent.predict(observation, state)
            observation, *_ = env.step(action)
    except AgentFileError as error:
        return f"refused: {error}"
    return "accepted"


def load_all(folders: list[Path]) -> None:
    """Load the agents in folders, each in a process of its own with bounds, and print one line of JSON for each."""
    env = gym.make("UncalibServo-v0", level=3)
    # So that what the package itself imports and compiles is not counted.
    load(folders[0] / "agent.json", env)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for folder in folders:
        sys.stdout.flush()
        started = time.monotonic()
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
            # The default action ends the process, wherever it is.
            signal.alarm(SECONDS)
            os.chdir(folder)
            sys.path.insert(0, str(folder))
            try:
                outcome = load(folder / "agent.json", env)
            except BaseException as error:
                outcome = f"{type(error).__name__}: {error}"
            (folder / "outcome").write_text(outcome)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps({"status": status, "seconds": time.monotonic() - started}))


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Outcome of every case, from one process that loads all of them."""
    parent = tmp_path_factory.mktemp("hostile")
    folders = [parent / f"case{k}" for k in range(len(CASES) + 1)]
    for folder in folders:
        folder.mkdir()
    hostile_network(folders[0], PLAIN)
    for folder, (make, _) in zip(folders[1:], CASES.values(), strict=True):
        make(folder)
    command = [sys.executable, __file__, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    found = {}
    for name, folder, line in zip(["plain", *CASES], folders, lines, strict=True):
        outcome = folder / "outcome"
        text = outcome.read_text() if outcome.exists() else "nothing"
        found[name] = {**line, "outcome": text, "executed": (folder / EXECUTED).exists(), "folder": folder}
    return found


def test_the_agent_that_all_cases_are_made_of_is_accepted(outcomes: dict[str, dict[str, Any]]) -> None:
    assert outcomes["plain"]["outcome"] == "accepted"


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_is_refused_by_name(name: str, outcomes: dict[str, dict[str, Any]]) -> None:
    found, (_, message) = outcomes[name], CASES[name]
    assert found["status"] == 0, "the process did not end by itself: time, memory or a crash"
    assert found["seconds"] < SECONDS and not found["executed"]
    assert found["outcome"].startswith("refused: ")
    assert str(found["folder"] / "agent.") in found["outcome"] and len(found["outcome"]) < 1000
    assert re.search(message, found["outcome"]), found["outcome"]


def test_a_card_that_names_itself_ends_by_a_message(tmp_path: Path) -> None:
    hostile_card(tmp_path, with_encoding(eyes="agent"))
    with pytest.raises(AgentFileError, match=r"encoding.eyes names .*agent.json, which is not the card of a marker"):
        open_marker_network("agent", tmp_path)


if __name__ == "__main__":
    load_all([Path(folder) for folder in sys.argv[1:]])
