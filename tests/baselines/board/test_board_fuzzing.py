"""Random tampering and random submissions, in numbers: `scripts/test -m slow tests/baselines/board`.

`python tests/baselines/board/test_board_fuzzing.py tampers|mutations COUNT [SEED]` prints what happened.
"""

from __future__ import annotations

import copy
import json
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_cases import (
    ROWS,
    TRACE,
    contents_of,
    judged,
    replayed_verdict,
    resealed,
    rows_content,
    submitted,
    write_contents,
    write_suite,
)

import servotrack
from servotrack.baselines.board.submit import network_candidate
from servotrack.baselines.board.suites import load_suite
from servotrack.baselines.board.trace_files import Trace, decoded, encoded

Contents = dict[str, bytes]
AGENT = "agent/agent.json"
LONGEST, LARGEST = 60.0, 1_000_000
"""s, and kB of memory."""


class Tampering:
    """Random changes of an honest submission that would be worth something, most of them with all digests redone."""

    def __init__(self, original: Contents, seed: int) -> None:
        self.original, self.draws = original, np.random.default_rng(seed)
        self.kinds: list[Callable[[], Contents]] = [
            self.bytes_of_a_file, self.value_of_a_row, self.action, self.actions_of_an_episode, self.order_of_episodes,
            self.seed_of_a_row, self.agent_file, self.claim, self.length,
        ]  # fmt: skip

    def pick(self, values: Any) -> Any:
        return values[self.draws.integers(len(values))]

    def __call__(self) -> tuple[str, Contents]:
        while True:
            kind = self.pick(self.kinds)
            changed = kind()
            if changed != self.original:
                return kind.__name__, changed

    def bytes_of_a_file(self) -> Contents:
        name = self.pick(sorted(self.original))
        return {**self.original, name: mutated_bytes(self.draws, self.original[name])}

    def _rows(self, change: Callable[[dict[str, Any]], None]) -> Contents:
        document = json.loads(self.original[ROWS])
        change(document)
        return resealed({**self.original, ROWS: rows_content(document)})

    def value_of_a_row(self) -> Contents:
        def change(document: dict[str, Any]) -> None:
            row = self.pick(document[self.pick(["public", "sealed"])])
            at = self.draws.integers(1, len(row))
            if isinstance(row[at], bool):
                row[at] = not row[at]
            elif isinstance(row[at], int):
                row[at] += int(self.pick([-1, 1]))
            else:
                row[at] = float(row[at] * (1.0 + 10.0 ** self.draws.uniform(-15, 0) * self.pick([-1, 1])))

        return self._rows(change)

    def seed_of_a_row(self) -> Contents:
        def change(document: dict[str, Any]) -> None:
            row = self.pick(document[self.pick(["public", "sealed"])])
            row[0] = int(self.pick([row[0] + 1, self.draws.integers(2**53)]))

        return self._rows(change)

    def length(self) -> Contents:
        def change(document: dict[str, Any]) -> None:
            row = self.pick(document["public"])
            row[document["columns"].index("length")] = int(self.draws.integers(1, 500))

        return self._rows(change)

    def _trace(self, change: Callable[[list[Any]], None]) -> Contents:
        episodes = [episode.copy() for episode in decoded(self.original[TRACE], 4, 2, 32_767, 1000).episodes]
        change(episodes)
        return resealed({**self.original, TRACE: encoded(Trace(32_767, tuple(episodes)))})

    def action(self) -> Contents:
        def change(episodes: list[Any]) -> None:
            episode = self.pick(episodes)
            at = self.draws.integers(len(episode)), self.draws.integers(2)
            step = int(self.pick([-1, 1, -100, 100, 5000, -5000]))
            episode[at] = np.clip(int(episode[at]) + step, -32_767, 32_767)

        return self._trace(change)

    def actions_of_an_episode(self) -> Contents:
        def change(episodes: list[Any]) -> None:
            k = self.draws.integers(len(episodes))
            episodes[k] = self.draws.integers(-32_767, 32_768, episodes[k].shape).astype(np.int16)

        return self._trace(change)

    def order_of_episodes(self) -> Contents:
        def change(episodes: list[Any]) -> None:
            i, j = self.draws.integers(len(episodes), size=2)
            episodes[i], episodes[j] = episodes[j], episodes[i]

        return self._trace(change)

    def agent_file(self) -> Contents:
        return resealed({**self.original, AGENT: mutated_bytes(self.draws, self.original[AGENT])})

    def claim(self) -> Contents:
        card = json.loads(self.original["card.json"])
        name = self.pick(["information", "requires", "tuning_steps"])
        values = {
            "information": self.pick(["structure", "prior", "calibrated", "undeclared"]),
            "requires": ["truth"], "tuning_steps": int(self.draws.integers(10**6)),
        }  # fmt: skip
        return resealed(self.original, claims={**card["claims"], name: values[name]})


