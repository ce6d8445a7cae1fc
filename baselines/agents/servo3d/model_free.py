"""Servo agents of serial arms that know neither camera nor arm: estimators and laws by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from servotrack.baselines.agents.servo.jacobian_servo import OBSERVATION_KEYS, JacobianServo
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    AnyArm,
    ChainJacobian,
    Excitation,
    FeatureWise,
    HypothesisBank,
    JacobianPrior,
    JointLimits,
    KalmanJacobian,
    Latencies,
    Proportional,
    RandomWalk,
    ServoController,
)

HOMING_MARGIN = 0.06
"""Distance that joints keep from their limits, rad: encoders of hobby servos have homing errors of some degrees."""
AGES = (0.0, 0.05, 0.1)
"""Assumed ages of frames and of encoder readings without stamps, s: up to two control periods."""
_ATTRIBUTES = ("max_joint_rate", "max_joint_acceleration", "joint_low", "joint_high")


def _expert() -> dict[str, Any]:
    """Zhang's filter with a prior, a gain and a number of moves that suit six joints; nothing watches it."""
    filtered = KalmanJacobian(walk=RandomWalk(20.0, 5.0), measurement_noise=1.5, prior=JacobianPrior(900.0, 50.0))
    return {
        "estimator": FeatureWise(filtered),
        "law": Proportional(gain=0.2, damping=0.02),
        "excitation": Excitation(steps=14),
        "supervisor": None,
    }


PARTS: Mapping[str, Callable[[], dict[str, Any]]] = {
    "any-arm": lambda: {"estimator": AnyArm()},
    "chain": lambda: {"estimator": ChainJacobian()},
    "adaptive-kf": lambda: {"estimator": AdaptiveKalmanJacobian()},
    "latency-bank-adaptive-kf": lambda: {"estimator": HypothesisBank(AdaptiveKalmanJacobian(), Latencies(AGES, AGES))},
    "expert-kf": _expert,
}
"""Parts of `ServoController` by agent."""


def create_model_free_servo(env: Any, agent: str) -> JacobianServo:
    """Create an agent; only the environment's limits and observation space are read.

    Args:
        env: A serial-arm environment or vector environment.
        agent: A key of `PARTS`.

    Raises:
        ValueError: Another environment.
    """
    space = getattr(env, "single_observation_space", env.observation_space)
    found = [public_attribute(env, name) for name in _ATTRIBUTES]
    if any(value is None for value in found) or not set(getattr(space, "spaces", ())).issuperset(OBSERVATION_KEYS):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {agent!r} needs an environment with {', '.join(_ATTRIBUTES)} and the observations "
            f"{', '.join(OBSERVATION_KEYS)}; {name} lacks them: choose UncalibServo3D-v0, or another agent"
        )
    rate, acceleration, low, high = found
    limits = JointLimits(
        tuple(np.asarray(low).tolist()), tuple(np.asarray(high).tolist()), HOMING_MARGIN, float(acceleration)
    )
    return JacobianServo(ServoController(**PARTS[agent](), max_joint_rate=float(rate), limits=limits))
