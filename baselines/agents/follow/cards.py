"""Cards of the agents that follow one person."""

from __future__ import annotations

from itertools import product
from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information

_TOLD = ("identity", "jacobian", "detections")


def _follow(name: str, summary: str, information: Information = "structure", **parameters: Any) -> AgentCard:
    told = bool(parameters.get("told"))
    return AgentCard(
        name,
        "servotrack.baselines.agents.follow.catalog:create_follow_agent",
        "privileged" if told else information,
        summary,
        parameters=parameters,
        requires=TRUTH if told else frozenset(),
        worlds=frozenset({"follow"}),
    )


def _ablation() -> tuple[AgentCard, ...]:
    """The follower with every combination of its parts told by an oracle."""
    kinds = sorted(product((False, True), repeat=len(_TOLD)), key=sum)
    chosen = [tuple(part for part, told in zip(_TOLD, kind, strict=True) if told) for kind in kinds if any(kind)]
    return tuple(
        _follow(f"phd-servo-told-{'-'.join(told)}", f"the same, told {', '.join(told)}", told=told) for told in chosen
    )


CARDS = (
    _follow("phd-servo", "GM-PHD of everybody with colors, lifted Kalman servo on the one to follow"),
    _follow(
        "nearest-servo", "nearest detection to the last one, Kalman filter servo", "model-free", identity="nearest"
    ),
    *_ablation(),
)
