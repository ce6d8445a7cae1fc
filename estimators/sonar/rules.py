"""Thresholds of the bearing trackers, grouped by the step that uses them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class PositiveRules:
    """Base of records whose fields are positive numbers."""

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value).all() and np.all(np.asarray(value) > 0)):
                raise ValueError(f"{field.name} must be positive and finite, got {value!r}")


@dataclass(frozen=True)
class LikelihoodRules(PositiveRules):
    """Parameters of the likelihood ratio of a row.

    Attributes:
        amplitude: Smallest of three powers, each twice the one before, that a target of unknown power may have, in
            standard deviations of the noise. Larger values ignore weaker targets.
        miss_probability: Probability that a row does not show a target that is present. Larger values tolerate longer
            gaps and detect later.
        max_log_ratio: Log likelihood ratio to which a row is scaled down, nats. Smaller values keep one row from
            outweighing many.
        cell_amplitude: Power of a target in the likelihood of single cells, in standard deviations of the noise.
        cell_max_penalty: Largest log likelihood ratio of one cell against a target, nats.
    """

    amplitude: float = 1.5
    miss_probability: float = 0.02
    max_log_ratio: float = 40.0
    cell_amplitude: float = 3.0
    cell_max_penalty: float = 3.0

    @property
    def amplitudes(self) -> tuple[float, float, float]:
        """Powers of a target of unknown power, in standard deviations of the noise."""
        return self.amplitude, 2.0 * self.amplitude, 4.0 * self.amplitude


@dataclass(frozen=True)
class SpanRules(PositiveRules):
    """Thresholds that locate a chain's target and decide in which rows it exists.

    Attributes:
        mode_width: Half-width of the window around the mode over which the bearing estimate averages, deg. Larger
            values smooth more and mix neighboring targets.
        margin_rows: Rows before and after a span in which the target may still exist in the next sweep.
        rate_rows: Rows whose mean rate extrapolates a bearing over a gap.
        bridge_distance: Largest distance of a bearing after a gap from the extrapolated one, deg.
        bridge_growth: Increase of that distance per row of the gap, deg. Larger values bridge less plausible gaps.
        trim_share: Share of the mean log likelihood ratio of a span that rows at its ends must reach. Larger values
            cut more rows off.
        trim_limit: Upper limit of that threshold, nats.
    """

    mode_width: float = 2.0
    margin_rows: int = 8
    rate_rows: int = 5
    bridge_distance: float = 2.0
    bridge_growth: float = 0.3
    trim_share: float = 0.3
    trim_limit: float = 1.0


@dataclass(frozen=True)
class SearchRules(PositiveRules):
    """Thresholds of the joint search for chains.

    Attributes:
        min_presence: Presence from which a row is used for a target's power, spectrum and meetings.
        resolution: Difference of the cosines of two bearings below which the array does not resolve the targets.
            The default suits 48 elements.
        meeting_distance: Difference of cosines below which two chains compete for the same power. Larger values solve
            more distant chains together.
        min_spectrum_rows: Rows from which a spectrum is fitted.
        median_rows: Rows to each side whose median is a target's expected power. Larger values follow changes of power
            more slowly.
        negligible: Probability below which states far from an established target are omitted from smoothing.
        max_exchanges: Largest number of exchanges between chains after meetings.
        merge_distance: Distance below which two tracks count as one target if it holds in most rows, deg.
        skip_distance: Half-width of the band around a rejected or already used ridge that the search skips, deg.
        neighbors: Number of chains that are solved again together with a new one. Larger values are slower and
            separate dense targets better.
    """

    min_presence: float = 0.3
    resolution: float = 0.06
    meeting_distance: float = 0.08
    min_spectrum_rows: int = 5
    median_rows: int = 20
    negligible: float = 1e-25
    max_exchanges: int = 12
    merge_distance: float = 1.0
    skip_distance: float = 2.0
    neighbors: int = 2


@dataclass(frozen=True)
class CrossingRules(PositiveRules):
    """Thresholds of the test for exchanged identities at a crossing.

    Attributes:
        min_presence: Presence from which a row of a chain is used.
        meeting_distance: Difference of the cosines of two bearings below which two targets meet.
        pause_rows: Rows of larger distance that do not end a meeting.
        side_rows: Rows before and after a meeting that are compared.
        min_rows: Rows from which a side is judged.
        rate_deviation: Standard deviation of a target's change of rate over a meeting, deg per row.
        bearing_deviation: Standard deviation of a target's extrapolated bearing in the middle of a meeting, deg.
        log_power_deviation: Standard deviation of the change of a target's log power over a meeting.
        pattern_deviation: Root mean square change of a target's beam pattern over a meeting.
        pattern_limit: Cost difference from which an exchange is rejected without comparing patterns, nats.
        min_power: Lower limit of a power before its logarithm is taken.
        pattern_variance: Variance of beam powers, relative to their squared mean, in the comparison of patterns.
        min_gain: Cost difference from which an exchange is accepted, nats. Larger values exchange less often.
    """

    min_presence: float = 0.3
    meeting_distance: float = 0.08
    pause_rows: int = 3
    side_rows: int = 10
    min_rows: int = 3
    rate_deviation: float = 0.2
    bearing_deviation: float = 1.0
    log_power_deviation: float = 0.3
    pattern_deviation: float = 0.15
    pattern_limit: float = 30.0
    min_power: float = 1e-3
    pattern_variance: float = 1e-3
    min_gain: float = 1.0


@dataclass(frozen=True)
class JoiningRules(PositiveRules):
    """Thresholds that join two parts of one target's track.

    Attributes:
        overlap_rows: Rows that two parts may have in common.
        rate_rows: Rows whose mean rate extrapolates a part.
        max_gap_rows: Largest step between two parts, also behind another track, rows.
        direct_gap_rows: Rows that may be missing if one part leads straight to the other.
        direct_misfit: Misfit, relative to the allowed one, below which a part leads straight to the other.
        hiding_distance: Distance within which one target may hide another one, deg.
        distance: Largest distance of the extrapolated part from the next one, deg.
        distance_growth: Increase of that distance per row of the gap, deg.
        growth_rows: Rows up to which that distance grows.
        rate_difference: Largest difference of the rates of two parts, deg/s.
    """

    overlap_rows: int = 10
    rate_rows: int = 5
    max_gap_rows: int = 60
    direct_gap_rows: int = 20
    direct_misfit: float = 0.5
    hiding_distance: float = 8.0
    distance: float = 2.0
    distance_growth: float = 0.3
    growth_rows: int = 15
    rate_difference: float = 1.0


@dataclass(frozen=True)
class BackgroundRules(PositiveRules):
    """Parameters of the background of a row and of its noise level.

    Attributes:
        rows: Rows before and after one whose median it is compared with. Larger values bridge longer transients.
        breadth: Width of the running median over bearing that finds lifted rows, beam widths. A lift must cover half of
            it; larger values take fewer groups of targets for a lift.
        beam_widths: Width of the running median over bearing that is the background of a lifted row, beam widths.
        tolerance: Relative deviation of the background from 1 from which a row counts as lifted by a transient.
        unlifted: Quantile of the background over bearing that is taken for the noise without the transient.
        side_rows: Rows before or after one from which that side is compared.
        min_rows: Rows from which a background is estimated.
        max_log_ratio: Log likelihood ratio to which a lifted row is scaled down, nats. Larger values trust it more.
        level_tolerance: Relative error of the noise level beside targets from which all rows are normalized again.
        max_levels: Largest number of new normalizations.
    """

    rows: int = 4
    breadth: int = 21
    beam_widths: int = 7
    tolerance: float = 0.4
    unlifted: float = 0.1
    side_rows: int = 2
    min_rows: int = 5
    max_log_ratio: float = 4.0
    level_tolerance: float = 0.15
    max_levels: int = 3


@dataclass(frozen=True)
class FastRules(PositiveRules):
    """Thresholds of the search for ridges that are faster than the grid of rates.

    Attributes:
        half_rows: Rows before and after the middle of a line. Larger values need a fast target for longer.
        height: Smallest height and prominence of a peak, in standard deviations of the noise.
        tolerance: Largest distance of a peak from a line, deg.
        min_hits: Number of rows of a line that must have a peak. Larger values miss weaker targets.
        min_gain: Number of rows by which a line must exceed all lines at slower rates.
        margin: Rate added to the fastest one that was found, deg/s.
    """

    half_rows: int = 5
    height: float = 4.0
    tolerance: float = 1.0
    min_hits: int = 10
    min_gain: int = 4
    margin: float = 1.0
