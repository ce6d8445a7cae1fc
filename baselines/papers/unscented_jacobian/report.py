"""Report of unscented_jacobian: positioning, tracking, cause of the paper's ordering, figures 3 and 4, claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.progress import Progress

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.boxes import Effect, Value, effects_at
from servotrack.baselines.papers.claims import (
    SIGNS_NOTE,
    Finding,
    audited,
    mean_effect,
    paired_effect,
    ratio_effect,
)
from servotrack.baselines.papers.parts import Arrays, part, setting_of, shown_parts_of_seeds
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.papers.unscented_jacobian import experiment
from servotrack.baselines.papers.unscented_jacobian.box import EPISODES, FASTER, RANDOM_ELLIPSES, Box
from servotrack.baselines.papers.unscented_jacobian.experiment import POSITIONING, TRACKING, WORLD, Run
from servotrack.baselines.papers.unscented_jacobian.figures import draw_trajectories
from servotrack.baselines.reporting.grid import Grid
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.estimators.jacobian import JacobianEstimator

PAPER_NAME = "unscented_jacobian"
COMMAND = f"servotrack reproduce {PAPER_NAME}"
ALGORITHMS = ("KF", "PF", "UKF", "UKF as printed")
SCALES = (1.0, 3.0, 10.0)
KAPPAS = (-5.0, 0.0, 1.0, 3.0)
AUDITED_EPISODES = 40
ASSUMED = (
    f"Assumed, for the paper is silent: process variance {experiment.PROCESS_VARIANCE}, measurement variance "
    f"{experiment.MEASUREMENT_VARIANCE:g}, P0 = {experiment.INITIAL_VARIANCE:g} I, gain {experiment.GAIN}, joint rates "
    f"up to {WORLD['max_joint_rate']:g} rad/s, no pixel noise. Errors: mean of the first 126 samples (transient, "
    f"start-up included) and for t > 3 s (steady). Times: of the agent alone, per run, on this machine. Box: "
    f"{EPISODES} random ellipses at each point, the same for all. {SIGNS_NOTE}"
)


class ScaledRun(NamedTuple):
    """Errors of one run with another process variance.

    Attributes:
        transient: Mean error of the first 126 samples, m.
        steady: Mean error for t > 3 s, m.
    """

    transient: float
    steady: float


def reproduce(request: Request) -> None:
    """Reproduce Zhang 2011; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of runs per algorithm.
    """
    runs = request.runs
    seed = seeds.TEST[0]
    folder = request.output / PAPER_NAME
    with progress_bars() as progress:
        tracking = _runs(TRACKING, runs, seed, folder, progress)
        positioning = _runs(POSITIONING, runs, seed, folder, progress)
        scaled = {(name, scale): _scaled_run(name, scale, seed, folder) for name in ("KF", "PF") for scale in SCALES}
        open_loop = _open_loop(seed, folder)
        closed_loop = _closed_loop(seed, folder)
        ellipses = _audit_runs(folder, progress)
        box = Box(folder / "box", progress)
    tables = {
        "Table 1: positioning": _positioning_grid(positioning),
        "Table 2: tracking": _tracking_grid(tracking),
        "The finding: on the linear model a UKF is a KF": _finding_grid(open_loop, closed_loop),
        "The ordering from tuning alone: process variance": _scale_grid(scaled, tracking),
    }
    findings = _findings(ellipses, tracking, positioning, open_loop, closed_loop, box)
    claims, audit = audited(PAPER_NAME, findings, COMMAND, request.claims)
    figures = {
        name: draw_trajectories({algorithm: found[algorithm][0] for algorithm in ALGORITHMS}, title)
        for name, found, title in (
            ("figure3", positioning, "Positioning (Zhang 2011, figure 3)"),
            ("figure4", tracking, "Tracking (Zhang 2011, figure 4)"),
        )
    }
    publish(request, {**tables, **audit}, claims, "", ASSUMED, figures)


def _setting(**values: Any) -> str:
    """Settings that a part's results depend on, in one line."""
    return setting_of(**_values(**values))


def _values(**values: Any) -> dict[str, Any]:
    """Assumed values and `values`; a world other than the paper's is among them."""
    assumed = (experiment.PROCESS_VARIANCE, experiment.MEASUREMENT_VARIANCE, experiment.INITIAL_VARIANCE)
    return {"assumed": assumed, "gain": experiment.GAIN, "probe": experiment.PROBE, "world": dict(WORLD), **values}


