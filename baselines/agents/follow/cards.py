"""Cards of the agents that follow one person."""

from __future__ import annotations

from itertools import product
from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information

_PARTS = ("identity", "jacobian", "detections")


def _follow(name: str, summary: str, information: Information = "structure", **parameters: Any) -> AgentCard:
    privileged = bool(parameters.get("oracles"))
    return AgentCard(
        name,
        "servotrack.baselines.agents.follow.catalog:create_follow_agent",
        "privileged" if privileged else information,
        summary,
        parameters=parameters,
        requires=TRUTH if privileged else frozenset(),
        worlds=frozenset({"follow"}),
    )


def _ablation() -> tuple[AgentCard, ...]:
    """Return the follower with every combination of its parts replaced by an oracle."""
    kinds = sorted(product((False, True), repeat=len(_PARTS)), key=sum)
    chosen = [tuple(part for part, true in zip(_PARTS, kind, strict=True) if true) for kind in kinds if any(kind)]
    return tuple(
        _follow(f"phd-servo-told-{'-'.join(parts)}", f"the same with true {', '.join(parts)}", oracles=parts)
        for parts in chosen
    )


CARDS = (
    AgentCard(
        "crowd-servo",
        "servotrack.baselines.agents.follow.catalog:create_crowd_agent",
        "structure",
        "tracks of all people, several hypotheses of the person to follow, bank of latencies for servo and ego-motion",
        worlds=frozenset({"follow"}),
    ),
    _follow("phd-servo", "GM-PHD filter of all people with colors, lifted Kalman servo on the person to follow"),
    _follow(
        "nearest-servo", "nearest detection to the last one, Kalman filter servo", "model-free", identity="nearest"
    ),
    *_ablation(),
)
