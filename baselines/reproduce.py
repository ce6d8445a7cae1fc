"""Runs a paper's experiments, prints its tables with ours beside them, draws its figures and audits its claims."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from servotrack.baselines import paper002, seeds
from servotrack.baselines.bench import progress_bars
from servotrack.baselines.claims import SHIPPED, Claim, fill, judge_smaller, read_claims, write_claims
from servotrack.baselines.leaderboard.figure import save_figure
from servotrack.baselines.leaderboard.table import Grid, as_rich, as_sections
from servotrack.baselines.paper002 import POSITIONING, TRACKING, WORLD, Run
from servotrack.baselines.paper002_figures import draw_trajectories
from servotrack.baselines.results import atomic_path
from servotrack.baselines.statistics import PairedDifference, paired_difference

ALGORITHMS = ("KF", "PF", "UKF", "UKF as printed")
SCALES = (1.0, 3.0, 10.0)
KAPPAS = (-5.0, 0.0, 1.0, 3.0)
AUDITED_EPISODES = 40
RANDOM_ELLIPSES = {**WORLD, "target": "ellipse"}
ASSUMED = (
    f"Assumed, for the paper is silent: process variance {paper002.PROCESS_VARIANCE}, measurement variance "
    f"{paper002.MEASUREMENT_VARIANCE:g}, P0 = {paper002.INITIAL_VARIANCE:g} I, gain {paper002.GAIN}, joint rates up to "
    f"{WORLD['max_joint_rate']:g} rad/s, no pixel noise. Errors: mean of the first 126 samples (transient, start-up "
    "included) and for t > 3 s (steady). Times: of the agent alone, per run, on this machine."
)


class Recording(NamedTuple):
    """A real sequence of the user's.

    Attributes:
        source: What `servotrack.envs.track.frames.open_frames` takes.
        truth: File of its true tracks; None where the source is a MOTChallenge folder, which has them.
    """

    source: str
    truth: str | None


class Request(NamedTuple):
    """What is to be reproduced, and how.

    Attributes:
        output: Folder for the tables, figures and claims.
        runs: Runs per algorithm; in "servo" only the particle filter's differ, by its own random numbers.
        console: Where to print.
        claims: Claims file to fill in; None for a copy of the shipped one in `output`.
        recordings: The user's own sequences, for "phd" and "transfer".
        into: A Markdown file with marks that the tables go into, too, for `TAKE_INTO`.
    """

    output: Path
    runs: int
    console: Console
    claims: Path | None = None
    recordings: tuple[Recording, ...] = ()
    into: Path | None = None


def reproduce_paper(
    paper: str,
    output: Path,
    runs: int | None,
    console: Console,
    claims_path: Path | None = None,
    recordings: Sequence[Recording] = (),
    into: Path | None = None,
) -> None:
    """Reproduce one paper.

    Args:
        paper: One of `PAPERS`.
        output: Folder for the tables, figures and claims.
        runs: Runs per algorithm; None for as many as the paper has.
        console: Where to print.
        claims_path: Claims file to fill in; None for a copy of the shipped one in `output`.
        recordings: The user's own sequences, for "phd" and "transfer".
        into: A Markdown file with marks: for "color" `<!-- paper001:begin -->` and `<!-- paper001:end -->`, for "phd"
            likewise with paper000, for "transfer" with transfer.

    Raises:
        ValueError: Another paper, or recordings or a file for one that takes none.
        ResultsError: `output` cannot be written.
    """
    if paper not in PAPERS:
        raise ValueError(f"paper must be one of {', '.join(PAPERS)}, got {paper!r}")
    if recordings and paper not in TAKE_RECORDINGS:
        raise ValueError(f"--source goes with {' and '.join(TAKE_RECORDINGS)}, got it with {paper!r}; leave it out")
    if into is not None and paper not in TAKE_INTO:
        raise ValueError(f"--into goes with {' and '.join(TAKE_INTO)}, got it with {paper!r}; leave it out")
    PAPERS[paper](
        Request(output, DEFAULT_RUNS[paper] if runs is None else runs, console, claims_path, tuple(recordings), into)
    )


def _reproduce_servo(request: Request) -> None:
    output, runs, console, claims_path, *_ = request
    seed = seeds.TEST[0]
    with progress_bars() as progress:
        tracking = _runs(TRACKING, runs, seed, progress)
        positioning = _runs(POSITIONING, runs, seed, progress)
        scaled = {
            (name, scale): paper002.run(TRACKING, paper002.estimator(name, scale), seed)
            for name in ("KF", "PF")
            for scale in SCALES
        }
        open_loop = paper002.open_loop_difference(KAPPAS, seed)
        closed_loop = paper002.closed_loop_difference(seed)
        audited = _audit_runs(progress)
    tables = {
        "Table 1: positioning": _positioning_grid(positioning),
        "Table 2: tracking": _tracking_grid(tracking),
        "The finding: on the linear model a UKF is a KF": _finding_grid(open_loop, closed_loop),
        "The ordering from tuning alone: process variance": _scale_grid(scaled, tracking),
    }
    claims = fill(
        read_claims(claims_path or SHIPPED), _findings(audited, tracking, positioning, open_loop, closed_loop)
    )
    tables["Claims"] = claims_grid([claim for claim in claims if claim.paper == "002"])
    for title, grid in tables.items():
        console.print(as_rich(grid, title))
    console.print(ASSUMED, style="dim")

    written = [output / "paper002.md", claims_path or output / "claims.yaml"]
    with atomic_path(written[0]) as temporary:
        intro = f"# Paper 002\n\nWritten by `{command_line()}`. {ASSUMED}\n\n"
        temporary.write_text(intro + as_sections(tables, "##"), encoding="utf-8")
    write_claims(claims, written[1])
    for name, found, title in (
        ("figure3", positioning, "Positioning (paper 002, figure 3)"),
        ("figure4", tracking, "Tracking (paper 002, figure 4)"),
    ):
        figure = draw_trajectories({algorithm: found[algorithm][0] for algorithm in ALGORITHMS}, title)
        for suffix in (".png", ".svg"):
            save_figure(figure, output / f"{name}{suffix}")
            written.append(output / f"{name}{suffix}")
    for path in written:
        console.print(str(path), soft_wrap=True)


def _reproduce_phd(request: Request) -> None:
    from servotrack.baselines.paper000.report import reproduce_phd

    reproduce_phd(request)


def _reproduce_transfer(request: Request) -> None:
    from servotrack.baselines.paper000.transfer import reproduce_transfer

    reproduce_transfer(request)


def _reproduce_color(request: Request) -> None:
    from servotrack.baselines.paper001.report import reproduce_color

    reproduce_color(request)


def _reproduce_pmm(request: Request) -> None:
    from servotrack.baselines.paper004.report import reproduce_pmm

    reproduce_pmm(request.output, request.runs, request.console, request.claims)


PAPERS: dict[str, Callable[[Request], None]] = {
    "servo": _reproduce_servo,
    "phd": _reproduce_phd,
    "color": _reproduce_color,
    "pmm": _reproduce_pmm,
    "transfer": _reproduce_transfer,
}
TAKE_RECORDINGS = ("phd", "transfer")
TAKE_INTO = ("phd", "color", "transfer")
DEFAULT_RUNS = {"servo": 10, "phd": 20, "color": 20, "pmm": 500, "transfer": 8}
"""As many as the paper has; papers 000 and 001 have one each, which would say nothing about others."""


def _runs(env_id: str, runs: int, seed: int, progress: Progress) -> dict[str, list[Run]]:
    bar = progress.add_task(env_id, total=runs * len(ALGORITHMS))
    found: dict[str, list[Run]] = {name: [] for name in ALGORITHMS}
    for name in ALGORITHMS:
        # The first run compiles and fills caches; its time would tell nothing.
        paper002.run(env_id, paper002.estimator(name), seed)
    # In turn, so that a machine that is busy for a while slows all of them down.
    for number in range(runs):
        for name, of_name in found.items():
            of_name.append(paper002.run(env_id, paper002.estimator(name, seed=number), seed))
            progress.advance(bar)
    return found


def _audit_runs(progress: Progress) -> dict[str, list[float]]:
    """Transient errors on random ellipses, test seeds, no noise: one list per algorithm, in the order of the seeds."""
    methods: dict[str, Any] = {name: paper002.estimator(name) for name in ALGORITHMS}
    methods["KF x10"] = paper002.estimator("KF", 10.0)
    methods["fixed"] = paper002.estimator("fixed")
    chosen = seeds.take("test", AUDITED_EPISODES)
    bar = progress.add_task("random ellipses", total=len(methods) * len(chosen))
    errors: dict[str, list[float]] = {name: [] for name in methods}
    for seed in chosen:
        for name, method in methods.items():
            errors[name].append(paper002.run(TRACKING, method, seed, RANDOM_ELLIPSES).transient)
            progress.advance(bar)
    return errors


def _mean(runs: Sequence[Run], attribute: str) -> float:
    return float(np.mean([getattr(run, attribute) for run in runs]))


def _seconds(runs: Sequence[Run]) -> float:
    """Median, so that another program's moment does not decide."""
    return float(np.median([run.seconds for run in runs]))