def _runs(env_id: str, runs: int, seed: int, folder: Path, progress: Progress) -> dict[str, list[Run]]:
    bar = progress.add_task(env_id, total=runs)
    found: dict[str, list[Run]] = {name: [] for name in ALGORITHMS}

    def run_once(number: int) -> Arrays:
        arrays: dict[str, Any] = {}
        # All algorithms in turn, so that other load on the machine affects them alike.
        for name in ALGORITHMS:
            done = experiment.run(env_id, experiment.estimator(name, seed=number), seed)
            arrays |= {f"{name}/{field}": value for field, value in vars(done).items()}
        return arrays

    paths = [folder / env_id / f"run-{number}.npz" for number in range(runs)]
    if not all(path.exists() for path in paths):
        for name in ALGORITHMS:
            # The first run compiles and fills caches, so it is not timed.
            experiment.run(env_id, experiment.estimator(name), seed)
    for number, path in enumerate(paths):
        setting = _setting(env=env_id, number=number, seed=seed)
        stored = part(path, setting, lambda number=number: run_once(number))  # type: ignore[misc]
        for name, done in found.items():
            columns: dict[str, Any] = {field.name: stored[f"{name}/{field.name}"] for field in fields(Run)}
            values: dict[str, Any] = {key: value if value.ndim else float(value) for key, value in columns.items()}
            done.append(Run(**values))
        progress.advance(bar)
    return found


def _scaled_run(name: str, scale: float, seed: int, folder: Path) -> ScaledRun:
    def compute() -> Arrays:
        run = experiment.run(TRACKING, experiment.estimator(name, scale), seed)
        return {"transient": run.transient, "steady": run.steady}

    stored = part(folder / "scales" / f"{name}-{scale:g}.npz", _setting(name=name, scale=scale, seed=seed), compute)
    return ScaledRun(float(stored["transient"]), float(stored["steady"]))


def _open_loop(seed: int, folder: Path) -> dict[float, float]:
    stored = part(
        folder / "open-loop.npz",
        _setting(kappas=KAPPAS, seed=seed),
        lambda: {"differences": list(experiment.open_loop_difference(KAPPAS, seed).values())},
    )
    return dict(zip(KAPPAS, stored["differences"].tolist(), strict=True))


def _closed_loop(seed: int, folder: Path) -> float:
    stored = part(
        folder / "closed-loop.npz", _setting(seed=seed), lambda: {"difference": experiment.closed_loop_difference(seed)}
    )
    return float(stored["difference"])


def _audit_runs(folder: Path, progress: Progress) -> dict[str, list[float]]:
    """Transient errors on random ellipses, test seeds, no noise: one list per algorithm, in the order of the seeds."""
    methods: dict[str, JacobianEstimator] = {name: experiment.estimator(name) for name in ALGORITHMS}
    methods[FASTER] = experiment.estimator("KF", 10.0)
    methods |= {name: experiment.estimator(name) for name in ("fixed", "KF without J_t")}

    def errors(seed: int) -> Arrays:
        runs = {name: experiment.run(TRACKING, method, seed, RANDOM_ELLIPSES) for name, method in methods.items()}
        return {name: run.transient for name, run in runs.items()}

    rows = shown_parts_of_seeds(
        progress, "random ellipses", folder / "ellipses", AUDITED_EPISODES, errors, **_values(world=RANDOM_ELLIPSES)
    )
    return {name: [float(row[name]) for row in rows] for name in methods}


def _mean(runs: Sequence[Run], attribute: str) -> float:
    return float(np.mean([getattr(run, attribute) for run in runs]))


def _seconds(runs: Sequence[Run]) -> float:
    """Median time, which ignores short interruptions by other programs, s."""
    return float(np.median([run.seconds for run in runs]))


def _tiny(number: float) -> str:
    return f"{number:.0e}" if number else "0"


def _positioning_grid(found: Mapping[str, Sequence[Run]]) -> Grid:
    headings = ["algorithm", "paper's time s", "time s", "within 10 mm after s", "error at the end mm"]
    rows = []
    for name, runs in found.items():
        paper = experiment.PAPER_POSITIONING_SECONDS.get(name)
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
        error, seconds = experiment.PAPER_TRACKING_ERROR.get(name), experiment.PAPER_TRACKING_SECONDS.get(name)
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
    return Grid(["experiment", "setting", "largest difference UKF - KF"], rows, 2)


def _scale_grid(scaled: Mapping[tuple[str, float], ScaledRun], tracking: Mapping[str, Sequence[Run]]) -> Grid:
    rows = [
        [name, f"x {scale:g}", f"{run.transient:.4f}", f"{run.steady:.4f}"] for (name, scale), run in scaled.items()
    ]
    printed = tracking["UKF as printed"]
    rows.append(
        ["UKF as printed", "exchanged", f"{_mean(printed, 'transient'):.4f}", f"{_mean(printed, 'steady'):.4f}"]
    )
    return Grid(["algorithm", "process variance", "transient m", "steady m"], rows, 2)


