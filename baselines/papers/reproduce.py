"""Look up a paper by name and run its reproduction: tables beside the paper's, and a verdict on each claim.

Only the command line imports this module. Reproductions are imported by their "module:callable" when they run, so that
`Paper`, `Request` and the tools that they share never import them back.
"""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from servotrack.baselines.papers.request import Paper, Recording, Request
from servotrack.baselines.running.stopping import GO_ON, keeping

_ROOM = "servotrack.baselines.papers"
PAPERS: dict[str, Paper] = {
    paper.name: paper
    for paper in (
        Paper(
            "gm_phd_video",
            "Wu and Hu 2010: Multi-target tracking based on Gaussian mixture PHD filter in video",
            "GM-PHD filter on video",
            f"{_ROOM}.gm_phd_video.report:reproduce",
            20,
            takes_recordings=True,
        ),
        Paper(
            "gm_phd_video_readings",
            "Wu and Hu 2010: readings of what the text leaves open",
            "claims of gm_phd_video on counts and events under every reading of its text",
            f"{_ROOM}.gm_phd_video.readings_report:reproduce",
            10,
        ),
        Paper(
            "monte_carlo_color",
            "Zhang and Li 2008: Object tracking with Monte Carlo methods",
            "Monte-Carlo color tracking",
            f"{_ROOM}.monte_carlo_color.report:reproduce",
            20,
        ),
        Paper(
            "unscented_jacobian",
            "Zhang 2011: Unscented Kalman filter for on-line estimation of Jacobian matrix",
            "unscented Kalman filter of the image Jacobian",
            f"{_ROOM}.unscented_jacobian.report:reproduce",
            10,
        ),
        Paper(
            "hmm_sonar",
            "Jiang and Zhou 2016: Hidden Markov models for automatic detection and tracking of several targets",
            "hidden Markov models on bearing-time records",
            f"{_ROOM}.hmm_sonar.report:reproduce",
            50,
        ),
        Paper(
            "hmm_sonar_readings",
            "Jiang and Zhou 2016: readings of what the text leaves open",
            "claims of hmm_sonar under every reading of its text",
            f"{_ROOM}.hmm_sonar.readings_report:reproduce",
            12,
        ),
        Paper(
            "pairwise_markov",
            "Zhang, Han, Lian and Zeng 2017: Cardinality balanced multi-target multi-Bernoulli filter for pairwise "
            "Markov model",
            "PHD and CBMeMBer filters under pairwise Markov models",
            f"{_ROOM}.pairwise_markov.report:reproduce",
            500,
        ),
        Paper(
            "audit",
            "Audit: what the papers claim, and what of it depends on what they leave open",
            "summary of the claims file, without runs",
            f"{_ROOM}.audit:reproduce",
            1,
        ),
        Paper(
            "transfer",
            "Transfer: rankings of trackers on rendered and on recorded people",
            "rank correlation of trackers between rendered people and your sequences",
            f"{_ROOM}.transfer:reproduce",
            8,
            takes_recordings=True,
        ),
    )
}
"""All papers by name. Fewer than ten runs leave every claim open."""
OLD_NAMES = {
    "phd": "gm_phd_video",
    "color": "monte_carlo_color",
    "servo": "unscented_jacobian",
    "sonar": "hmm_sonar",
    "pmm": "pairwise_markov",
}
"""Earlier names and the present ones. Accepted for one release."""


def find_paper(name: str) -> Paper:
    """Return the paper called `name`; hyphens count as underscores.

    A name in `OLD_NAMES` prints its new name to stderr.

    Raises:
        ValueError: Unknown name; the message suggests near ones.
    """
    wanted = name.replace("-", "_")
    if wanted in OLD_NAMES:
        print(f"servotrack: {name!r} is now called {OLD_NAMES[wanted]!r}", file=sys.stderr)
        wanted = OLD_NAMES[wanted]
    if wanted not in PAPERS:
        near = difflib.get_close_matches(wanted, (*PAPERS, *OLD_NAMES), n=2)
        names = " or ".join(repr(found) for found in dict.fromkeys(OLD_NAMES.get(found, found) for found in near))
        hint = f"; did you mean {names}?" if near else ""
        raise ValueError(f"paper must be one of {', '.join(PAPERS)}, got {name!r}{hint}")
    return PAPERS[wanted]


def reproduce_paper(
    name: str,
    output: Path,
    runs: int | None,
    console: Console,
    claims_path: Path | None = None,
    recordings: Sequence[Recording] = (),
    into: Path | None = None,
) -> None:
    """Reproduce one paper.

    Args:
        name: Name in `PAPERS`.
        output: Folder for the tables, figures and claims.
        runs: Runs per algorithm; None for the paper's default. More runs narrow the intervals.
        console: Console for the tables and the paths of the written files.
        claims_path: Claims file to fill in; None for a copy of the shipped one in `output`.
        recordings: Sequences of the user, for papers with `takes_recordings`.
        into: Markdown file with the marks `<!-- NAME:begin -->` and `<!-- NAME:end -->` that also receives the tables.

    Raises:
        ValueError: Unknown name, or recordings for a paper that takes none.
        ResultsError: `output` cannot be written.
    """
    paper = find_paper(name)
    if recordings and not paper.takes_recordings:
        takers = " and ".join(other.name for other in PAPERS.values() if other.takes_recordings)
        raise ValueError(f"--source goes with {takers}, got it with {paper.name!r}; leave it out")
    module, _, function = paper.run.partition(":")
    run: Callable[[Request], None] = getattr(importlib.import_module(module), function)
    request = Request(
        paper, output, paper.default_runs if runs is None else runs, console, claims_path, tuple(recordings), into
    )
    with keeping(lambda: f"{sum(1 for _ in output.rglob('*.npz'))} finished parts are in {output}; {GO_ON}"):
        run(request)
