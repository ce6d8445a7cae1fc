"""Servo agents by name: their estimators and control laws, one setting for all levels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, cast

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.servo.anchors import FixedJacobian, OracleJacobian
from servotrack.baselines.agents.servo.informed_settings import FILTERS
from servotrack.baselines.agents.servo.jacobian_servo import OBSERVATION_KEYS, JacobianServo
from servotrack.baselines.agents.servo.pixel_servo import PIXEL_KEYS, PixelServo
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.jacobian import (
    BroydenJacobian,
    CorrentropyNoise,
    DampedLeastSquares,
    ElbowLaw,
    Excitation,
    KalmanJacobian,
    LevelKalmanJacobian,
    OneStepExact,
    ParticleJacobian,
    Proportional,
    ProportionalIntegral,
    RandomWalk,
    RecursiveLeastSquares,
    ServoController,
    StudentTNoise,
    Supervisor,
    UnscentedJacobian,
)
from servotrack.estimators.jacobian.bank import HypothesisBank, Latencies, Mountings
from servotrack.estimators.jacobian.contract import JacobianEstimator
from servotrack.estimators.jacobian.informed import InformedKalman
from servotrack.estimators.jacobian.laws import ControlLaw
from servotrack.estimators.jacobian.lifted import AGILE_MODELS, SWINGING_MODELS, LiftedKalman
from servotrack.estimators.jacobian.parametric import ParametricKalman


def unscented_as_printed() -> UnscentedJacobian:
    """Create the UKF with the noise blocks of Zhang 2011, eq. (21), as printed, at our reproduction's variances."""
    process = math.sqrt(31.6)
    return UnscentedJacobian(walk=RandomWalk(process, process), measurement_noise=10.0, as_printed=True)


ESTIMATORS: Mapping[str, Callable[[], JacobianEstimator]] = {
    "fixed-jacobian": FixedJacobian,
    "broyden": BroydenJacobian,
    "rls": RecursiveLeastSquares,
    "kf": KalmanJacobian,
    "ukf": UnscentedJacobian,
    "ukf-as-printed": unscented_as_printed,
    "pf": ParticleJacobian,
    "level-kf": LevelKalmanJacobian,
    "student-t-kf": lambda: KalmanJacobian(outliers=StudentTNoise()),
    "correntropy-kf": lambda: KalmanJacobian(outliers=CorrentropyNoise()),
    "parametric-ekf": lambda: HypothesisBank(ParametricKalman(), Mountings()),
    "parametric-ukf": lambda: HypothesisBank(ParametricKalman(unscented=True), Mountings()),
    "lifted-kf": LiftedKalman,
    "lifted-kf-swinging": lambda: LiftedKalman(models=SWINGING_MODELS),
    "latency-bank-kf": lambda: HypothesisBank(KalmanJacobian(), Latencies()),
    "latency-bank-lifted-kf": lambda: HypothesisBank(LiftedKalman(), Latencies()),
    "latency-bank-agile-kf": lambda: HypothesisBank(LiftedKalman(models=AGILE_MODELS), Latencies((0.01, 0.06, 0.11))),
    "oracle": OracleJacobian,
    # Its measurements carry the truth, which only privileged environments give.
    "informed": lambda: cast("JacobianEstimator", InformedKalman()),
}

LAWS: Mapping[str, Callable[[], ControlLaw]] = {
    "proportional": Proportional,
    "pi": ProportionalIntegral,
    "damped": DampedLeastSquares,
    "one-step": OneStepExact,
}

DEFAULTS: Mapping[str, Mapping[str, float]] = {
    "latency-bank-agile-kf": {
        "estimator.model_stay": 0.95,
        "law.gain": 0.8,
        "law.max_step": 0.15,
        "excitation.steps": 4,
    }
}
"""Numbers of agents that were searched together with law and exploratory moves, by path; see `controller_path`."""

_NO_PROBING = frozenset({"oracle", "informed"})
"""Agents that need no probing because they receive the true Jacobian or camera."""
_NO_SUPERVISOR = frozenset({"fixed-jacobian"})
"""Agents that must not restart learning."""


def controller_path(path: str) -> str:
    """Path into a `ServoController` of a path into its estimator, or into its "law" or "excitation"."""
    return path if path.startswith(("law.", "excitation.")) else f"estimator.{path}"


def servo_controller(
    estimator: str, law: str, max_joint_rate: float, values: Mapping[str, float] | None = None
) -> ServoController:
    """Create the controller of an agent.

    Args:
        estimator: A key of `ESTIMATORS`.
        law: A key of `LAWS`.
        max_joint_rate: Joint rate limit, rad/s.
        values: Numbers that differ from the agent's defaults, by path into the estimator, or into the parts "law" and
            "excitation" of the controller; see `with_values`.

    Raises:
        ValueError: `values` that do not fit the estimator.
    """
    made = ServoController(
        estimator=ESTIMATORS[estimator](),
        law=LAWS[law](),
        excitation=Excitation(steps=0) if estimator in _NO_PROBING else Excitation(),
        supervisor=None if estimator in _NO_SUPERVISOR else Supervisor(),
        max_joint_rate=max_joint_rate,
    )
    given = {**DEFAULTS.get(estimator, {}), **(values or {})}
    return with_values(made, {controller_path(path): value for path, value in given.items()})


def create_servo_agent(
    env: Any, estimator: str, law: str, values: Mapping[str, float] | None = None
) -> JacobianServo | PixelServo:
    """Create a servo agent; only the environment's `max_joint_rate` and observation space are read.

    If images are observed instead of features, a marker detector comes first. The informed agent, which knows the law
    of its target, also reads `config.target`.

    Args:
        env: A servo environment or vector environment.
        estimator: A key of `ESTIMATORS`.
        law: A key of `LAWS`.
        values: Numbers that differ from the agent's defaults, by path; see `servo_controller`.

    Raises:
        ValueError: An environment that is not a servo, or `values` that do not fit the estimator.
    """
    space = getattr(env, "single_observation_space", env.observation_space)
    max_joint_rate = public_attribute(env, "max_joint_rate")
    keys = set(getattr(space, "spaces", ()))
    sees_pixels = keys.issuperset(PIXEL_KEYS)
    if max_joint_rate is None or not (sees_pixels or keys.issuperset(OBSERVATION_KEYS)):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {estimator!r} needs an environment with max_joint_rate and the observations "
            f"{', '.join(OBSERVATION_KEYS)} (or image); {name} lacks them: choose UncalibServo-v0, or another agent"
        )
    controller = servo_controller(estimator, law, float(max_joint_rate), values)
    if estimator == "informed" and values is None:
        controller = _matched(controller, getattr(public_attribute(env, "config"), "target", ""))
    servo = JacobianServo(controller)
    return PixelServo(servo) if sees_pixels else servo


def _matched(controller: ServoController, target: str) -> ServoController:
    """Give an informed controller its target's filter, and inverse kinematics instead of the one-step law."""
    estimator = cast("JacobianEstimator", FILTERS.get(target, controller.estimator))
    law = ElbowLaw() if isinstance(controller.law, OneStepExact) else controller.law
    return replace(controller, estimator=estimator, law=law)