def _findings(
    ellipses: Mapping[str, Sequence[float]],
    tracking: Mapping[str, Sequence[Run]],
    positioning: Mapping[str, Sequence[Run]],
    open_loop: Mapping[float, float],
    closed_loop: float,
    box: Box,
) -> list[Finding]:
    def compare(claim: str, first: str, second: str, finding: str) -> Finding:
        effect = _effect(ellipses[first], ellipses[second], f"{first} - {second}")
        return Finding(claim, (effect,), finding, box.differences(first, second))

    def slower(first: str, second: str) -> Effect:
        times = {name: [run.seconds for run in tracking[name]] for name in (first, second)}
        return ratio_effect(times[first], times[second], f"processor time per run, {first} / {second}")

    tuned = _effect(ellipses[FASTER], ellipses["UKF as printed"], "")
    seconds = {name: _seconds(runs) for name, runs in tracking.items()}
    assumed: dict[str, Value] = {
        "process_variance": experiment.PROCESS_VARIANCE,
        "measurement_variance": experiment.MEASUREMENT_VARIANCE,
        "pixel_noise": 0.0,
    }
    jacobian, printed = box.jacobians("UKF", "KF", 0), box.jacobians("UKF as printed", "KF", 0)
    particles = box.jacobians("PF", "KF", 0)
    (by_time,) = effects_at(box.jacobians("UKF as printed", "KF", 1), **assumed)
    heavy = box.heavy_tails()
    rest = box.at_rest
    at_rest = "tracking error before targets at rest elsewhere, KF - fixed"
    arrival = "time until the error stays below 10 mm, UKF, random targets at rest"
    return [
        compare(
            "servo-ukf-beats-kf", "UKF", "KF",
            f"Structure: eq. (9) is linear, where a UKF is a KF. Jacobians differ by {_tiny(max(open_loop.values()))} "
            f"of the largest entry, tool paths by {_tiny(closed_loop)} m, for kappa from {min(open_loop):g} to "
            f"{max(open_loop):g}.",
        ),
        compare(
            "servo-ukf-as-printed-beats-kf", "UKF as printed", "KF",
            "Tuning: eq. (21) exchanges the two variances. That helps where the measurement variance is the larger "
            "one, changes nothing where they are equal, and hurts where it is the smaller one.",
        ),
        compare(
            "servo-faster-walk-beats-kf", FASTER, "KF",
            "Tuning: ten times the process variance does what the printed blocks do at the assumed variances; the two "
            f"are {tuned.value:g} [{tuned.low:g}, {tuned.high:g}] mm apart there.",
        ),
        compare("servo-pf-beats-kf", "PF", "KF", "Same noises: the particles approximate what the KF computes."),
        compare("servo-ukf-beats-pf", "UKF", "PF", "Same noises: the particles approximate what the UKF computes."),
        compare(
            "servo-online-estimation", "KF", "fixed",
            "Information: on a moving target the estimate has J_t, too, which the learned one lacks; see the row on "
            "targets at rest for J_theta alone.",
        ),
        compare(
            "servo-target-jacobian", "KF", "KF without J_t",
            "Information: without J_t the law does not know that the target goes on.",
        ),
        Finding(
            "servo-online-at-rest", (paired_effect(rest["KF"], rest["fixed"], "mm", at_rest, 1e3),),
            "Structure: before a target at rest a proportional law arrives with any Jacobian that is roughly right; "
            "the one learned before the paper's target serves in the whole reach of the arm.",
        ),
        Finding(
            "servo-jacobian-accuracy", effects_at(jacobian, **assumed),
            "Structure: on the same data the two are the same filter.", jacobian,
        ),
        Finding(
            "servo-jacobian-accuracy-as-printed", effects_at(printed, **assumed),
            "Tuning: with the assumed variances it tracks better with a worse J_theta; what improves is J_t, by "
            f"{-by_time.value:.3g} [{-by_time.high:.3g}, {-by_time.low:.3g}] % of the norm.", printed,
        ),
        Finding(
            "servo-pf-jacobian-accuracy", effects_at(particles, **assumed),
            "Same noises: the particles approximate what the KF computes.", particles,
        ),
        Finding(
            "servo-pf-not-gaussian", effects_at(heavy, noise_kind="outliers", pf_likelihood="normal"),
            "Information: particles gain nothing from their number; a likelihood with heavy tails can.", heavy,
        ),
        Finding(
            "servo-ukf-time", (slower("UKF", "KF"), slower("PF", "UKF")),
            "Median per run: " + ", ".join(f"{name} {value:.3f} s" for name, value in seconds.items()) + ".",
        ),
        Finding(
            "servo-ukf-time-close", (slower("UKF", "KF"),),
            "The paper's own tables have twice the KF's time, 0.38 s against 0.19 s and 0.632 s against 0.279 s.",
        ),
        Finding(
            "servo-pf-time", (slower("PF", "KF"),),
            "With 300 particles for each feature in NumPy; the paper's ratio is 7.",
        ),
        Finding(
            "servo-positioning", (mean_effect(rest["UKF/arrival"], "s", arrival),),
            f"Before the paper's target {_mean(positioning['UKF'], 'arrival'):.2f} s, as with every estimator here; "
            f"the error at the end is {1e3 * rest['UKF/end'].mean():.2g} mm on average.",
        ),
    ]  # fmt: skip


def _effect(first: Sequence[float], second: Sequence[float], measured: str) -> Effect:
    return paired_effect(first, second, "mm", f"transient error, {measured}, random ellipses without noise", 1e3)
