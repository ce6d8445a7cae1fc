"""Choice of the engine that moves the arms: pymunk, the reference, or compiled code with the same bits."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from servotrack.envs.servo.arm import Arms
from servotrack.envs.servo.compiled_arms import CompiledArms
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.pymunk_arms import PymunkArms

ENGINES: dict[str, Callable[[ServoConfig, int], Arms]] = {"pymunk": PymunkArms, "compiled": CompiledArms}
"""Engines by name."""

_CHECKED_ARMS, _CHECKED_STEPS = 5, 60


def chosen_engine(engine: str | None, default: str) -> str:
    """Return the name of an engine.

    Args:
        engine: `pymunk`, `compiled`, or None for the default.
        default: Engine that None stands for. `compiled` holds only where `same_bits` is true, else None means `pymunk`.

    Raises:
        ValueError: An unknown engine; the message has the valid ones.
    """
    if engine is None:
        return default if default == "pymunk" or same_bits() else "pymunk"
    if engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(ENGINES)} or None, got {engine!r}")
    return engine


@lru_cache(maxsize=1)
def same_bits() -> bool:
    """Return True if both engines give the same bits on this machine.

    Some arms are driven into their stops and started anew on the way, by both engines, once per process. Sines and
    cosines of another mathematics library than pymunk's are what would make a difference.
    """
    rng, config = np.random.default_rng(0), ServoConfig()
    links = rng.uniform(0.35, 0.65, (_CHECKED_ARMS, 2))
    both = [make(config, _CHECKED_ARMS) for make in ENGINES.values()]
    for step in range(_CHECKED_STEPS):
        rates = rng.uniform(-2.0, 2.0, (_CHECKED_ARMS, 2)) + np.where(step < _CHECKED_STEPS // 2, 2.0, -2.0)
        for arms in both:
            if step in (0, _CHECKED_STEPS // 3):
                started = np.arange(_CHECKED_ARMS if step == 0 else 1)
                arms.reset(started, links[started])
            arms.step(rates)
        if not np.array_equal(both[0].angles, both[1].angles):
            return False
    return True
