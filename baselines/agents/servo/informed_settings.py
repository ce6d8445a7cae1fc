"""Filters of the informed servo: motion models that fit the law of the target in its world.

The numbers are from random searches on tune seeds, levels 1, 3 (ellipses), 4, 5 (two sines) and 6 (waypoints).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.estimators.jacobian.informed import InformedKalman
from servotrack.estimators.jacobian.lifted import LiftedKalman, TargetModel

_ABRUPT = TargetModel(jerk=100.0, jump=500.0, damping=10.0)
"""Start of a target that rested during the warm-up."""


def _swings(rates: np.ndarray, jerk: float) -> tuple[TargetModel, ...]:
    return tuple(TargetModel(jerk=jerk, recall=float(rate) ** 2) for rate in rates)


def _known(models: tuple[TargetModel, ...], **values: float) -> InformedKalman:
    # The geometry is known, so nothing of it drifts.
    known = LiftedKalman(models=models, drift=0.0, optics_error=0.0)
    return InformedKalman(with_values(known, values))


_REST = _known(
    (TargetModel(jerk=0.1, jump=0.1, damping=10.0),), velocity_spread=0.1, acceleration_spread=0.1, outlier_rate=0.05
)
FILTERS: Mapping[str, InformedKalman] = {
    "paper": _known(
        (TargetModel(jerk=0.1, recall=1.0), _ABRUPT),
        model_stay=0.999,
        velocity_spread=300.0,
        acceleration_spread=600.0,
    ),
    "paper_point": _REST,
    "point": _REST,
    "ellipse": _known(
        (*_swings(np.linspace(0.5, 1.5, 33), 1.0), _ABRUPT),
        model_stay=0.995,
        velocity_spread=300.0,
        acceleration_spread=600.0,
    ),
    "two_sine": _known(
        (*_swings(np.geomspace(0.3, 1.5, 5), 30.0), TargetModel(jerk=60.0)),
        noise_stay=0.999,
        encoder_noise=0.003,
        outlier_rate=0.001,
    ),
    "waypoints": _known(
        tuple(TargetModel(jerk=2.5, jump=jump, damping=10.0) for jump in (2.0, 400.0)),
        model_stay=0.99,
        noise_stay=0.9925,
        encoder_noise=0.0016,
        optics_error=0.025,
        outlier_rate=0.0075,
    ),
}
"""Filters by the target's motion, `ServoConfig.target`."""