def _tiny(number: float) -> str:
    return f"{number:.0e}" if number else "0"


def _positioning_grid(found: Mapping[str, Sequence[Run]]) -> Grid:
    headings = ["algorithm", "paper's time s", "time s", "within 10 mm after s", "error at the end mm"]
    rows = []
    for name, runs in found.items():
        paper = paper002.PAPER_POSITIONING_SECONDS.get(name)
        end = float(np.mean([run.error[-1] for run in runs]))
        rows.append([
            name, "" if paper is None else f"{paper:.2f}", f"{_seconds(runs):.3f}",
            f"{_mean(runs, 'arrival'):.2f}", f"{1e3 * end:.4f}",
        ])  # fmt: skip
    return Grid(headings, rows, 1)


def _tracking_grid(found: Mapping[str, Sequence[Run]]) -> Grid:
    headings = ["algorithm", "paper's error m", "transient m", "steady m", "paper's time s", "time s"]
    rows = []
    for name, runs in found.items():
        error, seconds = paper002.PAPER_TRACKING_ERROR.get(name), paper002.PAPER_TRACKING_SECONDS.get(name)
        rows.append([
            name, "" if error is None else f"{error:.4f}", f"{_mean(runs, 'transient'):.4f}",
            f"{_mean(runs, 'steady'):.4f}", "" if seconds is None else f"{seconds:.3f}", f"{_seconds(runs):.3f}",
        ])  # fmt: skip
    return Grid(headings, rows, 1)


