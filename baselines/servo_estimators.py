"""The estimators and laws behind the servo agents' names, each with the parameters that the benchmark reports.

One setting for all levels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from servotrack.baselines.anchors import FixedJacobian, OracleJacobian
from servotrack.estimators.jacobian import (
    DampedLeastSquares,
    Excitation,
    KalmanJacobian,
    OneStepExact,
    Proportional,
    ProportionalIntegral,
    ServoController,
    Supervisor,
)
from servotrack.estimators.jacobian.lifted import LiftedKalman

ESTIMATORS: Mapping[str, Callable[[], Any]] = {
    "fixed-jacobian": FixedJacobian,
    "kf": KalmanJacobian,
    "lifted-kf": LiftedKalman,
    "oracle": OracleJacobian,
}

LAWS: Mapping[str, Callable[[], Any]] = {
    "proportional": Proportional,
    "pi": ProportionalIntegral,
    "damped": DampedLeastSquares,
    "one-step": OneStepExact,
}

_NO_PROBING = frozenset({"oracle", "informed-bound"})
"""Agents that are told what probing would show."""
_NO_SUPERVISOR = frozenset({"fixed-jacobian"})
"""Agents for which learning anew would defeat their purpose."""


def servo_controller(estimator: str, law: str, max_joint_rate: float) -> ServoController:
    """The controller of an agent.

    Args:
        estimator: A key of `ESTIMATORS`.
        law: A key of `LAWS`.
        max_joint_rate: rad/s.
    """
    return ServoController(
        estimator=ESTIMATORS[estimator](),
        law=LAWS[law](),
        excitation=Excitation(steps=0) if estimator in _NO_PROBING else Excitation(),
        supervisor=None if estimator in _NO_SUPERVISOR else Supervisor(),
        max_joint_rate=max_joint_rate,
    )
