"""Summary of the claims file: verdicts by paper, and what the verdicts depend on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import get_args

from servotrack.baselines.papers.boxes import Verdict
from servotrack.baselines.papers.claims import SHIPPED, Claim, read_claims
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_sections
from servotrack.baselines.reporting.terminal import command_line, print_tables


def reproduce(request: Request) -> None:
    """Print the summary of the claims file and write it; nothing is run.

    Args:
        request: Request; `runs` is ignored.
    """
    claims = read_claims(request.claims or SHIPPED)
    tables = {
        "Verdicts by paper": verdicts_grid(claims),
        "Claims that depend on what the papers leave open": dependents_grid(claims),
        "Claims that are not tested": untested_grid(claims),
    }
    print_tables(request.console, tables)
    written = request.output / "audit.md"
    intro = f"Written by `{command_line()}` from the claims file.\n\n"
    with atomic_path(written) as temporary:
        temporary.write_text(f"# Audit\n\n{intro}{as_sections(tables, '##')}", encoding="utf-8")
    request.console.print(str(written), soft_wrap=True)
    if request.into is not None:
        embed(intro + as_sections(tables, "###"), request.into, request.paper.name)
        request.console.print(str(request.into), soft_wrap=True)


def verdicts_grid(claims: Sequence[Claim]) -> Grid:
    """Return the number of claims of each paper by verdict, those of the papers and of this project apart."""
    kinds = get_args(Verdict)
    rows = []
    for paper in dict.fromkeys(claim.paper for claim in claims):
        for whose in ("paper", "project"):
            counts = Counter(claim.verdict for claim in claims if (claim.paper, claim.whose) == (paper, whose))
            if counts:
                rows.append([paper, whose, *(str(counts[kind]) for kind in kinds)])
    total = Counter(claim.verdict for claim in claims)
    rows.append(["all", "", *(str(total[kind]) for kind in kinds)])
    return Grid(["paper", "whose claim", *kinds], rows, 2)


def dependents_grid(claims: Sequence[Claim]) -> Grid:
    """Return the claims whose verdict depends on an open assumption, with the shares of points that agree."""
    rows = []
    for claim in claims:
        if claim.verdict == "depends" and claim.box is not None:
            counts = ", ".join(f"{verdict} {count}" for verdict, count in claim.box["verdicts"].items())
            shares = "; ".join(
                f"{name}: " + ", ".join(f"{value} {share:.0%}" for value, share in claim.box["by"][name].items())
                for name in claim.depends_on
            )
            rows.append([claim.claim, claim.paper, counts, claim.agreement, shares])
    headings = ["claim", "paper", "points of the box", "as in the main tables", "share that is, by assumption"]
    return Grid(headings, rows, 5)


def untested_grid(claims: Sequence[Claim]) -> Grid:
    """Return the claims that are not tested, with the reasons."""
    rows = [
        [claim.claim, f"{claim.paper}, {claim.source}", claim.finding or ""]
        for claim in claims
        if claim.verdict == "not tested"
    ]
    return Grid(["claim", "where", "why not"], rows, 3)
