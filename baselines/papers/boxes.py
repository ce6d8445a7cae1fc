"""Open assumptions of the papers, the box that their values span, and the share of it in which a verdict stays.

A paper that does not print a parameter leaves it open. A claim is then not one experiment but a box of them: one point
for each combination of plausible values. `judge_box` turns the verdicts at all points into one.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from servotrack.baselines.reporting.files import ResultsError, read_strict_yaml

Verdict = Literal["holds", "does not hold", "no difference", "depends", "open", "not tested"]
Value = float | int | str | bool
Reading = Literal["first", "second"]
SHIPPED_ASSUMPTIONS = Path(__file__).with_name("assumptions.yaml")
LEAST_RUNS = 10
"""Smallest number of runs from which an effect is judged; with fewer a verdict is open."""


class Effect(NamedTuple):
    """An effect with its 95 % interval.

    Attributes:
        value, low, high: Mean and ends of the interval, in `unit`.
        unit: Unit.
        measured: Quantity.
        runs: Number of independent runs behind it.
    """

    value: float
    low: float
    high: float
    unit: str
    measured: str
    runs: int


@dataclass(frozen=True)
class Rule:
    """Condition on an effect under which a claim holds. Exactly one of `below`, `above` and `within` is given.

    Attributes:
        below: The effect must be smaller.
        above: The effect must be larger.
        within: The absolute effect must be smaller.
        margin: Smallest effect that matters, for `below` and `above`: an interval within the margin around the limit
            means no difference. Larger margins call more effects none. 0 calls none none.
    """

    below: float | None = None
    above: float | None = None
    within: float | None = None
    margin: float = 0.0

    def __post_init__(self) -> None:
        """Check that one condition is given. Raises ValueError."""
        given = [name for name in ("below", "above", "within") if getattr(self, name) is not None]
        if len(given) != 1 or self.margin < 0.0 or (self.within is not None and (self.within <= 0.0 or self.margin)):
            raise ValueError(
                f"holds_if must have one of below, above and within (above 0), and a margin >= 0 beside the first two, "
                f"got {self}"
            )

    @property
    def words(self) -> str:
        """Condition in words."""
        if self.within is not None:
            return f"within ±{self.within:g}"
        sign, limit = ("<", self.below) if self.below is not None else (">", self.above)
        return f"{sign} {limit:g}" + (f", none within ±{self.margin:g}" if self.margin else "")

    def slack(self, effect: Effect) -> float:
        """Return by how much the less favorable end of an interval keeps the condition; negative if it does not."""
        if self.within is not None:
            return self.within - max(abs(effect.low), abs(effect.high))
        if self.below is not None:
            return self.below - effect.high
        assert self.above is not None
        return effect.low - self.above

    def judge(self, effect: Effect, least_runs: int = LEAST_RUNS) -> Verdict:
        """Return the verdict of one effect: its whole 95 % interval must lie on one side, else it is open."""
        if effect.runs < least_runs:
            return "open"
        low, high = effect.low, effect.high
        if self.within is not None:
            if max(abs(low), abs(high)) < self.within:
                return "holds"
            return "does not hold" if low > self.within or high < -self.within else "open"
        limit = self.below if self.below is not None else self.above
        assert limit is not None
        if self.margin and max(abs(low - limit), abs(high - limit)) < self.margin:
            return "no difference"
        smaller, larger = high < limit, low > limit
        if not (smaller or larger):
            return "open"
        return "holds" if smaller == (self.below is not None) else "does not hold"


def judge_all(effects: Sequence[Effect], rule: Rule, least_runs: int = LEAST_RUNS) -> Verdict:
    """Return the verdict of a claim that says the same of several effects: it holds only if it holds for each."""
    found = [rule.judge(effect, least_runs) for effect in effects]
    for verdict in ("does not hold", "open", "no difference"):
        if verdict in found:
            return verdict  # type: ignore[return-value]
    return "holds" if found else "open"


@dataclass(frozen=True)
class Assumption:
    """A parameter or a reading that a paper leaves open.

    Attributes:
        paper: Name of the paper.
        name: Name, unique in the paper.
        says: Words of the paper about it, and what they leave open.
        values: Values that are run. A single one is not varied.
        shipped: Value of the reproduction's main tables.
        unit: Unit of the values; empty for names.
        listed_by: Readings of the paper that noticed it; empty if that was not recorded.
    """

    paper: str
    name: str
    says: str
    values: tuple[Value, ...]
    shipped: Value
    unit: str = ""
    listed_by: tuple[Reading, ...] = ()

    def __post_init__(self) -> None:
        """Check the values and the readings. Raises ValueError."""
        check_readings(self.listed_by, f"assumption {self.name!r}")
        if not self.values or len(set(map(str, self.values))) != len(self.values) or self.shipped not in self.values:
            raise ValueError(
                f"values of assumption {self.name!r} must be different and hold the shipped one, got {self.values} and "
                f"{self.shipped!r}"
            )


def check_readings(listed_by: Sequence[str], what: str) -> None:
    """Check the names of readings. Raises ValueError, which calls the row `what`."""
    if list(listed_by) not in ([], ["first"], ["second"], ["first", "second"]):
        raise ValueError(
            f"listed_by of {what} must be [first], [second], [first, second] or left out, got {list(listed_by)}"
        )


def read_assumptions(path: Path = SHIPPED_ASSUMPTIONS) -> dict[str, dict[str, Assumption]]:
    """Read the open assumptions, by paper and name.

    Raises:
        ResultsError: The file is missing or invalid.
    """
    found: dict[str, dict[str, Assumption]] = {}
    try:
        for row in read_strict_yaml(path):
            assumption = Assumption(
                **{**row, "values": tuple(row["values"]), "listed_by": tuple(row.get("listed_by", ()))}
            )
            if assumption.name in found.setdefault(assumption.paper, {}):
                raise ValueError(f"assumption {assumption.name!r} of {assumption.paper} is there twice")
            found[assumption.paper][assumption.name] = assumption
    except (TypeError, KeyError, ValueError) as error:
        raise ResultsError(f"{path} is not a valid file of assumptions ({error}); restore it") from error
    return found


def box_points(paper: str, names: Sequence[str]) -> list[dict[str, Value]]:
    """Return all combinations of the values of a paper's assumptions, the last name varying fastest."""
    known = read_assumptions()[paper]
    return [
        dict(zip(names, values, strict=True)) for values in itertools.product(*(known[name].values for name in names))
    ]


