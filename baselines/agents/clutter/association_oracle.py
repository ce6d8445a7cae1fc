"""Upper anchor of the clutter world: known data association and existence, one Kalman filter per target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.first_state import state_from_measurement
from servotrack.estimators.rfs.gaussians import condition_gaussian, detected_mean, predict_gaussian
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Labels


class OracleState(NamedTuple):
    """State of the filters: N scenes, T targets, a joint Gaussian over state and measurement each.

    Attributes:
        mean: Shape (N, T, n + m).
        covariance: Shape (N, T, n + m, n + m).
        phase: 0 before the first detection, 1 after a missed one, 2 after a detection. Shape (N, T), int.
    """

    mean: Array
    covariance: Array
    phase: Labels


@dataclass(frozen=True, eq=False)
class AssociationOracle:
    """A Kalman filter per target on its own measurements; privileged.

    A target is reported from its first detection until it vanishes.

    Args:
        model: Motion and measurement of one target.
        birth_covariance: Initial covariance of a target. Unmeasured entries (velocities) start at zero. Shape (n, n).
    """

    model: TargetModel
    birth_covariance: Array

    def initial(self, measurement: Mapping[str, Array]) -> OracleState:
        """Return the state before the first scan; only the shapes of the measurement are read."""
        m, n = self.model.packed.observation.shape
        scenes, targets = measurement["true_existence"].shape
        return OracleState(
            np.zeros((scenes, targets, n + m)),
            np.zeros((scenes, targets, n + m, n + m)),
            np.zeros((scenes, targets), np.int64),
        )

    def step(
        self, state: OracleState, measurement: Mapping[str, Array], dt: float | None = None
    ) -> tuple[OracleState, SetEstimate]:
        """Process a scan.

        Args:
            state: Result of `initial` or of the last `step`.
            measurement: Entries `observation` (N, M, 1 + m), `true_source` (N, M) and `true_existence` (N, T) of a
                `PrivilegedObservation`.
            dt: Time since the last step, s; None: the model's period.
        """
        if dt is not None:
            return replace(self, model=self.model.at(dt)).step(state, measurement)
        scan = np.ascontiguousarray(measurement[OBSERVATION_KEY][..., 1:])
        source = measurement["true_source"].astype(np.int64)
        exists = measurement["true_existence"] > 0.5
        deviation = np.sqrt(np.diag(self.birth_covariance))
        start, start_covariance = state_from_measurement(self.model, scan, deviation)
        mean, covariance = state.mean.copy(), state.covariance.copy()
        phase = np.where(exists, state.phase, 0)
        start_covariance = np.ascontiguousarray(
            np.broadcast_to(start_covariance, (*scan.shape[:2], *start_covariance.shape[-2:]))
        )
        _filter(self.model.packed, scan, source, start, start_covariance, mean, covariance, phase)
        n = start.shape[-1]
        known = phase > 0
        labels = np.where(known, np.arange(phase.shape[1]) + 1, 0)
        nothing: Any = np.zeros((len(scan), 0))
        estimate = SetEstimate(
            states=np.where(known[..., None], mean[..., :n], 0.0),
            labels=labels,
            existence=known.astype(np.float64),
            covariances=covariance[..., :n, :n],
            expected_number=known.sum(axis=1).astype(np.float64),
            held_labels=nothing.astype(np.int64),
            held_states=np.zeros((len(scan), 0, n)),
            held_existence=nothing,
        )
        return OracleState(mean, covariance, phase), estimate


@njit(cache=True, nogil=True)
def _filter(model, scan, source, start, start_covariance, mean, covariance, phase):  # type: ignore[no-untyped-def]
    """Predict every known target and update it with its own measurement, in place."""
    m, n = model.observation.shape
    size = n + m
    work, root, gain = np.empty((size, size)), np.empty((m, m)), np.empty((n, m))
    posterior, innovation = np.empty((n, n)), np.empty(m)
    next_mean, next_covariance = np.zeros(size), np.zeros((size, size))
    for scene in range(mean.shape[0]):
        for target in range(mean.shape[1]):
            if phase[scene, target] > 0:
                predict_gaussian(
                    model,
                    mean[scene, target],
                    covariance[scene, target],
                    phase[scene, target] == 2,
                    work,
                    next_mean,
                    next_covariance,
                )
                mean[scene, target] = next_mean
                covariance[scene, target] = next_covariance
                phase[scene, target] = 1
        for row in range(scan.shape[1]):
            target = source[scene, row]
            if target < 0:
                continue
            own_mean, own_covariance = mean[scene, target], covariance[scene, target]
            if phase[scene, target] == 0:
                own_mean[:n] = start[scene, row]
                own_covariance[:] = 0.0
                own_covariance[:n, :n] = start_covariance[scene, row]
                own_mean[n:] = scan[scene, row]
            else:
                condition_gaussian(model, own_covariance, root, gain, posterior)
                next_mean[:] = own_mean
                detected_mean(model, next_mean, gain, scan[scene, row], innovation, own_mean)
                own_covariance[:] = 0.0
                own_covariance[:n, :n] = posterior
            phase[scene, target] = 2
