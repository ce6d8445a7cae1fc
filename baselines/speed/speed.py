"""Rates of the worlds beside those of other libraries' environments, all measured in the same run.

Every subject runs in a process of its own and is asked for its rate in turn, round after round, so that whatever else
the machine does falls on all alike; the median over rounds is what counts.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

STEPPING = Path(__file__).with_name("stepping.py")
FILTERING = Path(__file__).with_name("filtering.py")


@dataclass(frozen=True)
class Subject:
    """One thing to measure.

    Attributes:
        name: As the table shows it.
        command: What to run, after the interpreter.
        wanted: Rate to reach, 1/s; 0 for a peer or a row that is only reported.
        peers: Name of a peer to the ratio of rates wanted; one of the ratios has to be reached.
        python: Interpreter; None where the virtual environment that has it is missing.
        remedy: What to do where a peer cannot run; empty for our own, which have to.
    """

    name: str
    command: tuple[str, ...]
    wanted: float = 0.0
    peers: Mapping[str, float] = field(default_factory=dict)
    python: str | None = sys.executable
    remedy: str = ""


@dataclass(frozen=True)
class Rate:
    """Rates of a subject over all rounds, 1/s, or why there are none."""

    rounds: tuple[float, ...] = ()
    missing: str = ""

    @property
    def median(self) -> float:
        """The median over rounds, 1/s."""
        return median(self.rounds)


def environment(
    env_id: str,
    num_envs: int = 0,
    module: str = "servotrack",
    mode: str = "vector_entry_point",
    silent: bool = False,
    **kwargs: Any,
) -> tuple[str, ...]:
    """The command that measures steps of an environment, or its frames where `render_mode` is given."""
    counts = "frames" if "render_mode" in kwargs else "silent" if silent else "steps"
    job = {"module": module, "env_id": env_id, "kwargs": kwargs, "num_envs": num_envs, "mode": mode, "counts": counts}
    return (str(STEPPING), json.dumps(job))


def subjects(pusht_python: str | None) -> list[Subject]:
    """The table's rows.

    Args:
        pusht_python: Interpreter of a virtual environment with gym-pusht, which needs an older pymunk than ours.
    """
    reacher, reacher64 = "Reacher-v5", "Reacher-v5, SyncVectorEnv, N = 64"
    state, pixels = "gym-pusht, state", "gym-pusht, pixels 96 x 96"
    servo, crowd = "UncalibServo-v0", "PedestrianServo-v0"
    return [
        Subject(f"{servo}, level 0", environment(servo, level=0), wanted=20_000.0, peers={state: 6.0, reacher: 0.7}),
        Subject(f"{servo}, level 3", environment(servo, level=3)),
        Subject(f"{servo}, level 0, N = 64", environment(servo, 64, level=0), 80_000.0, {reacher64: 3.0}),
        Subject(f"{servo}, level 0, N = 1024", environment(servo, 1024, level=0), 100_000.0, {reacher64: 3.0}),
        Subject(f"{servo}, level 3, N = 64", environment(servo, 64, level=3)),
        Subject(f"{servo}, level 3, N = 1024", environment(servo, 1024, level=3)),
        Subject(
            "UncalibServoPixels-v0, level 0, 96 x 96",
            environment("UncalibServoPixels-v0", level=0),
            5_000.0,
            {pixels: 8.0},
        ),
        Subject("UncalibServoPixels-v0, level 3, 96 x 96", environment("UncalibServoPixels-v0", level=3)),
        Subject(f"{crowd}, level 2, detections", environment(crowd, level=2), 10_000.0),
        Subject(f"{crowd}, level 2, detections, N = 64", environment(crowd, 64, level=2)),
        Subject(
            f"{crowd}, level 2, pixels 96 x 96",
            environment(crowd, level=2, observation="pixels", image_size=96),
            2_000.0,
        ),
        Subject(f"{servo}, frames of rgb_array", environment(servo, level=0, render_mode="rgb_array"), 1_000.0),
        Subject("Kalman estimator, batch of 1024, updates", (str(FILTERING), "1024"), 1_000_000.0),
        _reacher(reacher),
        _reacher(reacher64, 64),
        _pusht(state, "state", pusht_python),
        _pusht(pixels, "pixels", pusht_python),
    ]


def _reacher(name: str, num_envs: int = 0) -> Subject:
    command = environment("Reacher-v5", num_envs, module="mujoco", mode="sync")
    return Subject(name, command, remedy="install the extra: pip install 'servotrack[mujoco]'")


def _pusht(name: str, obs_type: str, python: str | None) -> Subject:
    command = environment("gym_pusht/PushT-v0", module="gym_pusht", obs_type=obs_type)
    remedy = "make a virtual environment .venv-pusht with gym-pusht and 'pymunk<7'"
    return Subject(name, command, python=python, remedy=remedy)


def measure(
    rows: Sequence[Subject], rounds: int, seconds: float, on_measured: Callable[[str], None]
) -> dict[str, Rate]:
    """Ask every subject for its rate in turn, `rounds` times.

    Args:
        rows: What to measure.
        rounds: How often.
        seconds: How long each time.
        on_measured: Called with the subject's name after each measurement.

    Returns:
        Rates by name.
    """
    rates: dict[str, list[float]] = {row.name: [] for row in rows}
    missing: dict[str, str] = {}
    with ExitStack() as stack:
        running: dict[str, subprocess.Popen[str]] = {}
        for row in rows:
            process = _start(row, stack)
            if process is None:
                missing[row.name] = row.remedy or "does not run: see above"
            else:
                running[row.name] = process
        for _ in range(rounds):
            for name, process in running.items():
                rates[name].append(float(_asked(process, f"{seconds}\n")))
                on_measured(name)
    return {row.name: Rate(tuple(rates[row.name]), missing.get(row.name, "")) for row in rows}


def _start(row: Subject, stack: ExitStack) -> subprocess.Popen[str] | None:
    """The subject's process, built and warm, or None where it cannot run."""
    if row.python is None:
        return None
    process = subprocess.Popen(
        [row.python, "-W", "ignore", *row.command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        # What a peer that is not installed has to say is said by the remedy.
        stderr=subprocess.DEVNULL if row.remedy else None,
        text=True,
    )
    stack.callback(process.wait)
    stack.callback(process.stdin.close)  # type: ignore[union-attr]
    while (line := process.stdout.readline()) != "ready\n":  # type: ignore[union-attr]
        if not line:
            return None
    return process


def _asked(process: subprocess.Popen[str], question: str) -> str:
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(question)
    process.stdin.flush()
    return process.stdout.readline()


def table(rows: Sequence[Subject], rates: Mapping[str, Rate]) -> str:
    """The rates as a Markdown table, each beside what was wanted of it."""
    lines = [
        "| what | median, 1/s | lowest to highest | wanted | beside peers | reached |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        rate = rates[row.name]
        if rate.missing:
            lines.append(f"| {row.name} | missing: {rate.missing} | | | | |")
            continue
        ratios = {name: rate.median / rates[name].median for name in row.peers if rates[name].rounds}
        beside = "; ".join(f"{ratio:.2f} x {name} (wanted {row.peers[name]:g})" for name, ratio in ratios.items())
        reached = ""
        if row.wanted or row.peers:
            enough = not row.peers or any(ratio >= row.peers[name] for name, ratio in ratios.items())
            reached = "yes" if rate.median >= row.wanted and enough else "no"
            if row.peers and not ratios:
                reached = f"{'yes' if rate.median >= row.wanted else 'no'}, peers missing"
        spread = f"{min(rate.rounds):,.0f} to {max(rate.rounds):,.0f}"
        wanted = f"{row.wanted:,.0f}" if row.wanted else ""
        lines.append(f"| {row.name} | {rate.median:,.0f} | {spread} | {wanted} | {beside} | {reached} |")
    return "\n".join(lines)
