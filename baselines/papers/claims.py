"""Audit of the papers' claims, one row per claim.

A row says whose claim it is and where, what the paper leaves open, the condition under which the claim holds, the
effect with its interval and number of runs, and in what share of the box of open assumptions the verdict stays. All
verdicts are computed from the stored effects; a file in which one is anything else is rejected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import yaml

from servotrack.baselines.evaluation.statistics import bootstrap_mean, paired_difference
from servotrack.baselines.papers.boxes import (
    LEAST_RUNS,
    Assumption,
    Effect,
    Point,
    Reading,
    Rule,
    Verdict,
    check_readings,
    judge_all,
    judge_box,
    read_assumptions,
    summarize_box,
)
from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_strict_yaml
from servotrack.baselines.reporting.grid import Grid
from servotrack.estimators.types import Array

Whose = Literal["paper", "literature", "project"]
SHIPPED = Path(__file__).with_name("claims.yaml")
SIGNS: Mapping[Verdict, str] = {"holds": "+", "does not hold": "−", "no difference": "=", "open": "?"}
"""Signs of the verdicts in the table of a box."""
ROUNDING_DIGITS = 10
"""Decimal places beyond which an effect is a rounding error."""
SHOWN_EFFECTS = 2
"""Effects of one claim that a table shows: those nearest to failing."""
SIGNS_NOTE = "Signs in the box: + holds, − does not hold, = no difference, ? open."


@dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        id: Unique name.
        paper: Name of the paper: its folder and the argument of `servotrack reproduce`.
        whose: "paper" if the paper claims it of its own work, "literature" if it repeats what is known or said of other
            work, "project" if it is a question of this project about the paper.
        source: Section, equation, table or figure of the paper.
        claim: Statement.
        open: Names of the assumptions that the paper leaves open and that matter here, as in assumptions.yaml. Those
            with several values span the box; the others are not varied.
        holds_if: Condition on the effects; None for claims that are not tested.
        verdict: "holds", "does not hold" and "no difference" only if the whole box agrees; "depends" on `depends_on`;
            "open" if runs are too few or intervals too wide; "not tested" with the reason as `finding`.
        depends_on: Assumptions a change of which alone changes the verdict, strongest first.
        effects: Effects of the shipped values. A claim about several holds only if it holds for each.
        box: Summary of the box, see `summarize_box`; None without one.
        finding: Reason in one sentence: structure, information or tuning.
        command: Command that shows it.
        least_runs: Smallest number of runs; with fewer the verdict is open.
        listed_by: Readings of the paper that listed it; empty for the project's questions, and if it was not recorded.
        mended: Change by the second reading in a row of the first: place, wording or box.
    """

    id: str
    paper: str
    whose: Whose
    source: str
    claim: str
    open: tuple[str, ...] = ()
    holds_if: Rule | None = None
    verdict: Verdict = "open"
    depends_on: tuple[str, ...] = ()
    effects: tuple[Effect, ...] = ()
    box: Mapping[str, Any] | None = None
    finding: str | None = None
    command: str | None = None
    least_runs: int = LEAST_RUNS
    listed_by: tuple[Reading, ...] = ()
    mended: str | None = None

    def __post_init__(self) -> None:
        """Check the row. A ValueError names the claim and what to repair."""
        if self.whose not in get_args(Whose):
            raise ValueError(
                f"whose of claim {self.id!r} must be one of {', '.join(get_args(Whose))}, got {self.whose!r}"
            )
        check_readings(self.listed_by, f"claim {self.id!r}")
        if self.listed_by and self.whose == "project":
            raise ValueError(f"claim {self.id!r} is a question of the project: leave listed_by out")
        if self.mended and self.listed_by == ("second",):
            raise ValueError(f"claim {self.id!r} is not a row of the first reading: leave mended out")
        if self.verdict not in get_args(Verdict):
            raise ValueError(
                f"verdict of claim {self.id!r} must be one of {', '.join(get_args(Verdict))}, got {self.verdict!r}"
            )
        for effect in self.effects:
            ends = np.array(effect[:3], np.float64)
            if not (np.isfinite(ends).all() and effect.low <= effect.value <= effect.high and effect.runs >= 1):
                raise ValueError(
                    f"effects of claim {self.id!r} must be finite with low <= value <= high and at least one run, got "
                    f"{effect}"
                )
        if self.verdict == "not tested":
            if self.effects or self.box or self.holds_if or not self.finding:
                raise ValueError(
                    f"claim {self.id!r} is not tested: it must have a finding that says why, and no holds_if, effects "
                    "or box"
                )
            return
        if self.holds_if is None:
            raise ValueError(f"claim {self.id!r} needs holds_if, the condition on its effect")
        due = self.judged()
        if self.verdict != due:
            raise ValueError(
                f"verdict of claim {self.id!r} must be {due!r} by its effects and box, got {self.verdict!r}"
            )
        if (self.verdict == "depends") != bool(self.depends_on) or not set(self.depends_on) <= set(self.open):
            raise ValueError(
                f"depends_on of claim {self.id!r} must name open assumptions where the verdict depends on them, and "
                f"only there, got {list(self.depends_on)}"
            )

    def judged(self) -> Verdict:
        """Return the verdict that follows from the effects, the number of runs and the box."""
        assert self.holds_if is not None
        return judge_box(judge_all(self.effects, self.holds_if, self.least_runs), self.box)

    @property
    def agreement(self) -> str:
        """Number of points of the box with the main effect's verdict, of how many; empty without a box."""
        return "" if self.box is None else f"{round(self.box['share'] * self.box['points'])} of {self.box['points']}"


