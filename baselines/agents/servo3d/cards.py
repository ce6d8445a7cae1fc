"""Cards of the agents for serial arms."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information


def _calibrated(name: str, summary: str, information: Information = "calibrated", **parameters: Any) -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.servo3d.catalog:create_calibrated_servo",
        information,
        summary,
        parameters=parameters,
        requires=TRUTH,
        tuning_steps=0,
        worlds=frozenset({"servo3d"}),
    )


def _model_free(name: str, summary: str, information: Information = "model-free") -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.servo3d.model_free:create_model_free_servo",
        information,
        summary,
        parameters={"agent": name},
        tuning_steps=0,
        worlds=frozenset({"servo3d"}),
    )


CARDS = (
    _model_free("any-arm", "the default servo: a bank of rigid chains whose gears have different play", "structure"),
    _model_free("chain", "rigid chain without play, beside an adaptive Kalman filter", "structure"),
    _model_free("adaptive-kf", "Kalman filter whose noise follows from motion, with a cautious law"),
    _model_free(
        "latency-bank-adaptive-kf", "the same, one per hypothesis on the unstamped ages of frames and encoder readings"
    ),
    _model_free("expert-kf", "Kalman filter of the total Jacobian with prior, gain and moves for six joints"),
    _calibrated("ibvs", "image-based servo with the true interaction matrix of the present", law="current"),
    _calibrated("ibvs-desired", "image-based servo with the interaction matrix of the goal", law="desired"),
    _calibrated("ibvs-mean", "image-based servo with the mean of both interaction matrices", law="mean"),
    _calibrated("pbvs", "position-based servo: pose of the board by PnP, true optics, mounting and arm", law="pose"),
    _calibrated(
        "joint-oracle", "drives the joints to those of the goal, without the camera", "privileged", law="joints"
    ),
)
