"""Report of pairwise_markov: the paper's table and figures, sweeps that show when its claims hold, and claims."""

from __future__ import annotations

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.claims import (
    SIGNS_NOTE,
    audited,
)
from servotrack.baselines.papers.pairwise_markov import tables as grids
from servotrack.baselines.papers.pairwise_markov.experiment import draw_runs, single_run, time_steps
from servotrack.baselines.papers.pairwise_markov.figures import (
    draw_errors,
    draw_estimates,
    draw_numbers,
    draw_sweep,
    draw_truth,
)
from servotrack.baselines.papers.pairwise_markov.findings import COMMAND, PAPER_NAME, findings
from servotrack.baselines.papers.pairwise_markov.plan import (
    CLUTTER_RATES,
    DETECTION_PROBABILITIES,
    METHODS,
    PAPER_DETECTION,
    PAPER_RATE,
    all_conditions,
    clutter_name,
    detection_name,
    shares,
)
from servotrack.baselines.papers.pairwise_markov.runs import run_all
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.estimators.types import Array

TIMED_RUNS = 11
"""Number of runs for the timing; the first one only compiles."""
NOTE = (
    "Twelve targets, 100 scans, structure S1 with sigma_v = 5 m/s^1.5 and sigma_w = 1.5 m, paths drawn anew in every "
    "run, all methods on the same scans of test seeds. OSPA: c = 100 m, p = 1, positions, mean over scans and runs. "
    "After ±: standard errors over runs. Assumed, for the paper's values are lost: p_S = 0.99, p_D = 0.98, births of "
    "weight 0.03 at four places with standard deviation 10, extraction at 0.5 (all from Vo's toolbox), the clutter "
    "rates beside 20, the noise levels, and structure S1 as the reading of a, b, c, d. The paper's own numbers in "
    f"table 1 are lost, too; its claims are not. {SIGNS_NOTE}"
)


def reproduce(request: Request) -> None:
    """Reproduce Zhang et al. 2017; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of runs per clutter rate.
    """
    runs = request.runs
    conditions, wanted = all_conditions(), shares(runs)
    plan = [(condition, seeds.take("test", wanted[kind])) for kind, condition in conditions]
    first = seeds.take("test", 1)[0]
    paper_world = next(condition for _, condition in conditions if condition.name == clutter_name(PAPER_RATE))
    with progress_bars() as progress:
        found = run_all(plan, request.output / "runs", progress)
        bar = progress.add_task("timing", total=len(CLUTTER_RATES) + 1)
        timed = seeds.take("tune", TIMED_RUNS)
        seconds: dict[tuple[str, float], Array] = {}
        for rate in CLUTTER_RATES:
            condition = next(c for _, c in conditions if c.name == clutter_name(rate))
            for name, medians in time_steps(METHODS, condition, timed).items():
                seconds[name, rate] = medians
            progress.advance(bar)
        seconds["SMC-PHD", PAPER_RATE] = time_steps(["SMC-PHD"], paper_world, timed)["SMC-PHD"]
        progress.advance(bar)
    counted = draw_runs(paper_world.config, [first])[0].exists[:-1].sum(axis=1)
    claims, audit = audited(PAPER_NAME, findings(found, seconds, counted), COMMAND, request.claims)
    rates = [found[clutter_name(rate)] for rate in CLUTTER_RATES]
    sweep = [found[detection_name(p)] for p in DETECTION_PROBABILITIES]
    tables = {
        f"Table 1: OSPA in m and time per step, p_D = {PAPER_DETECTION}": grids.table1(rates, seconds),
        "Paired differences of OSPA in m, by clutter rate": grids.differences(
            rates, [f"clutter {rate:g}" for rate in CLUTTER_RATES]
        ),
        "The sweep that decides: OSPA in m by p_D, clutter 20": grids.means(
            sweep, METHODS, [f"p_D = {p:.2f}" for p in DETECTION_PROBABILITIES]
        ),
        "Paired differences of OSPA in m, by p_D": grids.differences(
            sweep, [f"p_D = {p:.2f}" for p in DETECTION_PROBABILITIES]
        ),
        "Figure 3 in numbers: targets counted too many, ten present": grids.number_grid(
            [*rates, *sweep],
            [f"clutter {rate:g}" for rate in CLUTTER_RATES] + [f"p_D = {p:.2f}" for p in DETECTION_PROBABILITIES],
        ),
        "Extraction rules, clutter 20": grids.extraction_grid(found["extraction"]),
        "Other metrics, clutter 20, m": grids.metrics_grid(found[clutter_name(PAPER_RATE)]),
        "Readings of a, b, c, d: what the PMM gains, OSPA in m": grids.structure_grid(found),
        f"Identity, {wanted['part']} runs: OSPA(2) and trajectory GOSPA in m": grids.identity_grid(found["identity"]),
        **audit,
    }
    example = single_run("CBMeMBer-PMM", paper_world, first)
    at_paper = {name: found[clutter_name(PAPER_RATE)][name] for name in METHODS}
    figures = {
        "figure1": draw_truth(example, paper_world.config.half_width),
        "figure2": draw_estimates(example, "CBMeMBer-PMM"),
        "figure3": draw_numbers(at_paper, counted),
        "figure4": draw_errors(at_paper),
        "sweep-clutter": draw_sweep(CLUTTER_RATES, rates, METHODS, "clutter per scan"),
        "sweep-detection": draw_sweep(DETECTION_PROBABILITIES, sweep, METHODS, "detection probability"),
    }
    scope = (
        f": {runs} runs at each clutter rate, {wanted['part']} in the sweep over p_D, {wanted['few']} per structure, "
        f"{wanted['box']} at each point of the box"
    )
    publish(request, tables, claims, scope, NOTE, figures)