@dataclass(frozen=True)
class Finding:
    """Results of a reproduction about one claim.

    Attributes:
        id: Name of the claim.
        effects: Effects of the shipped values.
        finding: Reason in one sentence.
        points: Points of the box; empty without one.
    """

    id: str
    effects: tuple[Effect, ...]
    finding: str
    points: tuple[Point, ...] = ()


def effect_of(interval: Sequence[float] | Array, unit: str, measured: str, runs: int, scale: float = 1.0) -> Effect:
    """Return an effect from an interval that begins with value, low and high, in three significant digits.

    What is below the rounding errors of sums is 0.
    """
    value, low, high = (round(float(f"{scale * end:.3g}"), ROUNDING_DIGITS) + 0.0 for end in interval[:3])
    return Effect(value, min(low, value), max(high, value), unit, measured, runs)


def mean_effect(values: Sequence[float] | Array, unit: str, measured: str, scale: float = 1.0) -> Effect:
    """Return the mean of one value per run as an effect, multiplied by `scale`."""
    return effect_of(bootstrap_mean(values), unit, measured, len(values), scale)


def paired_effect(
    first: Sequence[float] | Array, second: Sequence[float] | Array, unit: str, measured: str, scale: float = 1.0
) -> Effect:
    """Return the mean difference of values that are paired by run as an effect, multiplied by `scale`."""
    return effect_of(paired_difference(first, second), unit, measured, len(first), scale)


def ratio_effect(first: Sequence[float] | Array, second: Sequence[float] | Array, measured: str) -> Effect:
    """Return the geometric mean of the ratios of values that are paired by run as an effect."""
    logarithms = np.log(np.asarray(first, np.float64) / np.asarray(second, np.float64))
    return effect_of(np.exp(bootstrap_mean(logarithms)), "times", measured, len(logarithms))


def read_claims(path: Path = SHIPPED, replaced: Collection[str] = ()) -> list[Claim]:
    """Read the claims of a file.

    Args:
        path: File.
        replaced: Claims whose results are about to be replaced. They are read without them, so that results that no
            longer fit the open assumptions need not be removed by hand.

    Raises:
        ResultsError: The file is missing or invalid.
    """
    known = read_assumptions()
    try:
        claims = [_claim(row if row["id"] not in replaced else _without_results(row)) for row in read_strict_yaml(path)]
        for claim in claims:
            if not isinstance(claim.id, str):
                raise TypeError("every id must be a text")
            _check_open(claim, known.get(claim.paper, {}))
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise ResultsError(f"{path} is not a valid claims file ({error}); restore it") from error
    return claims


