"""Trajectory Poisson multi-Bernoulli filter with a fixed smoothing lag (Garcia-Fernandez et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np

from servotrack.estimators.rfs.bernoulli import Tracks, empty_tracks
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.extraction import RULES, extract_tracks
from servotrack.estimators.rfs.histories import (
    History,
    Lineage,
    add_maneuver_noise,
    empty_history,
    predict_histories,
    split_components,
)
from servotrack.estimators.rfs.interacting_kernel import ONE_MODE
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture
from servotrack.estimators.rfs.models import MovingModel
from servotrack.estimators.rfs.pmb import PMBState
from servotrack.estimators.rfs.pmb_kernel import Prediction, Tally, empty_tally, update_pmb
from servotrack.estimators.rfs.poisson_tracks import PoissonTrackFilter
from servotrack.estimators.rfs.recursion import check_positive_definite
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import (
    Extraction,
    Scan,
    SetEstimate,
    empty_extraction,
    estimate_from_extraction,
)
from servotrack.estimators.rfs.trajectory_tables import (
    Trajectories,
    advance_trajectories,
    empty_trajectories,
    smoothed_tracks,
)
from servotrack.estimators.stateful import add_axis
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import LARGEST_NUMBER, check_count, checked_number


class TrajectoryPMBState(NamedTuple):
    """State of a `TrajectoryPMB`; the first five entries are those of a `PMB`.

    Attributes:
        tracks: Tracks of targets detected at least once.
        pool: Components of the tracks.
        undetected: Intensity of targets never detected.
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
        past: Past states of the components of the tracks.
        hidden_past: Past states of the components of undetected targets.
        trajectories: Smoothed existence and states by identity, those of ended targets included.
    """

    tracks: Tracks
    pool: Mixture
    undetected: Mixture
    births: BirthMixture
    next_label: Labels
    past: History
    hidden_past: History
    trajectories: Trajectories


@dataclass(frozen=True, eq=False)
class TrajectoryPMB(PoissonTrackFilter[TrajectoryPMBState]):
    """PMB that reports smoothed targets some scans late; further arguments as in `PMB` and `GaussianSetFilter`.

    `step` returns the estimate for the scan `lag` before the newest one; the first `lag` estimates are empty, and
    `flush` returns those of the last `lag` scans. Its data association is that of `PMB`. Each component keeps its
    past states, and each track the probability that its target existed at past scans: targets start before their first
    detection and end where they disappeared, which no filter without delay can know.

    Args:
        lag: Smoothing lag L, scans. Raising it smooths more, at a time and memory that grow with it; beyond 10 there is
            little to gain.
        least_length: Identities that have ended and existed for fewer scans are withheld. Raising it removes false
            targets, and those that were detected only a few times.
        maneuver: Probability that a target maneuvers in one period: its process noise is then `agility` times as large,
            whatever it was before. Raising it keeps the identities of targets that turn or stop suddenly, at twice the
            time per step; 0 has one noise. Hidden Markov models only.
        agility: Factor on the standard deviation of the process noise in a maneuver, at least 1.

    References:
        Garcia-Fernandez, Svensson, Williams, Xia and Granstrom, "Trajectory Poisson multi-Bernoulli filters", IEEE
        Transactions on Signal Processing 68, 2020.
    """

    reduction: Reduction = field(default_factory=lambda: Reduction(components=5))
    lag: int = 5
    least_length: int = 2
    maneuver: float = 0.0
    agility: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("lag", self.lag, 0)
        check_count("least_length", self.least_length, 0)
        checked_number("maneuver", self.maneuver, 0.0, 1.0, "in [0, 1]")
        checked_number("agility", self.agility, 1.0, LARGEST_NUMBER, "finite and at least 1")
        if self.maneuver > 0.0 and self.model.packed.pairwise:
            raise ValueError(
                f"maneuver must be 0 under a pairwise Markov model, whose noise is one with its measurements, got "
                f"{self.maneuver!r}; use its hidden Markov model"
            )

    def flush(self, state: TrajectoryPMBState) -> list[SetEstimate]:
        """Return the estimates of the last `lag` scans, the oldest first; the state does not change."""
        single = np.ndim(state.next_label) == 0
        whole: TrajectoryPMBState = add_axis(state) if single else state
        return [estimate_from_extraction(self._smoothed(whole, past), single) for past in range(self.lag - 1, -1, -1)]

    def _empty(self, batch: int, capacity: int | None = None, hidden: int | None = None) -> TrajectoryPMBState:
        rules, (n, m) = self.reduction, self._sizes
        capacity, hidden = capacity or rules.first_tracks, hidden or self._first_undetected
        rows = rules.pool_rows(capacity)
        return TrajectoryPMBState(
            empty_tracks(batch, capacity),
            empty_mixture(batch, rows, n + m),
            empty_mixture(batch, hidden, n + m),
            self._no_births(batch),
            np.ones(batch, np.int64),
            empty_history(batch, rows, self.lag, n, n + m),
            empty_history(batch, hidden, self.lag, n, n + m),
            empty_trajectories(batch, 2 * capacity, self.lag, n),
        )

    def _advance(
        self, state: TrajectoryPMBState, births: BirthMixture, scan: Scan
    ) -> tuple[TrajectoryPMBState, Extraction, Array]:
        model, batch = self.model.packed, len(scan.number)
        n, m = self._sizes
        split = self.maneuver > 0.0 and self.model.period > 0.0
        before = self._split(state) if split else state
        prediction = self._predict(before, state.tracks.existence, births)
        if split:
            add_maneuver_noise(model, self._maneuver_noise, prediction.pool)
            self._attach(prediction.pool)
        past = empty_history(batch, prediction.pool.weight.shape[1], self.lag, n, n + m)
        hidden_past = empty_history(batch, prediction.hidden.weight.shape[1], self.lag, n, n + m)
        shift, start = int(self.model.period > 0.0), np.zeros(batch, np.int64)
        predict_histories(model, before.pool, before.past, prediction.pool, shift, start, past)
        predict_histories(model, state.undetected, state.hidden_past, prediction.hidden, shift, start, hidden_past)
        if self._anywhere is not None and shift:
            # A target that is born at a measurement was there when it was measured.
            born = _as_mixture(state.births)
            fresh = empty_history(batch, born.weight.shape[1], self.lag, n, n)
            start = prediction.hidden.number - born.number
            predict_histories(model, born, fresh, prediction.hidden, shift, start, hidden_past)
        absent = np.zeros(state.tracks.existence.shape)
        histories = past, hidden_past, absent
        new, tally = self._fitted(
            lambda tracks, hidden: self._updated(state, prediction, scan, (tracks, hidden), *histories),
            state,
            prediction,
        )
        survival = self._evaluate("survival", self.survival, state.pool)
        hidden_survival = self._evaluate("survival", self.survival, state.undetected)
        advance_trajectories(state, survival, hidden_survival, absent, self.threshold, shift, new)
        return new, self._smoothed(new, self.lag), tally.unexplained

    @cached_property
    def _maneuver_noise(self) -> Array:
        """Process noise of a maneuver in excess of the usual one. Shape (n, n)."""
        return (self.agility**2 - 1.0) * cast(MovingModel, self.model).process_noise

    def _interval_changes(self, dt: float) -> dict[str, Any]:
        changes = super()._interval_changes(dt)
        if self.maneuver > 0.0:
            changes["maneuver"] = 1.0 - (1.0 - self.maneuver) ** (dt / self.model.period)
        return changes

    def _split(self, state: TrajectoryPMBState) -> TrajectoryPMBState:
        """State with two components for each one of the tracks: without a maneuver, and with one."""
        batch, rows = state.pool.weight.shape
        n, m = self._sizes
        tracks = state.tracks._replace(size=2 * state.tracks.size)
        pool, past = empty_mixture(batch, 2 * rows, n + m), empty_history(batch, 2 * rows, self.lag, n, n + m)
        split_components(state.pool, state.past, self.maneuver, pool, past)
        return state._replace(tracks=tracks, pool=pool, past=past)

    def _updated(
        self,
        state: TrajectoryPMBState,
        prediction: Prediction,
        scan: Scan,
        room: tuple[int, int],
        past: History,
        hidden_past: History,
        absent: Array,
    ) -> tuple[TrajectoryPMBState, Tally]:
        """Update into arrays with `room` for tracks and components of undetected targets; `absent` is written."""
        empty = self._empty(len(scan.number), *room)
        new = empty._replace(births=state.births, next_label=state.next_label.copy())
        tally = empty_tally(scan, state.tracks, new.tracks)
        lineage = Lineage(past, hidden_past, new.past, new.hidden_past, absent)
        limits, target = self.reduction.limits, PMBState(*new[:5])
        check_positive_definite(
            update_pmb(self.model.packed, prediction, scan, self._gate, limits, ONE_MODE, target, tally, lineage)
        )
        return new, tally

    def _smoothed(self, state: TrajectoryPMBState, past: int) -> Extraction:
        """Extract the targets of the scan `past` before the newest one."""
        n, m = self._sizes
        batch, rows = state.trajectories.label.shape
        tracks, mixture = empty_tracks(batch, rows), empty_mixture(batch, rows, n + m)
        expected = smoothed_tracks(state.trajectories, past, self.threshold, self.least_length, tracks, mixture)
        extraction = empty_extraction(batch, rows, n)
        extract_tracks(n, tracks, mixture, state.next_label, RULES[self.extraction], self.threshold, extraction)
        return extraction._replace(expected=expected)


def _as_mixture(births: BirthMixture) -> Mixture:
    """Births of positive weight as components whose measurement is known, in their order."""
    active = births.weight > 0.0
    order = np.argsort(~active, axis=1, kind="stable")
    return Mixture(
        active.sum(axis=1),
        np.take_along_axis(births.weight, order, axis=1),
        np.take_along_axis(births.mean, order[:, :, None], axis=1),
        np.take_along_axis(births.covariance, order[:, :, None, None], axis=1),
        np.ones(active.shape, np.bool_),
        np.zeros(active.shape, np.int64),
    )
