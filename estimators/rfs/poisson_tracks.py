"""Base class of the filters that keep an intensity of undetected targets beside Bernoulli tracks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from servotrack.estimators.rfs.bernoulli import Tracks, empty_tracks
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.capacity import tracks_outgrew, undetected_outgrew
from servotrack.estimators.rfs.mixture import Mixture, scratch_mixture
from servotrack.estimators.rfs.pmb_kernel import Prediction, Tally, predict_pmb
from servotrack.estimators.rfs.recursion import GaussianSetFilter, SetFilterState
from servotrack.estimators.types import Array
from servotrack.estimators.validation import check_count


class PoissonTrackState(SetFilterState, Protocol):
    """State of a filter with undetected targets and Bernoulli tracks."""

    @property
    def tracks(self) -> Tracks:
        """Bernoullis of targets detected at least once."""

    @property
    def pool(self) -> Mixture:
        """Components of the Bernoullis."""

    @property
    def undetected(self) -> Mixture:
        """Intensity of undetected targets."""


StateT = TypeVar("StateT", bound=PoissonTrackState)


@dataclass(frozen=True, eq=False)
class PoissonTrackFilter(GaussianSetFilter[StateT]):
    """Base of the Poisson multi-Bernoulli filters; arguments as there."""

    undetected: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.undetected is not None:
            check_count("undetected", self.undetected, 1)

    @property
    def _first_undetected(self) -> int:
        """Components of undetected targets for which the first arrays have room."""
        return 100 if self.undetected is None else self.undetected

    def _fitted(
        self, update: Callable[[int, int], tuple[StateT, Tally]], state: StateT, prediction: Prediction
    ) -> tuple[StateT, Tally]:
        """Update into arrays with room for tracks and undetected components, again while these are too small."""
        tracks, hidden = state.tracks.existence.shape[1], state.undetected.weight.shape[1]
        while True:
            new, tally = update(tracks, hidden)
            more_tracks = tracks_outgrew(self.reduction, new.tracks, new.pool)
            more_hidden = undetected_outgrew(
                self.undetected, self.reduction, prediction.hidden, prediction.hidden_detection, new.undetected
            )
            if not (more_tracks or more_hidden):
                return new, tally
            tracks, hidden = 2 * tracks if more_tracks else tracks, 2 * hidden if more_hidden else hidden

    def _predict(self, state: StateT, presence: Array, births: BirthMixture) -> Prediction:
        """Predict the Bernoullis, of probability `presence` (B, T), and the undetected targets."""
        batch, capacity = state.tracks.existence.shape
        components = state.pool.weight.shape[1]
        n, m = self._sizes
        tracks, pool = empty_tracks(batch, capacity), scratch_mixture(batch, components, n + m)
        hidden = scratch_mixture(batch, self._hidden_room(state, births), n + m)
        survival = self._evaluate("survival", self.survival, state.pool)
        hidden_survival = self._evaluate("survival", self.survival, state.undetected)
        predict_pmb(
            self.model.packed, state, presence, births, self._spawns, survival, hidden_survival, tracks, pool, hidden
        )
        self._attach(pool)
        self._attach(hidden)
        detection = self._evaluate("detection", self.detection, pool)
        return Prediction(tracks, pool, hidden, detection, self._evaluate("detection", self.detection, hidden))

    def _hidden_room(self, state: StateT, births: BirthMixture) -> int:
        """Rows that the predicted undetected targets may take."""
        spawned = len(self.spawn) * state.pool.weight.shape[1]
        return state.undetected.weight.shape[1] + births.weight.shape[1] + spawned