def mutated_bytes(draws: np.random.Generator, content: bytes) -> bytes:
    """Return bytes with some flipped, cut, repeated or put in."""
    changed = bytearray(content)
    for _ in range(draws.integers(1, 4)):
        at = int(draws.integers(len(changed) + 1))
        match draws.integers(5):
            case 0 if changed:
                changed[min(at, len(changed) - 1)] ^= 1 << int(draws.integers(8))
            case 1:
                del changed[at : at + int(draws.integers(1, 20))]
            case 2:
                changed[at:at] = draws.bytes(int(draws.integers(1, 20)))
            case 3:
                changed[at:at] = changed[at : at + int(draws.integers(1, 200))]
            case 4:
                del changed[at:]
    return bytes(changed)


class Mutations:
    """Random submissions, well-formed on the outside so that the inner checks have something to do."""

    VALUES = (
        None, True, False, 0, -1, 1, 2**53, 2**64 - 1, 1e308, -0.0, 1e-320, "", "x", "kf", "../x", "\u202e", "a" * 5000,
        [], {}, [[]], {"a": {}}, [0] * 1000,
    )  # fmt: skip

    def __init__(self, originals: list[Contents], seed: int) -> None:
        self.originals, self.draws = originals, np.random.default_rng(seed)

    def pick(self, values: Any) -> Any:
        return values[self.draws.integers(len(values))]

    def __call__(self) -> Contents:
        contents = dict(self.pick(self.originals))
        for _ in range(self.draws.integers(1, 3)):
            name = self.pick(sorted(contents))
            if name.endswith(".json") and self.draws.random() < 0.7:
                contents[name] = self.json_of(contents[name])
            elif name.endswith(".trace") and self.draws.random() < 0.3:
                contents[name] = self.header_of(contents[name])
            else:
                contents[name] = mutated_bytes(self.draws, contents[name])
        if self.draws.random() < 0.03:
            contents.pop(self.pick(sorted(contents)))
        if self.draws.random() < 0.8:
            try:
                return resealed(contents)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                return contents
        return contents

    def json_of(self, content: bytes) -> bytes:
        """Change one value somewhere in a document."""
        try:
            document = json.loads(content)
        except (ValueError, RecursionError):
            return content
        places: list[tuple[Any, Any]] = []
        waiting = [document]
        while waiting:
            outer = waiting.pop()
            keys = list(outer) if isinstance(outer, dict) else range(len(outer)) if isinstance(outer, list) else []
            places += [(outer, key) for key in keys]
            waiting += [outer[key] for key in keys]
        if places:
            outer, key = self.pick(places)
            match self.draws.integers(4):
                case 0:
                    del outer[key]
                case 1 if isinstance(outer, dict):
                    outer[str(self.pick(self.VALUES))[:50]] = outer.pop(key)
                case 2:
                    other, place = self.pick(places)
                    if (isinstance(other, dict) and place not in other) or (
                        isinstance(other, list) and place >= len(other)
                    ):
                        return content
                    outer[key] = copy.deepcopy(other[place])
                case _:
                    outer[key] = self.pick(self.VALUES)
        try:
            if isinstance(document, dict) and "columns" in document:
                return rows_content(document)
            return json.dumps(document, indent=1, sort_keys=True).encode("ascii")
        except (ValueError, RecursionError):
            return content

    def header_of(self, content: bytes) -> bytes:
        at = 8 + 4 * int(self.draws.integers(8))
        number = int(self.pick([0, 1, 2, 3, 66, 67, 2**16, 2**31, 2**32 - 1]))
        return content[:at] + number.to_bytes(4, "little") + content[at + 4 :]