class Point(NamedTuple):
    """Effects at one point of a box.

    Attributes:
        at: Value of each assumption.
        effects: Effects that the claim is about.
    """

    at: Mapping[str, Value]
    effects: tuple[Effect, ...]


def effects_at(points: Sequence[Point], **at: Value) -> tuple[Effect, ...]:
    """Return the effects of the first point that has the given values."""
    return next(point.effects for point in points if all(point.at[name] == value for name, value in at.items()))


def summarize_box(
    main: Verdict, points: Sequence[Point], rule: Rule, least_runs: int = LEAST_RUNS
) -> tuple[dict[str, Any], list[str]]:
    """Count the verdicts in a box, and name the assumptions on which they depend.

    Args:
        main: Verdict of the shipped values, with all their runs.
        points: Points of the box.
        rule: Condition of the claim.
        least_runs: Smallest number of runs at a point.

    Returns:
        The summary: `points`, smallest number of `runs`, `verdicts` by count, `share` of the points with the main
        verdict, and this share `by` value of each assumption. And the assumptions, the strongest first, a change of
        which alone turns a decided verdict into another decided one.
    """
    verdicts = [judge_all(point.effects, rule, least_runs) for point in points]
    names = list(points[0].at)
    by: dict[str, dict[str, float]] = {}
    flips: Counter[str] = Counter()
    for name in names:
        same: dict[str, list[bool]] = {}
        lines: dict[tuple[str, ...], set[Verdict]] = {}
        for point, verdict in zip(points, verdicts, strict=True):
            same.setdefault(str(point.at[name]), []).append(verdict == main)
            rest = tuple(str(point.at[other]) for other in names if other != name)
            if verdict != "open":
                lines.setdefault(rest, set()).add(verdict)
        by[name] = {value: round(sum(those) / len(those), 3) for value, those in same.items()}
        flips[name] = sum(len(those) > 1 for those in lines.values())
    counts = Counter(verdicts)
    summary = {
        "points": len(points),
        "runs": min(effect.runs for point in points for effect in point.effects),
        "verdicts": {verdict: counts[verdict] for verdict in sorted(counts)},
        "share": round(counts[main] / len(points), 3),
        "by": by,
    }
    return summary, [name for name, count in flips.most_common() if count]


def judge_box(main: Verdict, box: Mapping[str, Any] | None) -> Verdict:
    """Return the verdict of a claim from that of its main effect and from its box.

    It is the main one only if all points agree. If decided points disagree, with each other or with the main effect,
    the claim depends on its assumptions. If all decided points agree and some are open, more runs are needed: open.
    """
    if box is None or (main == "open" and set(box["verdicts"]) == {"open"}):
        return main
    decided = (set(box["verdicts"]) | {main}) - {"open"}
    if len(decided) > 1:
        return "depends"
    return "open" if "open" in box["verdicts"] or main == "open" else main