def _without_results(row: Mapping[str, Any]) -> Mapping[str, Any]:
    computed = ("verdict", "depends_on", "effects", "box", "finding", "command")
    return {key: value for key, value in row.items() if key not in computed}


def _claim(row: Mapping[str, Any]) -> Claim:
    rule = row.get("holds_if")
    return Claim(
        **{
            **row,
            "open": tuple(row.get("open", ())),
            "listed_by": tuple(row.get("listed_by", ())),
            "depends_on": tuple(row.get("depends_on", ())),
            "effects": tuple(Effect(**effect) for effect in row.get("effects", ())),
            "holds_if": None if rule is None else Rule(**rule),
        }
    )


def _check_open(claim: Claim, known: Mapping[str, Assumption]) -> None:
    unknown = [name for name in claim.open if name not in known]
    if unknown:
        raise ValueError(f"open of claim {claim.id!r} must be in assumptions.yaml, got {', '.join(unknown)}")
    varied = {name for name in claim.open if len(known[name].values) > 1}
    if claim.box is not None and not varied <= set(claim.box["by"]) <= set(claim.open):
        raise ValueError(
            f"box of claim {claim.id!r} must vary {', '.join(sorted(varied)) or 'nothing'}, and only what is open, "
            f"got {', '.join(sorted(claim.box['by']))}"
        )
    if claim.box is None and varied and claim.verdict in ("holds", "does not hold", "no difference"):
        raise ValueError(
            f"claim {claim.id!r} must have a box over {', '.join(sorted(varied))} before it is {claim.verdict!r}; run "
            f"{claim.command}"
        )


def write_claims(claims: Sequence[Claim], path: Path) -> None:
    """Write a claims file atomically. Comments at the head of an existing file are kept."""
    head = ""
    if path.exists():
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        for line in lines:
            if not line.startswith("#"):
                break
            head += line
    with atomic_path(path) as temporary:
        text = yaml.safe_dump([_row(claim) for claim in claims], sort_keys=False, allow_unicode=True, width=110)
        temporary.write_text(head + text, encoding="utf-8")


def _row(claim: Claim) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for field in dataclasses.fields(claim):
        value = getattr(claim, field.name)
        if value is None or value == () or (field.name == "least_runs" and value == LEAST_RUNS):
            continue
        if isinstance(value, Rule):
            given = dataclasses.asdict(value)
            value = {key: number for key, number in given.items() if number is not None and (key != "margin" or number)}
        elif field.name == "effects":
            value = [effect._asdict() for effect in value]
        elif isinstance(value, tuple):
            value = list(value)
        row[field.name] = value
    return row


def fill(claims: Sequence[Claim], findings: Sequence[Finding], command: str) -> list[Claim]:
    """Return the claims with effects, boxes and verdicts of `findings`.

    Args:
        claims: All claims.
        findings: Findings about some of them.
        command: Command that found them.

    Raises:
        ValueError: A finding has an unknown id.
    """
    known = {claim.id for claim in claims}
    new = {finding.id: finding for finding in findings}
    unknown = [name for name in new if name not in known]
    if unknown:
        raise ValueError(f"findings must be about known claims, got {', '.join(unknown)}; add them to {SHIPPED.name}")
    return [_filled(claim, new[claim.id], command) if claim.id in new else claim for claim in claims]


def _filled(claim: Claim, found: Finding, command: str) -> Claim:
    assert claim.holds_if is not None
    main = judge_all(found.effects, claim.holds_if, claim.least_runs)
    box: dict[str, Any] | None = None
    reasons: list[str] = []
    if found.points:
        box, reasons = summarize_box(main, found.points, claim.holds_if, claim.least_runs)
    verdict = judge_box(main, box)
    if verdict == "depends":
        reasons = reasons or [name for name in (box or {"by": ()})["by"]]
    return replace(
        claim, verdict=verdict, depends_on=tuple(reasons) if verdict == "depends" else (), effects=found.effects,
        box=box, finding=found.finding, command=command,
    )  # fmt: skip


