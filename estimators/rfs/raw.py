"""Baseline without memory: every measurement is reported as a target with a new identity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.first_state import state_from_measurement
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.sets import (
    Extraction,
    SetEstimate,
    check_runs,
    estimate_from_extraction,
    read_measurements,
)
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Labels


class RawState(NamedTuple):
    """State of a `RawMeasurements`.

    Attributes:
        next_label: The next new identity. Shape (*batch,).
    """

    next_label: Labels


@dataclass(frozen=True, eq=False)
class RawMeasurements:
    """Reports the raw measurements, each with a new identity.

    Args:
        model: Model of one target; only its measurement part is used.
        hidden_deviation: Standard deviation of unmeasured state entries, in the state's unit; they are reported as 0.
            Raising it only enlarges the reported covariances.
    """

    model: TargetModel
    hidden_deviation: float = 10.0

    def initial(self, measurement: ArrayLike) -> RawState:
        """State before the first measurement; only the measurement's batch axis is read."""
        z, _, single = read_measurements(measurement, self.model.packed.observation.shape[0])
        state = RawState(np.ones(z.shape[0], np.int64))
        return first_row(state) if single else state

    def step(self, state: RawState, measurement: ArrayLike) -> tuple[RawState, SetEstimate]:
        """Report the measurements of one step; shapes and errors as in `GaussianSetFilter.step`."""
        z, number, single = read_measurements(measurement, self.model.packed.observation.shape[0])
        check_runs(state.next_label, z.shape[0], single)
        if single:
            state = add_axis(state)
        used = np.arange(z.shape[1]) < number[:, None]
        mean, covariance = state_from_measurement(self.model, z, self.hidden_deviation)
        label = state.next_label[:, None] + np.arange(z.shape[1])
        expected = number.astype(np.float64)
        extraction = Extraction(number, used.astype(np.float64), label, mean, covariance, used, expected)
        new = RawState(state.next_label + number)
        return (first_row(new) if single else new), estimate_from_extraction(extraction, single)