def _finding_grid(open_loop: Mapping[float, float], closed_loop: float) -> Grid:
    rows = [
        ["open loop, 1000 steps", f"kappa = {kappa:g}", f"{_tiny(difference)} of the largest entry"]
        for kappa, difference in open_loop.items()
    ]
    rows.append(["closed loop, 1000 steps", "tool paths apart by", f"{_tiny(closed_loop)} m"])
    return Grid(["experiment", "", "largest difference UKF - KF"], rows, 2)


def _scale_grid(scaled: Mapping[tuple[str, float], Run], tracking: Mapping[str, Sequence[Run]]) -> Grid:
    rows = [
        [name, f"x {scale:g}", f"{run.transient:.4f}", f"{run.steady:.4f}"] for (name, scale), run in scaled.items()
    ]
    printed = tracking["UKF as printed"]
    rows.append(
        ["UKF as printed", "exchanged", f"{_mean(printed, 'transient'):.4f}", f"{_mean(printed, 'steady'):.4f}"]
    )
    return Grid(["algorithm", "process variance", "transient m", "steady m"], rows, 2)


def claims_grid(claims: Sequence[Claim]) -> Grid:
    """The claims audit as a table."""
    rows = []
    for claim in claims:
        effect = claim.effect
        shown = "" if effect is None else f"{effect['value']} [{effect['low']}, {effect['high']}] {effect['unit']}"
        rows.append([claim.claim, claim.verdict, shown, claim.finding or ""])
    return Grid(["claim", "verdict", "effect", "finding"], rows, 4)