def claims_grid(claims: Sequence[Claim]) -> Grid:
    """Return the claims audit as a table."""
    headings = ["claim", "whose, where", "verdict", "box", "effect", "holds if", "finding"]
    rows = []
    for claim in claims:
        verdict = claim.verdict if claim.verdict != "depends" else f"depends on {', '.join(claim.depends_on)}"
        rows.append([
            claim.claim, f"{claim.whose}: {claim.source}", verdict, claim.agreement,
            _shown(claim), claim.holds_if.words if claim.holds_if else "",
            claim.finding or "",
        ])  # fmt: skip
    return Grid(headings, rows, 7)


def _shown(claim: Claim) -> str:
    """The effects nearest to failing, and the number of the others."""
    if claim.holds_if is None:
        return ""
    ordered = sorted(claim.effects, key=claim.holds_if.slack)
    parts = [
        f"{effect.value:g} [{effect.low:g}, {effect.high:g}] {effect.unit} ({effect.runs} runs): {effect.measured}"
        for effect in ordered[:SHOWN_EFFECTS]
    ]
    rest = len(ordered) - len(parts)
    return "; ".join([*parts, *([f"and {rest} more"] if rest else [])])


def assumptions_grid(paper: str) -> Grid:
    """Return the open assumptions of a paper as a table."""
    rows = []
    for name, open_one in read_assumptions().get(paper, {}).items():
        values = ", ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in open_one.values)
        rows.append([name, open_one.says, f"{values} {open_one.unit}".strip(), str(open_one.shipped)])
    return Grid(["open", "what the paper says", "values run", "in the main tables"], rows, 4)


def audited(
    paper: str, findings: Sequence[Finding], command: str, path: Path | None
) -> tuple[list[Claim], dict[str, Grid]]:
    """Fill in a claims file's claims, and return them all with the tables about a paper's.

    Args:
        paper: Name of the paper.
        findings: Findings about some of the claims.
        command: Command that found them.
        path: Claims file; None for the shipped one.

    Raises:
        ValueError: A finding has an unknown id.
        ResultsError: The file is missing or invalid.
    """
    claims = fill(read_claims(path or SHIPPED, {finding.id for finding in findings}), findings, command)
    tables = {
        "What the paper leaves open": assumptions_grid(paper),
        "Claims": claims_grid([claim for claim in claims if claim.paper == paper or claim.command == command]),
        **box_grids(claims, findings),
    }
    return claims, tables


def box_grids(claims: Sequence[Claim], findings: Sequence[Finding]) -> dict[str, Grid]:
    """Return the boxes as tables by title: one row per point, one column per claim; claims of one box share a table."""
    named = {claim.id: claim for claim in claims}
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        if finding.points:
            groups.setdefault(tuple(finding.points[0].at), []).append(finding)
    tables = {}
    for axes, members in groups.items():
        by_point: dict[tuple[str, ...], dict[str, str]] = {}
        for member in members:
            claim = named[member.id]
            assert claim.holds_if is not None
            for point in member.points:
                verdict = judge_all(point.effects, claim.holds_if, claim.least_runs)
                cell = "; ".join(f"{e.value:g} [{e.low:g}, {e.high:g}]" for e in point.effects)
                key = tuple(str(value) for value in point.at.values())
                by_point.setdefault(key, {})[member.id] = f"{SIGNS[verdict]} {cell}"
        headings = [*axes, *(f"{member.id}, {member.points[0].effects[0].unit}" for member in members)]
        rows = [[*key, *(cells.get(member.id, "") for member in members)] for key, cells in by_point.items()]
        tables[f"The box of {', '.join(axes)}"] = Grid(headings, rows, len(axes))
    return tables
