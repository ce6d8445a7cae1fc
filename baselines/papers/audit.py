"""Summary of the claims file: verdicts by paper, and what the verdicts depend on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import get_args

from servotrack.baselines.papers.boxes import Assumption, Reading, Verdict, read_assumptions
from servotrack.baselines.papers.claims import SHIPPED, Claim, Whose, read_claims
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
    assumptions = [found for by_name in read_assumptions().values() for found in by_name.values()]
    tables = {
        "Verdicts by paper": verdicts_grid(claims),
        "Two readings: number of rows that list the same": readings_grid(claims, assumptions),
        "Claims that only one reading lists": single_readings_grid(claims),
        "Open assumptions that only one reading lists": single_assumptions_grid(assumptions),
        "Rows that the second reading mended": mended_grid(claims),
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
        for whose in get_args(Whose):
            counts = Counter(claim.verdict for claim in claims if (claim.paper, claim.whose) == (paper, whose))
            if counts:
                rows.append([paper, whose, *(str(counts[kind]) for kind in kinds)])
    total = Counter(claim.verdict for claim in claims)
    rows.append(["all", "", *(str(total[kind]) for kind in kinds)])
    return Grid(["paper", "whose claim", *kinds], rows, 2)


def readings_grid(claims: Sequence[Claim], assumptions: Sequence[Assumption]) -> Grid:
    """Return the number of claims and of open assumptions of each paper that both readings list, or one of them."""
    kinds: list[tuple[Reading, ...]] = [("first", "second"), ("first",), ("second",)]
    rows: list[list[str]] = []
    for what, listed in (("claims", claims), ("open assumptions", assumptions)):
        read = [(row.paper, row.listed_by) for row in listed if row.listed_by]
        counts, total = Counter(read), Counter(listed_by for _, listed_by in read)
        rows += [
            [what, paper, *(str(counts[paper, kind]) for kind in kinds)] for paper in dict.fromkeys(p for p, _ in read)
        ]
        rows.append([what, "all", *(str(total[kind]) for kind in kinds)])
    return Grid(["rows", "paper", "both", "first only", "second only"], rows, 2)


def single_readings_grid(claims: Sequence[Claim]) -> Grid:
    """Return the claims that only one reading lists, with their verdicts."""
    rows = [
        [claim.claim, f"{claim.paper}, {claim.source}", claim.whose, claim.listed_by[0], claim.verdict]
        for claim in claims
        if len(claim.listed_by) == 1
    ]
    return Grid(["claim", "where", "whose", "reading", "verdict"], rows, 5)


def single_assumptions_grid(assumptions: Sequence[Assumption]) -> Grid:
    """Return the open assumptions that only one reading lists, with the values that are run."""
    rows = [
        [found.name, found.paper, found.says, ", ".join(map(str, found.values)), found.listed_by[0]]
        for found in assumptions
        if len(found.listed_by) == 1
    ]
    return Grid(["open", "paper", "what the paper says", "values run", "reading"], rows, 5)


def mended_grid(claims: Sequence[Claim]) -> Grid:
    """Return the rows of the first reading that the second one changed, and what it changed."""
    rows = [[claim.claim, f"{claim.paper}, {claim.source}", claim.mended] for claim in claims if claim.mended]
    return Grid(["claim", "where", "what was changed"], rows, 3)


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
