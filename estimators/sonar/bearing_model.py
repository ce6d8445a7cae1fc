"""Parameters of the hidden Markov bearing tracker and its cached tables: grid chain, beam patterns, matched filter."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from servotrack.estimators.hmm.chain import GridChain, grid_chain
from servotrack.estimators.sonar.array import Band, LineArray, Shading, bearings
from servotrack.estimators.sonar.beam_patterns import Patterns, PlanarPatterns
from servotrack.estimators.sonar.beamforming import Beamformer, element_weights
from servotrack.estimators.sonar.directions import Directions
from servotrack.estimators.sonar.elements import AnyArray, check_angles, is_line
from servotrack.estimators.sonar.rules import (
    BackgroundRules,
    CrossingRules,
    FastRules,
    JoiningRules,
    LikelihoodRules,
    SearchRules,
    SpanRules,
)
from servotrack.estimators.sonar.scores import RowScores
from servotrack.estimators.types import Array

if sys.version_info >= (3, 11):
    from typing import Self
else:
    from typing_extensions import Self

Likelihood = Literal["row", "cell"]


def fitting_rates(spacing: float, period: float, fastest: float = 2.0) -> tuple[float, ...]:
    """Return rates up to `fastest`, deg/s; half a step of the rate moves a target by one beam per row.

    The grid holds at least one step on both sides of zero.

    Args:
        spacing: Distance of neighboring beams, deg.
        beamformer: Beamformer of the rows.
        noise_averages: Number of independent averages in one beam power, 1 over the relative variance of its noise;
            None: bins times snapshots, or what a whole record shows if its spread differs by `spread_tolerance`.
        period: Time between rows, s.
        fastest: Largest rate, deg/s, rounded to a step. Larger values follow faster targets and are slower.
    """
    step = 2.0 * spacing / period
    most = max(1, round(fastest / step))
    return tuple((step * np.arange(-most, most + 1)).tolist())


@dataclass(frozen=True)
class BearingModel:
    """Parameters of the hidden Markov bearing tracker (Jiang and Zhou 2016), and tables computed on first use.

    Attributes:
        likelihood: `row` compares whole rows with the array's beam patterns and subtracts the power explained by other
            targets; `cell` is the paper's method: each beam alone, cells of other targets excluded.
        array: Line array, or elements at given places, of the receiver.
        band: Frequency bins over which the receiver sums.
        shading: Shading of the elements.
        beams: Number of equally spaced beams from 0 to 180 deg (planar arrays: around the circle), or the angles of the
            beams, deg, in rising order, such as those of a sector or beams equally spaced in cosine.
        snapshots: Number of snapshots averaged in one row.
        beamformer: Beamformer of the rows.
        noise_averages: Number of independent averages in one beam power, 1 over the relative variance of its noise;
            None: bins times snapshots, or what a whole record shows if its spread differs by `spread_tolerance`.
        period: Time between rows, s.
        rates: Bearing rates of the grid, deg/s. None: at most 2 deg/s and four steps that fit the beams to each side,
            and as far beyond as ridges in the record move.
        acceleration: Standard deviation of the bearing's acceleration, deg/s^2. Larger values follow maneuvers faster
            and average fewer rows.
        switching: Probability that a target appears or disappears from row to row. Larger values react faster.
        bridge: Longest gap that does not end a track, s.
        evidence: Smallest log likelihood ratio of a track, nats. Larger values report fewer false and fewer weak
            tracks.
        evidence_of_piece: Smallest log likelihood ratio of an unbroken stretch of a track, nats.
        model_error: Relative standard deviation of the power explained by other targets (`row`).
        misplaced: Number of beams by which a pattern may be misplaced (`row`).
        reach: Number of beams of the matched filter to each side (`row`).
        shared_beams: Number of neighboring beams that share their noise and count as one measurement (`row`).
        power_spread: Relative standard deviation of a target's power from row to row (`row`).
        weakest: Smallest expected power of a target, in standard deviations of the noise (`row`).
        spread_beams: Number of beams to each side that a target occupies (`cell`).
        max_targets: Largest number of chains.
        sweeps: Number of turns of a new chain with its neighbors, and of all chains at the end.
        lag: Delay of the estimates of `step`, rows. Larger values are more accurate.
        window: Number of rows that `step` smooths, more than `lag`.
        memory_limit: Largest memory of `track`, bytes; longer records are rejected.
        jump: Change of an estimate between rows, beyond the fastest rate, that still counts as the same target, deg.
        likelihood_rules: Parameters of the likelihood ratio of a row.
        spans: Thresholds of location and existence.
        search: Thresholds of the joint search.
        crossing: Thresholds of the test for exchanged identities.
        joining: Thresholds that join parts of a track.
        backgrounds: Thresholds of the background and the noise level of rows.
        fast: Thresholds of the search for ridges that are faster than the grid.
        spread_tolerance: Factor between the measured and the expected standard deviation of the noise from which the
            measured one is used.
    """

    likelihood: Likelihood = "row"
    array: AnyArray = field(default_factory=LineArray)
    band: Band = field(default_factory=Band)
    shading: Shading = "conventional"
    beams: int | tuple[float, ...] = 721
    snapshots: int = 10
    period: float = 1.0
    rates: tuple[float, ...] | None = None
    acceleration: float = 0.3
    switching: float = 0.02
    bridge: float = 6.0
    evidence: float = 10.0
    evidence_of_piece: float = 4.0
    model_error: float = 0.15
    misplaced: int = 4
    reach: int = 24
    shared_beams: float = 10.0
    power_spread: float = 0.3
    weakest: float = 1.5
    spread_beams: int = 8
    max_targets: int = 12
    sweeps: int = 2
    lag: int = 5
    window: int = 20
    memory_limit: float = 4e9
    jump: float = 2.0
    likelihood_rules: LikelihoodRules = field(default_factory=LikelihoodRules)
    spans: SpanRules = field(default_factory=SpanRules)
    search: SearchRules = field(default_factory=SearchRules)
    crossing: CrossingRules = field(default_factory=CrossingRules)
    joining: JoiningRules = field(default_factory=JoiningRules)
    backgrounds: BackgroundRules = field(default_factory=BackgroundRules)
    fast: FastRules = field(default_factory=FastRules)
    beamformer: Beamformer = "conventional"
    noise_averages: float | None = None
    spread_tolerance: float = 1.5
    usual_width: ClassVar[float] = 3.1

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it, and the spacing that fits the rates."""
        if self.likelihood not in get_args(Likelihood):
            raise ValueError(f"likelihood must be one of {', '.join(get_args(Likelihood))}, got {self.likelihood!r}")
        if not isinstance(self.beams, int):
            check_angles(self.array, self.beams)
        elif self.beams < 2:
            raise ValueError(f"beams must be at least 2, got {self.beams!r}")
        if self.beamformer not in get_args(Beamformer):
            raise ValueError(f"beamformer must be one of {', '.join(get_args(Beamformer))}, got {self.beamformer!r}")
        element_weights(self.array, self.shading)
        supported = max(self.array.elements // 2, 1)
        if not 1 <= self.max_targets <= supported:
            raise ValueError(
                f"max_targets must lie in 1..{supported} for an array of {self.array.elements} elements, "
                f"got {self.max_targets!r}"
            )
        if not 0 <= self.lag < self.window:
            raise ValueError(f"lag must lie in 0..window - 1, got lag={self.lag!r}, window={self.window!r}")
        for name in ("snapshots", "sweeps", "misplaced", "spread_beams", "reach", "shared_beams"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        for name in ("model_error", "power_spread", "weakest", "memory_limit", "jump"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        if not 0.0 < self.switching < 1.0:
            raise ValueError(f"switching must lie in (0, 1), got {self.switching!r}")
        if not self.bridge >= 0.0:
            raise ValueError(f"bridge must be >= 0, got {self.bridge!r}")
        self.chain  # noqa: B018  the grid checks the rates

    @classmethod
    def fitted(
        cls,
        array: AnyArray,
        band: Band,
        beams: int | Sequence[float] | None = None,
        *,
        period: float = 1.0,
        snapshots: int = 10,
        beamformer: Beamformer = "conventional",
        **settings: Any,
    ) -> Self:
        """Return a tracker whose windows and thresholds follow the beam width of an array.

        The defaults of the fields suit beams of 3.1 deg and rows of 1 s. Distances scale with the beam width, changes
        of rate with the width per row, and times with the period.

        Args:
            array: Line array, or elements at given places.
            band: Frequency bins over which the receiver sums.
            beams: Number of equally spaced beams, or their angles, deg; None: an eighth of a beam's width apart.
            period: Time between rows, s.
            snapshots: Number of snapshots averaged in one row.
            beamformer: Beamformer of the rows.
            **settings: Other fields of the tracker.
        """
        planar = not is_line(array)
        trial = PlanarPatterns(array, band, beamformer, (0.0,)) if planar else Patterns(array, band)
        width = trial.width
        if beams is None:
            beams = 8 * math.ceil((360.0 if planar else 180.0) / width) + (0 if planar else 1)
            beams = int(np.clip(beams, 61, 1441))
        given = beams if isinstance(beams, int) else tuple(float(angle) for angle in beams)
        q = width / cls.usual_width
        base = cls(
            array=array, band=band, beams=given, period=period, snapshots=snapshots, beamformer=beamformer,
            max_targets=max(1, min(12, array.elements // 2)),
        )  # fmt: skip
        step, beam_width, near = 2.0 * base.spacing / period, base.beam_width, min(0.08 * q, 0.7)
        fields: dict[str, Any] = {
            "acceleration": 0.6 * step / period,
            "bridge": 6.0 * period,
            "misplaced": max(1, round(beam_width / 3.0)),
            "reach": max(2, round(2.0 * beam_width)),
            "shared_beams": max(1.0, 0.8 * beam_width),
            "spread_beams": max(1, round(2.0 * q / base.spacing)),
            "jump": 2.0 * q,
            "spans": SpanRules(mode_width=2.0 * q, bridge_distance=2.0 * q, bridge_growth=0.3 * q),
            "search": SearchRules(
                resolution=min(0.06 * q, 0.5), meeting_distance=near, merge_distance=q, skip_distance=2.0 * q
            ),
            "crossing": CrossingRules(meeting_distance=near, rate_deviation=0.2 * q, bearing_deviation=q),
            "joining": JoiningRules(
                hiding_distance=8.0 * q, distance=2.0 * q, distance_growth=0.3 * q, rate_difference=q / period
            ),
            "fast": FastRules(tolerance=q, margin=2.0 * step),
        }  # fmt: skip
        return replace(base, **{**fields, **settings})

    @cached_property
    def chain(self) -> GridChain:
        """Markov chain on the grid of bearings and rates."""
        # Four steps to each side, at most 2 deg/s, cost little; faster ridges extend the grid.
        most = min(2.0, 8.0 * self.spacing / self.period)
        rates = fitting_rates(self.spacing, self.period, most) if self.rates is None else self.rates
        positions = len(self.grid_bearings)
        return grid_chain(
            positions, rates, self.spacing, self.period, self.acceleration, circular=self.directions.circle
        )

    @cached_property
    def directions(self) -> Directions:
        """Geometry of the bearings."""
        planar = not is_line(self.array)
        return Directions(planar, planar and isinstance(self.beams, int))

    @cached_property
    def spacing(self) -> float:
        """Distance of neighboring positions of the grid, deg."""
        if isinstance(self.beams, int) and not self.directions.circle:
            return 180.0 / (self.beams - 1)
        return float(self.grid_bearings[1] - self.grid_bearings[0])

    @cached_property
    def grid_bearings(self) -> Array:
        """Bearings of the grid, deg: those of equally spaced beams, else four in a beam's width. Shape (positions,)."""
        angles = self.beam_bearings
        steps = np.diff(angles)
        if np.ptp(steps) < 1e-6 * steps.max():
            return angles
        count = math.ceil((angles[-1] - angles[0]) / (0.25 * self.patterns.widths[0])) + 1
        return np.linspace(angles[0], angles[-1], max(count, 3))

    @cached_property
    def beam_width(self) -> float:
        """Width of a beam across the array at half its power, for a flat spectrum, in beams."""
        if self.directions.planar or isinstance(self.beams, int):
            return self.patterns.width / float(np.median(np.diff(self.beam_bearings)))
        # Beside a line the width is constant in the cosine.
        cosines = np.cos(np.radians(self.beam_bearings))
        return 2.0 * math.sin(math.radians(0.5 * self.patterns.width)) / float(np.median(-np.diff(cosines)))

    def on_grid(self, values: Array) -> Array:
        """Interpolate values at the beams to the grid. Shape (T, positions)."""
        if self.grid_bearings is self.beam_bearings:
            return values
        return np.array([np.interp(self.grid_bearings, self.beam_bearings, row) for row in values])

    @property
    def fastest(self) -> float:
        """Largest rate of the grid, deg/s."""
        return float(self.chain.rates[-1])

    def widened(self, fastest: float) -> Self:
        """Return the same model with a grid of rates up to `fastest`, deg/s, and the tables that it has."""
        return self.changed(rates=fitting_rates(self.spacing, self.period, fastest))

    def changed(self, **fields: Any) -> Self:
        """Return the same model with other rates or another number of averages, and the tables that stay."""
        other = replace(self, **fields)
        shared = {"patterns", "beam_bearings", "grid_bearings", "directions", "beam_width", "spacing"}
        shared |= {"scores"} if "noise_averages" not in fields else {"chain"}
        other.__dict__.update({name: self.__dict__[name] for name in shared if name in self.__dict__})
        return other

    @cached_property
    def beam_bearings(self) -> Array:
        """Bearings of the beams, deg. Shape (beams,)."""
        if not isinstance(self.beams, int):
            return np.array(self.beams, np.float64)
        if self.directions.circle:
            return 360.0 / self.beams * np.arange(self.beams, dtype=np.float64)
        return bearings(self.beams)

    @cached_property
    def patterns(self) -> Patterns | PlanarPatterns:
        """Beam patterns of targets."""
        if self.directions.planar:
            angles = tuple(self.beam_bearings.tolist())
            return PlanarPatterns(self.array, self.band, self.beamformer, angles, shared_beams=self.shared_beams)
        return Patterns(self.array, self.band, self.shading, self.beamformer, shared_beams=self.shared_beams)

    @cached_property
    def scores(self) -> RowScores:
        """Matched filter over rows."""
        grid = None if self.grid_bearings is self.beam_bearings else self.grid_bearings
        return RowScores(
            self.patterns,
            self.beam_bearings,
            self.averages,
            self.model_error,
            self.misplaced,
            self.reach,
            grid_bearings=grid,
            circle=self.directions.circle,
        )

    @property
    def averages(self) -> float:
        """Number M of averages in one beam power: frequency bins times snapshots unless `noise_averages` is given."""
        known = self.noise_averages
        return len(self.band.frequencies) * self.snapshots if known is None else known

    @property
    def bridge_rows(self) -> int:
        """Longest gap that does not end a track, rows."""
        return int(self.bridge / self.period + 1e-9)

    @property
    def max_step(self) -> float:
        """Largest plausible change of a bearing between rows, deg; a larger one belongs to another target."""
        return float(np.abs(self.chain.rates).max()) * self.period + self.jump

    def memory(self, records: int, targets: int = 2) -> int:
        """Memory that `track` needs, bytes.

        Args:
            records: Number of rows.
            targets: Number of targets.
        """
        kept = self.chain.states if self.likelihood == "cell" else 0
        beams = len(self.beam_bearings)
        per_target = 3 * beams + kept
        return 8 * records * (2 * self.chain.states + 10 * beams + targets * per_target)
