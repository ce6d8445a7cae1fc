"""Several processes that save into one results folder, and processes that are killed while they do."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder, read_cell

ENV_ID = "OneStep-v0"
SPLITS = ("tune", "test")
FORK = multiprocessing.get_context("fork") if hasattr(os, "fork") else None
pytestmark = pytest.mark.skipif(FORK is None, reason="processes that start within a second need fork")


class OneStep(gym.Env):
    """An episode of one step, so that saving takes most of the time."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(1, np.float32), float(self.np_random.normal()), True, False, {}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gym.register(ENV_ID, OneStep)
    # Computed once and inherited by the forked processes.
    code_version()
    yield
    del gym.registry[ENV_ID]


def evaluate_split(folder: Path, split: str, episodes: int, chunk: int, saved: Connection | None = None) -> None:
    """Evaluate in blocks; `saved` receives the number of episodes that are on disk after each."""
    report = (lambda count: None) if saved is None else saved.send
    chosen = seeds.take(split, episodes)
    evaluate(
        ENV_ID, "random", chosen, folder=ResultsFolder(folder), chunk=chunk, timing=False, on_episodes=report
    )  # fmt: skip


def check_whole(folder: Path, episodes: int) -> None:
    """Every row of both splits is there, and equal to that of one process."""
    cell = ResultsFolder(folder).load(ENV_ID, {}, "random")
    assert cell is not None
    chosen = [seed for split in SPLITS for seed in seeds.take(split, episodes)]
    assert cell.seeds == chosen
    assert cell.rows == evaluate(ENV_ID, "random", chosen, chunk=100, timing=False).rows


def write_from_eight_processes(folder: Path, episodes: int, chunk: int) -> None:
    """Both splits and four counts of episodes at once, into one cell."""
    assert FORK is not None
    counts = [episodes * quarter // 4 for quarter in (1, 2, 3, 4)]
    writers = [
        FORK.Process(target=evaluate_split, args=(folder, split, count, chunk)) for split in SPLITS for count in counts
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0] * 8
    check_whole(folder, episodes)
    assert not list(folder.rglob(".unfinished-*"))


def test_eight_processes_with_mixed_splits_and_counts_lose_no_row(tmp_path: Path) -> None:
    write_from_eight_processes(tmp_path, episodes=40, chunk=5)


@pytest.mark.slow
def test_eight_processes_lose_none_of_10_000_rows(tmp_path: Path) -> None:
    write_from_eight_processes(tmp_path, episodes=5000, chunk=100)


def kill_writers(folder: Path, kills: int, episodes: int, chunk: int) -> int:
    """Kill one of two writers at a random time, check the file, go on; return the kills of half-finished cells."""
    assert FORK is not None
    rng = np.random.default_rng(0)
    hits = 0
    longest = 0.2
    for number in range(kills):
        target = folder / str(number // 10)
        split = SPLITS[number % 2]
        receiver, sender = FORK.Pipe(duplex=False)
        victim = FORK.Process(target=evaluate_split, args=(target, split, episodes, chunk, sender))
        # The other one writes the other split into the same cell at the same time, and is not killed.
        other = FORK.Process(target=evaluate_split, args=(target, SPLITS[1 - number % 2], 3 * chunk, chunk))
        begin = time.monotonic()
        victim.start()
        other.start()
        sender.close()
        time.sleep(rng.uniform(0.01, longest))
        assert victim.pid is not None
        os.kill(victim.pid, signal.SIGKILL)
        alive_for = time.monotonic() - begin
        victim.join()
        other.join()
        assert other.exitcode == 0
        saved = 0
        try:
            while receiver.poll(0.0):
                saved += receiver.recv()
        except EOFError:
            pass
        cell = read_cell(ResultsFolder(target).file_of(ENV_ID, {}, "random"))
        present = len(set(seeds.take(split, episodes)) & set(cell.seeds))
        assert present >= saved, f"{saved - present} rows lost by kill {number}"
        assert set(seeds.take(SPLITS[1 - number % 2], 3 * chunk)) <= set(cell.seeds)
        if victim.exitcode == 0:
            # The computer is faster than this test: kill earlier, in a fresh cell.
            longest = max(0.5 * alive_for, 0.02)
        hits += victim.exitcode == -signal.SIGKILL and 0 < present < episodes
    for target in folder.iterdir():
        for split in SPLITS:
            evaluate_split(target, split, episodes, 100)
        check_whole(target, episodes)
        assert not list(target.rglob(".unfinished-*"))
    return hits


def test_killed_writers_lose_nothing_that_was_saved(tmp_path: Path) -> None:
    assert kill_writers(tmp_path, kills=10, episodes=300, chunk=2) >= 3


@pytest.mark.slow
def test_200_killed_writers_lose_nothing_that_was_saved(tmp_path: Path) -> None:
    hits = kill_writers(tmp_path, kills=200, episodes=300, chunk=2)
    print(f"{hits} of 200 kills hit a half-finished cell")
    assert hits >= 60


def test_a_killed_holder_of_the_lock_does_not_stop_the_others(tmp_path: Path) -> None:
    from servotrack.baselines.reporting.files import locked_folder

    assert FORK is not None
    receiver, sender = FORK.Pipe(duplex=False)

    def hold() -> None:
        with locked_folder(tmp_path):
            sender.send(1)
            time.sleep(60.0)

    holder = FORK.Process(target=hold)
    holder.start()
    assert receiver.recv() == 1 and holder.pid is not None
    os.kill(holder.pid, signal.SIGKILL)
    holder.join()
    begin = time.monotonic()
    card = {"summary": "", "information": "model-free", "requires": [], "tuning_steps": 0}
    versions = {"versions": {"servotrack": "1"}}
    row = {"seed": 1, "return": 1.0, "length": 1}
    ResultsFolder(tmp_path).save(CellResults(ENV_ID, {}, "kf", card, None, [row], provenance=versions))
    assert time.monotonic() - begin < 5.0