def tamper(folder: Path, count: int, seed: int) -> Counter[str]:
    """Tamper so many times; return how often each kind was caught, and by what."""
    folder.mkdir(exist_ok=True)
    suite = write_suite(folder)
    original = contents_of(submitted(folder / "original", suite))
    tampering, found = Tampering(original, seed), Counter[str]()
    for _ in range(count):
        kind, contents = tampering()
        path = write_contents(folder / "kf", contents)
        verdict = judged(path, suite)
        if verdict.is_confirmed:
            verdict = judged(path, suite, run=True)
            outcome = "MISSED" if verdict.is_confirmed else "found by running the agent"
        else:
            outcome = "refused" if verdict.refused else "found by replay"
        found[f"{kind}: {outcome}"] += 1
    return found


def mutate(folder: Path, count: int, seed: int) -> Counter[str]:
    """Judge so many random submissions; return what became of them, the longest time (ms) and the memory (MB)."""
    folder.mkdir(exist_ok=True)
    suite = write_suite(folder)
    frozen = load_suite(str(suite))
    made = [contents_of(submitted(folder / "kf", suite)), contents_of(submitted(folder / "random", suite, "random"))]
    networks = Path(servotrack.baselines.agents.learned.__file__).parent / "networks"
    network = network_candidate(networks / "UncalibServo-v0-level3-ppo.json", "my-net", "tests")
    made.append(contents_of(_network(folder / "net", frozen, network)))
    mutations, found = Mutations(made, seed), Counter[str]()
    longest = 0.0
    for _ in range(count):
        contents = mutations()
        path = write_contents(folder / "case", contents)
        begin = time.perf_counter()
        verdict = replayed_verdict(path, frozen)
        longest = max(longest, time.perf_counter() - begin)
        states = {cell.state for cell in verdict.cells.values()}
        found["refused" if verdict.refused else f"measured, {'/'.join(sorted(states))}"] += 1
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found["longest, ms"], found["memory, MB"] = int(longest * 1000), memory // 1000
    return found


def _network(folder: Path, suite: Any, candidate: Any) -> Path:
    from servotrack.baselines.board.submit import submit

    submit(candidate, suite, folder, suite.cells)
    return folder


@pytest.mark.slow
def test_ten_thousand_random_tampers_are_caught(tmp_path: Path) -> None:
    found = tamper(tmp_path, 10_000, 1)
    assert not [outcome for outcome in found if outcome.endswith("MISSED")], found


@pytest.mark.slow
def test_a_hundred_thousand_random_submissions_are_refused_or_measured(tmp_path: Path) -> None:
    found = mutate(tmp_path, 100_000, 1)
    assert found["longest, ms"] < 1000 * LONGEST
    assert found["memory, MB"] < LARGEST // 1000


def test_random_tampers_and_submissions(tmp_path: Path) -> None:
    found = tamper(tmp_path / "tampers", 40, 2) + mutate(tmp_path / "mutations", 150, 2)
    assert not [outcome for outcome in found if outcome.endswith("MISSED")], found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        run = {"tampers": tamper, "mutations": mutate}[sys.argv[1]]
        (Path(place) / "case").mkdir()
        total = run(Path(place), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 1)
        for outcome, number in sorted(total.items()):
            print(f"{number:8d} {outcome}")
