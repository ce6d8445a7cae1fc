"""Agents made of estimators or networks, and their evaluation, training and ranking.

The names below are imported when they are first used, so that importing this module costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servotrack.baselines.agents.people.catalog import create_detector, create_tracker
    from servotrack.baselines.agents.registry import agent_card, create_agent
    from servotrack.baselines.evaluation.bench import bench
    from servotrack.baselines.evaluation.evaluate import evaluate
    from servotrack.baselines.evaluation.minari_dataset import collect_dataset
    from servotrack.baselines.training.sb3 import StableBaselinesVecEnv

__all__ = [
    "StableBaselinesVecEnv",
    "agent_card",
    "bench",
    "collect_dataset",
    "create_agent",
    "create_detector",
    "create_tracker",
    "evaluate",
]

_HOMES = {
    "StableBaselinesVecEnv": "training.sb3",
    "agent_card": "agents.registry",
    "bench": "evaluation.bench",
    "collect_dataset": "evaluation.minari_dataset",
    "create_agent": "agents.registry",
    "create_detector": "agents.people.catalog",
    "create_tracker": "agents.people.catalog",
    "evaluate": "evaluation.evaluate",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
