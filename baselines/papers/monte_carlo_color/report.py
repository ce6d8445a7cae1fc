"""Report of monte_carlo_color: success curves, figure 4, parameter sensitivity, and claims."""

from __future__ import annotations

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.claims import (
    SIGNS_NOTE,
    audited,
)
from servotrack.baselines.papers.monte_carlo_color.experiment import (
    DEFORMED,
    SLOW_TRACKERS,
    TRACKERS,
    deformed_plan,
    film_steps,
    median_steps,
    plan,
    run_all,
    scored_seeds,
)
from servotrack.baselines.papers.monte_carlo_color.figures import draw_sensitivity, draw_success, draw_tracked
from servotrack.baselines.papers.monte_carlo_color.findings import (
    COMMAND,
    PAPER_NAME,
    auc_grid,
    findings,
    quality_grid,
    sensitivity_grid,
)
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.envs.track.color.config import PAPER_SCENARIOS

NOTE = (
    "Films of ColorTracking-v0 on test seeds from the second on (the first one's were looked at before), 200 frames of "
    "300 x 245, started from the true box, one pass, all trackers on the same films; MIL on a tenth of them. AUC: area "
    "under the success curve, thresholds 0, 0.05, ..., 1; a perfect tracker has 20/21. Brackets: 95 % bootstrap "
    "intervals over films. Times: median step on this machine. Assumed, for the paper is silent: the standard "
    "deviations of place and scale, sigma_0, alpha and the threshold of eq. (12), chosen on tune seeds by "
    "servotrack.baselines.tuning.color_search, as all other trackers' values were. The box varies them on "
    f"the same films. {SIGNS_NOTE}"
)
TIMED_FILMS = 12
"""Number of films on which steps are timed."""


def reproduce(request: Request) -> None:
    """Reproduce Zhang and Li 2008; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of films per scenario.
    """
    with progress_bars() as progress:
        found = run_all(plan(request.runs), request.output / "films", progress)
        turned = deformed_plan(request.runs)
        deformed = run_all(turned, request.output / "films-deformed", progress, env_kwargs=DEFORMED)[PAPER_SCENARIOS[0]]
        bar = progress.add_task("timing and pictures", total=3)
        seconds = median_steps([*TRACKERS, *SLOW_TRACKERS], seeds.take("tune", 1)[0])
        progress.advance(bar)
        steps = film_steps(seeds.take("tune", TIMED_FILMS))
        progress.advance(bar)
        tracked = draw_tracked(scored_seeds(1)[0])
        progress.advance(bar)
    claims, audit = audited(PAPER_NAME, findings(found, deformed, steps), COMMAND, request.claims)
    tables = {
        "AUC by scenario": auc_grid(found),
        "Precision, failures, speed": quality_grid(found, seconds),
        "The paper's tracker with one value changed: AUC, and size of its box over the true one": sensitivity_grid(
            found
        ),
        **audit,
    }
    figures = {"success": draw_success(found), "figure4": tracked, "sensitivity": draw_sensitivity(found)}
    publish(request, tables, claims, f", {request.runs} films of each scenario", NOTE, figures)
