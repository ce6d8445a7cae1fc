"""Rates of our code and of reference libraries, measured in the same run.

Every subject runs in its own process and measures its rate in turn, round after round, so that other load on the
machine affects all subjects alike. The median over rounds is reported.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from statistics import median


@dataclass(frozen=True)
class Subject:
    """One rate to measure.

    Attributes:
        name: Name in the table.
        command: Script and arguments that the interpreter runs.
        target: Rate to reach, 1/s; 0 for a reference or a row that is only reported.
        ratios: Name of a reference to the ratio of rates to reach. One of the ratios has to be reached.
        python: Interpreter; None if the virtual environment that contains it is missing.
        remedy: Instruction printed if a reference cannot run. Empty for our own subjects, which have to run.
    """

    name: str
    command: tuple[str, ...]
    target: float = 0.0
    ratios: Mapping[str, float] = field(default_factory=dict)
    python: str | None = sys.executable
    remedy: str = ""


@dataclass(frozen=True)
class Rate:
    """Rates of a subject over all rounds, or the reason why it has none.

    Attributes:
        rounds: Rate of each round, 1/s.
        missing: Instruction that makes the subject run; empty if it ran.
    """

    rounds: tuple[float, ...] = ()
    missing: str = ""

    @property
    def median(self) -> float:
        """Median over rounds, 1/s."""
        return median(self.rounds)


def measure(
    rows: Sequence[Subject], rounds: int, seconds: float, on_measured: Callable[[str], None]
) -> dict[str, Rate]:
    """Measure every subject in turn, `rounds` times.

    Args:
        rows: Subjects.
        rounds: Measurements of each subject. More rounds make the median steadier.
        seconds: Duration of one measurement, s.
        on_measured: Called with the subject's name after each measurement.

    Returns:
        Rates, keyed by the subject's name.
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
                rates[name].append(_rate_over(process, seconds))
                on_measured(name)
    return {row.name: Rate(tuple(rates[row.name]), missing.get(row.name, "")) for row in rows}


def _start(row: Subject, stack: ExitStack) -> subprocess.Popen[str] | None:
    """Return the subject's process, built and warm, or None if it cannot run."""
    if row.python is None:
        return None
    process = subprocess.Popen(
        [row.python, "-W", "ignore", *row.command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        # The remedy replaces the traceback of a reference that is not installed.
        stderr=subprocess.DEVNULL if row.remedy else None,
        text=True,
    )
    stack.callback(process.wait)
    stack.callback(process.stdin.close)  # type: ignore[union-attr]
    while (line := process.stdout.readline()) != "ready\n":  # type: ignore[union-attr]
        if not line:
            return None
    return process


def _rate_over(process: subprocess.Popen[str], seconds: float) -> float:
    """Rate that a process measures over `seconds`, 1/s."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{seconds}\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def table(rows: Sequence[Subject], rates: Mapping[str, Rate]) -> str:
    """Return the rates beside their targets as a Markdown table."""
    lines = [
        "| subject | median, 1/s | lowest to highest | target | ratio to reference | met |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        rate = rates[row.name]
        if rate.missing:
            lines.append(f"| {row.name} | missing: {rate.missing} | | | | |")
            continue
        ratios = {name: rate.median / rates[name].median for name in row.ratios if rates[name].rounds}
        compared = "; ".join(f"{ratio:.2f} x {name} (target {row.ratios[name]:g})" for name, ratio in ratios.items())
        met = ""
        if row.target or row.ratios:
            enough = not row.ratios or any(ratio >= row.ratios[name] for name, ratio in ratios.items())
            met = "yes" if rate.median >= row.target and enough else "no"
            if row.ratios and not ratios:
                met = f"{'yes' if rate.median >= row.target else 'no'}, references missing"
        spread = f"{min(rate.rounds):,.0f} to {max(rate.rounds):,.0f}"
        target = f"{row.target:,.0f}" if row.target else ""
        lines.append(f"| {row.name} | {rate.median:,.0f} | {spread} | {target} | {compared} | {met} |")
    return "\n".join(lines)
