"""Cards of the servo agents, in the order of the tables."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information
from servotrack.baselines.agents.tuning_record import shipped_tuning_steps

DEFAULT_LAW = "pi"
LAWS = (DEFAULT_LAW, "proportional", "damped", "one-step")


def _servo(name: str, information: Information, summary: str, law: str = DEFAULT_LAW, **fields: Any) -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.servo.catalog:create_servo_agent",
        information,
        summary,
        parameters={"estimator": name, "law": law},
        laws=True,
        tuning_steps=shipped_tuning_steps(name),
        **fields,
    )


CARDS = (
    _servo("fixed-jacobian", "model-free", "the Jacobian found by probing at the start, never updated"),
    _servo("broyden", "model-free", "Broyden's rank-one update"),
    _servo("rls", "model-free", "recursive least squares with forgetting"),
    _servo("kf", "model-free", "Kalman filter of the total Jacobian"),
    _servo("ukf", "model-free", "unscented Kalman filter (Zhang 2011, noise blocks as its text defines them)"),
    _servo("ukf-as-printed", "model-free", "unscented Kalman filter with the noise blocks as eq. (21) prints them"),
    _servo("pf", "model-free", "particle filter"),
    _servo("level-kf", "model-free", "Kalman filter that measures the features themselves, not their differences"),
    _servo("student-t-kf", "model-free", "Kalman filter with a Student-t gain"),
    _servo("correntropy-kf", "model-free", "maximum-correntropy Kalman filter"),
    _servo("parametric-ekf", "structure", "extended Kalman filter of the arm's and camera's parameters, mounting bank"),
    _servo("parametric-ukf", "structure", "unscented Kalman filter of the same parameters, mounting bank"),
    _servo("lifted-kf", "structure", "Kalman filter of the lifted planar arm, targets of any swing", law="one-step"),
    _servo("lifted-kf-swinging", "prior", "the same with known swing rates, 0.5 to 1.5 rad/s", law="one-step"),
    _servo("latency-bank-kf", "model-free", "Kalman filters, one per hypothesis on the unstamped latency"),
    _servo(
        "latency-bank-lifted-kf",
        "structure",
        "lifted Kalman filters, one per hypothesis on the unstamped latency",
        law="one-step",
    ),
    _servo(
        "latency-bank-agile-kf",
        "structure",
        "the same with targets of constant velocity that jumps; searched at level 6 with its law and probing",
        law="one-step",
    ),
    _servo("oracle", "privileged", "the analytic Jacobian of the present", requires=TRUTH),
    _servo(
        "informed",
        "privileged",
        "known camera, links, latency and law of the target, unknown future",
        law="one-step",
        requires=TRUTH,
    ),
)
