"""Online estimation of the total image Jacobian (Zhang 2011), and the control laws that use it."""

from servotrack.estimators.jacobian.adaptive import AdaptiveKalmanJacobian
from servotrack.estimators.jacobian.alignment import Alignment
from servotrack.estimators.jacobian.any_arm import AnyArm, chain_bank
from servotrack.estimators.jacobian.bank import EstimatorBank, HypothesisBank, Latencies, Mountings
from servotrack.estimators.jacobian.broyden import BroydenJacobian
from servotrack.estimators.jacobian.cautious import Cautious
from servotrack.estimators.jacobian.chain import ChainJacobian
from servotrack.estimators.jacobian.chain_bank import ChainBank
from servotrack.estimators.jacobian.chain_estimate import ChainEstimate
from servotrack.estimators.jacobian.contract import (
    Increment,
    JacobianEstimator,
    LinearEstimate,
    ServoEstimate,
    ServoMeasurement,
)
from servotrack.estimators.jacobian.controller import ServoController
from servotrack.estimators.jacobian.elbow_law import ElbowLaw
from servotrack.estimators.jacobian.excitation import Excitation
from servotrack.estimators.jacobian.exploration import Exploration
from servotrack.estimators.jacobian.feature_wise import FeatureWise
from servotrack.estimators.jacobian.full_kf import FullKalmanJacobian
from servotrack.estimators.jacobian.informed import Geometry, InformedKalman, InformedMeasurement
from servotrack.estimators.jacobian.joint_limits import JointLimits
from servotrack.estimators.jacobian.joint_space import JointSpace
from servotrack.estimators.jacobian.kf import KalmanJacobian
from servotrack.estimators.jacobian.laws import (
    DampedLeastSquares,
    OneStepExact,
    Proportional,
    ProportionalIntegral,
)
from servotrack.estimators.jacobian.level import LevelKalmanJacobian
from servotrack.estimators.jacobian.lifted import LiftedEstimate, LiftedKalman, TargetModel
from servotrack.estimators.jacobian.parametric import ParametricKalman
from servotrack.estimators.jacobian.pf import ParticleJacobian
from servotrack.estimators.jacobian.prior import JacobianPrior, RandomWalk
from servotrack.estimators.jacobian.progress import ProgressSupervisor
from servotrack.estimators.jacobian.rls import RecursiveLeastSquares
from servotrack.estimators.jacobian.robust import CorrentropyNoise, OutlierModel, StudentTNoise
from servotrack.estimators.jacobian.supervisor import Supervisor
from servotrack.estimators.jacobian.ukf import UnscentedJacobian

__all__ = [
    "AdaptiveKalmanJacobian",
    "Alignment",
    "AnyArm",
    "BroydenJacobian",
    "Cautious",
    "ChainBank",
    "ChainEstimate",
    "ChainJacobian",
    "CorrentropyNoise",
    "DampedLeastSquares",
    "ElbowLaw",
    "EstimatorBank",
    "Excitation",
    "Exploration",
    "FeatureWise",
    "FullKalmanJacobian",
    "Geometry",
    "HypothesisBank",
    "Increment",
    "InformedKalman",
    "InformedMeasurement",
    "JacobianEstimator",
    "JacobianPrior",
    "JointLimits",
    "JointSpace",
    "KalmanJacobian",
    "Latencies",
    "LevelKalmanJacobian",
    "LiftedEstimate",
    "LiftedKalman",
    "LinearEstimate",
    "Mountings",
    "OneStepExact",
    "OutlierModel",
    "ParametricKalman",
    "ParticleJacobian",
    "ProgressSupervisor",
    "Proportional",
    "ProportionalIntegral",
    "RandomWalk",
    "RecursiveLeastSquares",
    "ServoController",
    "ServoEstimate",
    "ServoMeasurement",
    "StudentTNoise",
    "Supervisor",
    "TargetModel",
    "UnscentedJacobian",
    "chain_bank",
]
