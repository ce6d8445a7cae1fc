"""Online estimation of the total image Jacobian (paper 002), and the control laws that use it."""

from servotrack.estimators.jacobian.alignment import Alignment
from servotrack.estimators.jacobian.contract import (
    Increment,
    JacobianEstimator,
    LinearEstimate,
    ServoEstimate,
    ServoMeasurement,
)
from servotrack.estimators.jacobian.controller import ServoController
from servotrack.estimators.jacobian.excitation import Excitation
from servotrack.estimators.jacobian.kf import KalmanJacobian
from servotrack.estimators.jacobian.laws import (
    DampedLeastSquares,
    OneStepExact,
    Proportional,
    ProportionalIntegral,
)
from servotrack.estimators.jacobian.prior import JacobianPrior, RandomWalk
from servotrack.estimators.jacobian.supervisor import Supervisor

__all__ = [
    "Alignment",
    "DampedLeastSquares",
    "Excitation",
    "Increment",
    "JacobianEstimator",
    "JacobianPrior",
    "KalmanJacobian",
    "LinearEstimate",
    "OneStepExact",
    "Proportional",
    "ProportionalIntegral",
    "RandomWalk",
    "ServoController",
    "ServoEstimate",
    "ServoMeasurement",
    "Supervisor",
]
