"""Audit of the papers' claims: verdict, effect with its interval, and the command that shows it, one row per claim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from servotrack.baselines.evaluation.statistics import PairedDifference
from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_strict_yaml
from servotrack.baselines.reporting.grid import Grid

Verdict = Literal["holds", "does not hold", "no difference", "open"]
SHIPPED = Path(__file__).with_name("claims.yaml")
ROUNDING_ERROR = 1e-6
"""Differences of tracking errors below this are rounding errors, m."""


@dataclass(frozen=True)
class Claim:
    """One claim of a paper.

    Attributes:
        id: Unique name.
        paper: Name of the paper: its folder and the argument of `servotrack reproduce`.
        source: Section, equation, table or figure of the paper that makes the claim.
        claim: Statement of the paper.
        verdict: Result of the audit.
        effect: Effect size: `value`, `low`, `high` (95 % interval), `unit`, and the quantity `measured`; None if it has
            none.
        finding: Reason in one sentence: structure, information or tuning.
        command: Command that shows it.
    """

    id: str
    paper: str
    source: str
    claim: str
    verdict: Verdict = "open"
    effect: dict[str, Any] | None = None
    finding: str | None = None
    command: str | None = None


def read_claims(path: Path = SHIPPED) -> list[Claim]:
    """Read the claims of a file.

    Raises:
        ResultsError: The file is missing or invalid.
    """
    try:
        claims = [Claim(**row) for row in read_strict_yaml(path)]
    except TypeError as error:
        raise ResultsError(f"{path} is not a valid claims file ({error}); restore it") from error
    if not all(isinstance(claim.id, str) for claim in claims):
        raise ResultsError(f"{path} is not a valid claims file (every id must be a text); restore it")
    wrong = [claim.id for claim in claims if claim.verdict not in get_args(Verdict)]
    if wrong:
        raise ResultsError(f"{path}: verdict of {', '.join(wrong)} must be one of {', '.join(get_args(Verdict))}")
    return claims


def write_claims(claims: Sequence[Claim], path: Path) -> None:
    """Write a claims file atomically. Comments at the head of an existing file are kept."""
    head = ""
    if path.exists():
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        for line in lines:
            if not line.startswith("#"):
                break
            head += line
    rows = [{key: value for key, value in asdict(claim).items() if value is not None} for claim in claims]
    with atomic_path(path) as temporary:
        text = yaml.safe_dump(rows, sort_keys=False, allow_unicode=True, width=110)
        temporary.write_text(head + text, encoding="utf-8")


def fill(claims: Sequence[Claim], findings: Sequence[Claim]) -> list[Claim]:
    """Return the claims with verdicts, effects, findings and commands copied from `findings` of the same id.

    Raises:
        ValueError: A finding has an unknown id.
    """
    known = {claim.id for claim in claims}
    new = {finding.id: finding for finding in findings}
    unknown = [name for name in new if name not in known]
    if unknown:
        raise ValueError(f"findings must be about known claims, got {', '.join(unknown)}; add them to {SHIPPED.name}")
    return [
        replace(claim, verdict=f.verdict, effect=f.effect, finding=f.finding, command=f.command)
        if (f := new.get(claim.id))
        else claim
        for claim in claims
    ]


def claims_grid(claims: Sequence[Claim]) -> Grid:
    """Return the claims audit as a table."""
    rows = []
    for claim in claims:
        effect = claim.effect
        shown = "" if effect is None else f"{effect['value']} [{effect['low']}, {effect['high']}] {effect['unit']}"
        rows.append([claim.claim, claim.verdict, shown, claim.finding or ""])
    return Grid(["claim", "verdict", "effect", "finding"], rows, 4)


def judge_smaller(difference: PairedDifference) -> Verdict:
    """Return the verdict on "the first error is smaller than the second" from their paired difference."""
    if max(abs(difference.low), abs(difference.high)) < ROUNDING_ERROR or difference.low <= 0.0 <= difference.high:
        return "no difference"
    return "holds" if difference.high < 0.0 else "does not hold"
