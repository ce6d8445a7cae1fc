"""`servotrack reproduce color`: paper 001's figure 4 with success curves, its free values, and its claims."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from servotrack.baselines import seeds
from servotrack.baselines.bench import progress_bars
from servotrack.baselines.claims import SHIPPED, fill, read_claims, write_claims
from servotrack.baselines.leaderboard.embed import embed
from servotrack.baselines.leaderboard.figure import save_figure
from servotrack.baselines.leaderboard.table import Grid, as_markdown, as_rich
from servotrack.baselines.paper001.experiment import SLOW_TRACKERS, TRACKERS, judged_seeds, median_steps, plan, run_all
from servotrack.baselines.paper001.figures import draw_sensitivity, draw_success, draw_tracked
from servotrack.baselines.paper001.findings import COMMAND, auc_grid, findings, quality_grid, sensitivity_grid
from servotrack.baselines.results import atomic_path

if TYPE_CHECKING:
    from servotrack.baselines.reproduce import Request

NOTE = (
    "Films of ColorTracking-v0 on test seeds from the second on (the first one's were looked at before), 200 frames of "
    "300 x 245, started from the true box, one pass, all trackers on the same films; MIL on a tenth of them. AUC: area "
    "under the success curve, thresholds 0, 0.05, ..., 1; a perfect tracker has 20/21. Brackets: 95 % bootstrap "
    "intervals over films. Times: median step on this machine. Assumed, for the paper is silent: the standard "
    "deviations of place and scale, sigma_0, alpha and the threshold of eq. (12), chosen on tune seeds by "
    "servotrack.baselines.color.tuning, as all other trackers' values were."
)


def reproduce_color(request: Request) -> None:
    """Reproduce paper 001; errors as in `servotrack.baselines.reproduce.reproduce_paper`.

    Args:
        request: What is wanted; `runs` are the films of each scenario.
    """
    from servotrack.baselines.reproduce import claims_grid

    output, console = request.output, request.console
    with progress_bars() as progress:
        found = run_all(plan(request.runs), output / "films", progress)
        bar = progress.add_task("timing and pictures", total=2)
        seconds = median_steps([*TRACKERS, *SLOW_TRACKERS], seeds.take("tune", 1)[0])
        progress.advance(bar)
        tracked = draw_tracked(judged_seeds(1)[0])
        progress.advance(bar)
    claims = fill(read_claims(request.claims or SHIPPED), findings(found, seconds))
    tables = {
        "AUC by scenario": auc_grid(found),
        "Precision, failures, speed": quality_grid(found, seconds),
        "The paper's tracker with one value changed: AUC, and size of its box over the true one": sensitivity_grid(
            found
        ),
        "Claims": claims_grid([claim for claim in claims if claim.command == COMMAND]),
    }
    for title, grid in tables.items():
        console.print(as_rich(grid, title))
    console.print(NOTE, style="dim")

    written = [output / "paper001.md", request.claims or output / "claims.yaml"]
    with atomic_path(written[0]) as temporary:
        temporary.write_text(f"# Paper 001\n\n{_document(tables, request.runs, '##')}", encoding="utf-8")
    write_claims(claims, written[1])
    for name, figure, suffixes in (
        ("success", draw_success(found), (".png", ".svg")),
        ("figure4", tracked, (".png", ".svg")),
        ("sensitivity", draw_sensitivity(found), (".png", ".svg")),
    ):
        for suffix in suffixes:
            save_figure(figure, output / f"{name}{suffix}")
            written.append(output / f"{name}{suffix}")
    if request.into is not None:
        embed(_document(tables, request.runs, "###"), request.into, "paper001")
        written.append(request.into)
    for path in written:
        console.print(str(path), soft_wrap=True)


def _document(tables: Mapping[str, Grid], runs: int, heading: str) -> str:
    """All tables as Markdown, with the command that wrote them; `heading` is what begins their titles."""
    from servotrack.baselines.reproduce import command_line

    parts = [f"Written by `{command_line()}`, {runs} films of each scenario. {NOTE}\n"]
    parts += [f"{heading} {title}\n\n{as_markdown(grid)}" for title, grid in tables.items()]
    return "\n".join(parts)