def _findings(
    audited: Mapping[str, Sequence[float]],
    tracking: Mapping[str, Sequence[Run]],
    positioning: Mapping[str, Sequence[Run]],
    open_loop: Mapping[float, float],
    closed_loop: float,
) -> list[Claim]:
    def compare(claim: str, first: str, second: str, finding: str) -> Claim:
        difference = paired_difference(audited[first], audited[second])
        return _finding(claim, judge_smaller(difference), _effect(difference, f"{first} - {second}"), finding)

    tuned = _effect(paired_difference(audited["KF x10"], audited["UKF as printed"]), "")
    seconds = {name: _seconds(runs) for name, runs in tracking.items()}
    ordered = seconds["KF"] < seconds["UKF"] < seconds["PF"]
    reached = positioning["UKF"]
    precise = all(run.error[-1] < paper002.ARRIVED and np.isfinite(run.arrival) for run in reached)
    return [
        compare(
            "servo-ukf-beats-kf", "UKF", "KF",
            f"Structure: eq. (9) is linear, where a UKF is a KF. Jacobians differ by {_tiny(max(open_loop.values()))} "
            f"of the largest entry, tool paths by {_tiny(closed_loop)} m.",
        ),
        compare(
            "servo-ukf-as-printed-beats-kf", "UKF as printed", "KF",
            "Tuning: eq. (21) exchanges the two variances, which makes the filter trust new frames more.",
        ),
        compare(
            "servo-faster-walk-beats-kf", "KF x10", "KF",
            "Tuning alone does what the printed blocks do: the two are "
            f"{tuned['value']} [{tuned['low']}, {tuned['high']}] mm apart.",
        ),
        compare("servo-pf-beats-kf", "PF", "KF", "Same noises: the particles approximate what the KF computes."),
        compare("servo-ukf-beats-pf", "UKF", "PF", "Same noises: the particles approximate what the UKF computes."),
        compare(
            "servo-online-estimation", "KF", "fixed",
            "Information: the estimate has J_t, and J_theta away from where it was learned.",
        ),
        _finding(
            "servo-ukf-time", "holds" if ordered else "does not hold", None,
            "Per run: " + ", ".join(f"{name} {value:.3f} s" for name, value in seconds.items()) + ".",
        ),
        _finding(
            "servo-positioning", "holds" if precise else "does not hold", None,
            f"Within 10 mm after {_mean(reached, 'arrival'):.2f} s; every estimator here positions alike.",
        ),
    ]  # fmt: skip


def _finding(claim: str, verdict: Any, effect: dict[str, Any] | None, finding: str) -> Claim:
    return Claim(claim, "002", "", "", verdict, effect, finding, "servotrack reproduce servo")


def _effect(difference: PairedDifference, measured: str) -> dict[str, Any]:
    value, low, high = (float(f"{1e3 * end:.3g}") + 0.0 for end in difference[:3])
    return {
        "value": value,
        "low": low,
        "high": high,
        "unit": "mm",
        "measured": f"transient error, {measured}, paired over {AUDITED_EPISODES} random ellipses without noise",
    }


def command_line() -> str:
    """The command that this process runs."""
    return shlex.join(["servotrack", *sys.argv[1:]])
