"""Which numbers each kind of world is judged by, and against which agent differences are taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from servotrack.baselines.agents.protocol import World


@dataclass(frozen=True)
class Measure:
    """One number of an episode.

    Attributes:
        column: Its name in the rows of results.
        heading: Its name in tables.
        unit: Its unit in tables; "" where it has none.
        factor: From the rows' unit to the tables'.
        digits: Shown behind the point.
        high_is_good: Whether larger is better.
    """

    column: str
    heading: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 2
    high_is_good: bool = False

    @property
    def title(self) -> str:
        """Heading and unit."""
        return f"{self.heading} {self.unit}".strip()


@dataclass(frozen=True)
class Judgment:
    """How a world's agents are compared.

    Attributes:
        headline: What ranks them and what differences are taken of.
        reference: The agent that differences are against.
        others: What is shown before the headline.
    """

    headline: Measure
    reference: str
    others: tuple[Measure, ...] = ()

    @property
    def shown(self) -> tuple[Measure, ...]:
        """All measures in the order of the table's columns."""
        return (*self.others, self.headline)


JUDGMENTS: Mapping[World, Judgment] = {
    "servo": Judgment(Measure("steady", "steady", "mm", 1e3, 1), "ukf"),
    "clutter": Judgment(Measure("ospa2", "OSPA(2)", "m"), "gm-phd", (Measure("ospa", "OSPA", "m"),)),
    "video": Judgment(
        Measure("ospa2", "OSPA(2)", digits=3),
        "gm-phd",
        (
            Measure("count_right", "count right", "%", 100.0, 0, True),
            Measure("mota", "MOTA", high_is_good=True),
            Measure("idf1", "IDF1", high_is_good=True),
            Measure("hota", "HOTA", high_is_good=True),
            Measure("ospa", "OSPA", digits=3),
        ),
    ),
    "color": Judgment(
        Measure("auc", "AUC", digits=3, high_is_good=True),
        "monte-carlo-color",
        (
            Measure("precision", "within 20 px", "%", 100.0, 0, True),
            Measure("failures", "times lost", digits=1),
        ),
    ),
    "sonar": Judgment(
        Measure("ospa2", "OSPA(2)", "deg"),
        "hmm-cell",
        (
            Measure("count_right", "count right", "%", 100.0, 0, True),
            Measure("ospa", "OSPA", "deg"),
        ),
    ),
    "follow": Judgment(
        Measure("time_on_target", "within 10 cm", "% of time", 100.0, 1, True),
        "nearest-servo",
        (
            Measure("identity_error", "at another person", "% of time", 100.0, 1),
            Measure("losses", "times lost", digits=2),
            Measure("reacquisitions", "times found again", digits=2, high_is_good=True),
        ),
    ),
}
