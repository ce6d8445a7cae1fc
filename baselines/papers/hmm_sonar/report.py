"""Report of hmm_sonar: figures 2 to 6, trackers at falling signal-to-noise ratio, and claims."""

from __future__ import annotations

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.claims import (
    audited,
)
from servotrack.baselines.papers.hmm_sonar.experiment import SIMULATIONS, plan, run_all
from servotrack.baselines.papers.hmm_sonar.figures import draw_offsets, draw_paper, draw_trial
from servotrack.baselines.papers.hmm_sonar.findings import (
    COMMAND,
    CONTRADICTIONS,
    PAPER_NAME,
    findings,
    simulation_grid,
    trial_grid,
)
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.terminal import progress_bars

NOTE = (
    "Records of SonarTracking-v0 on test seeds, beamformed from snapshots; all methods on the same ones, which they "
    "are given whole, but for the one that is 5 s late; that one and the paper's on a fifth of them. A target is "
    "tracked in a row if a track is within 3 deg. Swaps: runs in which a track went over to the other target at the "
    "crossing. False tracks: at no target for more than half of their rows. Times: median processor time for a "
    "record of 60 s on this machine, one thread."
)


def reproduce(request: Request) -> None:
    """Reproduce Jiang and Zhou 2016; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of records per condition.
    """
    with progress_bars() as progress:
        found = run_all(plan(request.runs), request.output / "records", progress)
        bar = progress.add_task("timing and pictures", total=2)
        seed = seeds.take("test", 1)[0]
        figures = {"figures2to4": draw_paper(seed), "offsets": draw_offsets(found)}
        progress.advance(bar)
        figures["trial"] = draw_trial(seed)
        progress.advance(bar)
    claims, audit = audited(PAPER_NAME, findings(found), COMMAND, request.claims)
    tables = {
        "Contradictions of the paper": CONTRADICTIONS,
        **{f"Simulation, variant {variant}": simulation_grid(found, variant) for variant in SIMULATIONS},
        "The sea trial's stand-in, and noise": trial_grid(found),
        **audit,
    }
    publish(request, tables, claims, f", {request.runs} records of each condition", NOTE, figures)
