"""A PMB that adapts: sensor parameters estimated online, motion modes, and births at sites and anywhere.

The recursion is that of `PMB` (Williams 2015). Beside it run a Beta density of the detection probability and a Gamma
density of the clutter rate (`SensorAdaptation`), and every component of a track holds one Gaussian per motion mode,
mixed before the prediction (Blom and Bar-Shalom 1988). What the caller states about sensor and motion is the start, not
the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.rfs.adaptation import SensorAdaptation, SensorState
from servotrack.estimators.rfs.bernoulli import Tracks, empty_tracks
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.extraction import RULES, extract_tracks
from servotrack.estimators.rfs.interacting import InteractingModels
from servotrack.estimators.rfs.interacting_kernel import PackedModes, collapse_modes
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture, scratch_mixture
from servotrack.estimators.rfs.pmb import PMBState
from servotrack.estimators.rfs.pmb_kernel import Prediction, Tally, empty_tally, predict_adaptive, update_pmb
from servotrack.estimators.rfs.poisson_tracks import PoissonTrackFilter
from servotrack.estimators.rfs.recursion import check_positive_definite, checked_values
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sensors import Sensor
from servotrack.estimators.rfs.sets import Extraction, Scan, empty_extraction
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import LARGEST_NUMBER, SMALLEST_NUMBER, checked_number


class RobustPMBState(NamedTuple):
    """State of a `RobustPMB`.

    Attributes:
        tracks: Tracks of targets detected at least once.
        pool: Components of the tracks, a row per motion mode each.
        undetected: Intensity of targets never detected, which move by the first mode.
        births: Births of the next step if they depend on the measurements, else empty.
        next_label: The next new identity. Shape (*batch,).
        sensor: Densities of the detection probability and of the clutter rate.
    """

    tracks: Tracks
    pool: Mixture
    undetected: Mixture
    births: BirthMixture
    next_label: Labels
    sensor: SensorState


@dataclass(frozen=True, eq=False)
class RobustPMB(PoissonTrackFilter[RobustPMBState]):
    """Poisson multi-Bernoulli filter that estimates its sensor and follows maneuvers; see `GaussianSetFilter`.

        scene = 20 / 4000.0**2  # clutter per m^2
        births = Births(Birth(0.03, places, covariance), MeasurementBirth(0.02, largest=0.02))
        tracker = RobustPMB(model, births, clutter_intensity=scene, volume=4000.0**2, modes=maneuvers(model))

    `detection`, `clutter_intensity` and the `expected` births at measurements are where the estimates start. The first
    two must be numbers; `state.sensor` has the current ones.

    Args:
        undetected: Largest number of components of the intensity of undetected targets; see `PMB`.
        volume: Volume of the sensor's field of view in measurement space, over which clutter is uniform, so that
            `clutter_intensity * volume` is the expected number of false measurements of a scan.
        clutter_density: Density of clutter relative to its mean over the volume, a function of measurements (Z, m)
            that returns (Z,); None: uniform. The rate is estimated, this shape is kept.
        modes: Motion modes of detected targets; None: `model` alone.
        adaptation: Parameters of the online estimate; None keeps `detection`, `clutter_intensity` and births as
            they are.
        learning: False uses the stated `detection` and `clutter_intensity` and holds the estimates, as for the scans of
            another sensor.

    Raises:
        ValueError: An argument is out of range, or the modes do not fit the model.
    """

    volume: float = field(kw_only=True)
    clutter_density: Callable[[Array], Array] | None = field(default=None, kw_only=True)
    modes: InteractingModels | None = field(default=None, kw_only=True)
    adaptation: SensorAdaptation | None = field(default_factory=SensorAdaptation, kw_only=True)
    learning: bool = field(default=True, kw_only=True)
    reduction: Reduction = field(default_factory=lambda: Reduction(components=5))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("detection", "clutter_intensity"):
            if callable(getattr(self, name)):
                raise ValueError(f"{name} must be a number in an adaptive filter, got a function; use PMB")
        if self.clutter_density is not None and not callable(self.clutter_density):
            raise ValueError(f"clutter_density must be a function or None, got {self.clutter_density!r}")
        checked_number("volume", self.volume, SMALLEST_NUMBER, LARGEST_NUMBER, "finite and > 0")
        if self.adaptation is not None and not isinstance(self.adaptation, SensorAdaptation):
            raise ValueError(f"adaptation must be a SensorAdaptation or None, got {type(self.adaptation).__name__}")
        if self.modes is not None:
            for name in ("kind", "pairwise", "observation", "measurement_noise", "sensor", "angular"):
                if not np.array_equal(getattr(self.model.packed, name), getattr(self.modes.models[0].packed, name)):
                    raise ValueError(f"modes must have the measurement of model, they differ in {name}")

    def _sensor_changes(self, sensor: Sensor) -> dict[str, Any]:
        changes = super()._sensor_changes(sensor)
        if self.adaptation is not None:
            missing = [name for name in ("detection", "clutter_intensity") if getattr(sensor, name) is None]
            if missing:
                raise ValueError(
                    f"sensor must state its {' and '.join(missing)} in a filter that estimates those of its own "
                    "sensor, got None"
                )
            changes["learning"] = False
        changes["clutter_density"] = None
        return changes if self.modes is None else {**changes, "modes": self.modes.at(None, sensor)}

    def _interval_changes(self, dt: float) -> dict[str, Any]:
        changes = super()._interval_changes(dt)
        return changes if self.modes is None else {**changes, "modes": self.modes.at(dt)}

    @cached_property
    def _stated_detection(self) -> float:
        return float(np.asarray(self.detection))

    @cached_property
    def _stated_clutter(self) -> float:
        return float(np.asarray(self.clutter_intensity)) * self.volume

    @cached_property
    def _stated_births(self) -> float:
        return 0.0 if self._anywhere is None else self._anywhere.expected

    @cached_property
    def _modes(self) -> PackedModes:
        modes = InteractingModels((self.model,), np.ones((1, 1))) if self.modes is None else self.modes
        return modes.packed

    def _empty(self, batch: int, capacity: int | None = None, hidden: int | None = None) -> RobustPMBState:
        rules, N = self.reduction, sum(self._sizes)
        capacity = capacity or rules.first_tracks
        adaptation = self.adaptation or SensorAdaptation()
        return RobustPMBState(
            empty_tracks(batch, capacity),
            empty_mixture(batch, rules.pool_rows(capacity) * len(self._modes.initial), N),
            empty_mixture(batch, hidden or self._first_undetected, N),
            self._no_births(batch),
            np.ones(batch, np.int64),
            adaptation.initial(batch, capacity, self._stated_detection, self._stated_clutter, self._stated_births),
        )

    def _advance(
        self, state: RobustPMBState, births: BirthMixture, scan: Scan
    ) -> tuple[RobustPMBState, Extraction, Array]:
        batch, n = len(scan.number), self._sizes[0]
        detection = np.full(batch, self._stated_detection)
        if self.adaptation is not None and self.learning:
            detection = self.adaptation.detection(state.sensor)
            intensity = self.adaptation.clutter_rate(state.sensor) / self.volume
            scan = scan._replace(clutter=np.repeat(intensity[:, None], scan.clutter.shape[1], axis=1))
        if self.clutter_density is not None:
            scan = scan._replace(clutter=scan.clutter * self.relative_clutter(scan.measurements, scan.number))
        births = self.adapted_births(births, state.sensor)
        prediction = self._predict_modes(state, births, detection)
        new, tally = self._fitted(
            lambda capacity, hidden: self._updated(state, prediction, scan, capacity, hidden), state, prediction
        )
        extraction = empty_extraction(batch, new.tracks.existence.shape[1], n)
        tracks, pool = self._collapsed(new)
        extract_tracks(n, tracks, pool, new.next_label, RULES[self.extraction], self.threshold, extraction)
        if self.adaptation is not None:
            before, predicted = state.tracks.existence, prediction.tracks.existence
            after = new.tracks.existence
            sensor = self.adaptation.step(state.sensor, before, predicted, after, tally, self.learning)
            new = new._replace(sensor=sensor)
        expected = extraction.expected + new.undetected.weight.sum(axis=1)
        return new, extraction._replace(expected=expected), tally.unexplained

    def relative_clutter(self, measurements: Array, number: Labels) -> Array:
        """Values of `clutter_density` at the first `number` of the measurements (B, Z, m), else 1. Shape (B, Z)."""
        relative = np.ones(measurements.shape[:2])
        if self.clutter_density is not None:
            used = np.arange(measurements.shape[1]) < number[:, None]
            values = self.clutter_density(measurements[used])
            relative[used] = checked_values("clutter_density", values, int(used.sum()), np.inf)
        return relative

    def adapted_births(self, births: BirthMixture, sensor: SensorState) -> BirthMixture:
        """Births with the estimated rate of those at measurements.

        Args:
            births: Births of the coming step, those at sites first.
            sensor: Estimates of the runs, `state.sensor` with a batch axis.
        """
        if self.adaptation is None or self._stated_births == 0.0:
            return births
        factor = np.clip(sensor.birth_rate / self._stated_births, *self.adaptation.birth_limits)
        weight = births.weight.copy()
        first = self._known_births(births)
        weight[:, first:] = np.minimum(weight[:, first:] * factor[:, None], 1.0)
        return births._replace(weight=weight)

    def _known_births(self, births: BirthMixture) -> int:
        """Number of births at known places, which come first."""
        rows = births.weight.shape[1]
        return rows if self._anywhere is None else min(rows, 0 if self._sites is None else len(self._sites.weights))

    def _updated(
        self, state: RobustPMBState, prediction: Prediction, scan: Scan, capacity: int, hidden: int
    ) -> tuple[RobustPMBState, Tally]:
        """Update into arrays with room for `capacity` tracks and `hidden` components of undetected targets."""
        empty = self._empty(len(scan.number), capacity, hidden)
        new = empty._replace(births=state.births, next_label=state.next_label.copy())
        tally = empty_tally(scan, state.tracks, new.tracks)
        limits, initial, target = self.reduction.limits, self._modes.initial, PMBState(*new[:5])
        check_positive_definite(
            update_pmb(self.model.packed, prediction, scan, self._gate, limits, initial, target, tally)
        )
        return new, tally

    def _predict_modes(self, state: RobustPMBState, births: BirthMixture, detection: Array) -> Prediction:
        """Predict the tracks mode by mode, and the undetected targets; `detection` has one value per run."""
        batch, capacity = state.tracks.existence.shape
        components, N = state.pool.weight.shape[1], sum(self._sizes)
        tracks, pool = empty_tracks(batch, capacity), scratch_mixture(batch, components, N)
        hidden = scratch_mixture(batch, self._hidden_room(state, births), N)
        survival = self._evaluate("survival", self.survival, state.pool)
        hidden_survival = self._evaluate("survival", self.survival, state.undetected)
        predict_adaptive(
            self.model.packed,
            self._modes,
            PMBState(*state[:5]),
            births,
            self._known_births(births),
            self._spawns,
            survival,
            hidden_survival,
            tracks,
            pool,
            hidden,
        )
        self._attach(pool)
        self._attach(hidden)
        found = self._evaluate("detection", detection, pool)
        return Prediction(tracks, pool, hidden, found, self._evaluate("detection", detection, hidden))

    def _collapsed(self, state: RobustPMBState) -> tuple[Tracks, Mixture]:
        """Tracks with one Gaussian per component, for the extraction; identities are those of the state."""
        S = len(self._modes.initial)
        if S == 1:
            return state.tracks, state.pool
        batch, rows = state.pool.weight.shape
        tracks = empty_tracks(*state.tracks.existence.shape)._replace(label=state.tracks.label)
        pool = scratch_mixture(batch, rows // S, sum(self._sizes))
        collapse_modes(self._sizes[0], S, state.tracks, state.pool, tracks, pool)
        return tracks, pool
