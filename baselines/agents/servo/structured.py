"""Jacobian servos whose structure is data: kind of filter, target models, latency hypotheses, law and probing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.servo.catalog import LAWS, create_controlled
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo
from servotrack.baselines.agents.servo.pixel_servo import PixelServo
from servotrack.estimators.jacobian import Excitation, KalmanJacobian, ServoController, Supervisor
from servotrack.estimators.jacobian.bank import HypothesisBank, Latencies
from servotrack.estimators.jacobian.contract import JacobianEstimator
from servotrack.estimators.jacobian.lifted import LiftedKalman, TargetModel


def structured_controller(structure: Mapping[str, Any], max_joint_rate: float) -> ServoController:
    """Create a controller from a description that JSON can hold.

    Args:
        structure: `filter` ("kf" or "lifted"), `models` (keyword arguments of each `TargetModel`, for "lifted"), `ages`
            (assumed ages of a frame, s; (0,) for no bank), `law` (a key of `LAWS`), and `values` (other numbers by
            path into the filter, or into "law" or "excitation").
        max_joint_rate: Joint rate limit, rad/s.

    Raises:
        ValueError: An unknown filter or law, or numbers that they do not accept.
    """
    kind, law = structure["filter"], structure["law"]
    if kind not in ("kf", "lifted"):
        raise ValueError(f"filter must be 'kf' or 'lifted', got {kind!r}")
    if law not in LAWS:
        raise ValueError(f"law must be one of {', '.join(LAWS)}, got {law!r}")
    values = dict(structure["values"])
    inner = {path: value for path, value in values.items() if not path.startswith(("law.", "excitation."))}
    plain: JacobianEstimator = KalmanJacobian()
    if kind == "lifted":
        plain = LiftedKalman(models=tuple(TargetModel(**model) for model in structure["models"]))
    plain = with_values(plain, inner)
    ages = tuple(structure["ages"])
    return with_values(
        ServoController(
            estimator=plain if ages == (0.0,) else HypothesisBank(plain, Latencies(ages)),
            law=LAWS[law](),
            excitation=Excitation(),
            supervisor=Supervisor(),
            max_joint_rate=max_joint_rate,
        ),
        {path: value for path, value in values.items() if path not in inner},
    )


def create_structured_servo(env: Any, structure: Mapping[str, Any]) -> JacobianServo | PixelServo:
    """Create a servo agent from a description of its structure; see `structured_controller`.

    Args:
        env: A servo environment or vector environment.
        structure: See `structured_controller`.

    Raises:
        ValueError: An environment that is not a servo, or an invalid structure.
    """
    return create_controlled(env, "structured", lambda limit: structured_controller(structure, limit))
