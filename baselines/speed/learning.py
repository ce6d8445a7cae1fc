"""Training steps of PPO per second, with our adapter and with Stable-Baselines3's, and actions of shipped agents.

`python learning.py adapter|dummy RECIPE` trains. `python learning.py session|predict AGENT LEVEL` computes one action
at a time. Both follow the protocol of `stepping.serve`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from servotrack.baselines.speed.rates import Subject
from servotrack.baselines.speed.stepping import WARM_UP, serve

ENV_ID = "UncalibServo-v0"
BLOCK = 100


def subjects() -> list[Subject]:
    """Return the rows of the table."""
    own, dummy = (f"PPO training, 64 environments, {kind}" for kind in ("our adapter", "DummyVecEnv"))
    remedy = "install the extra: pip install 'servotrack[rl]'"
    return [
        Subject(own, (__file__, "adapter", "ppo"), 36_000.0, {dummy: 1.8}, remedy=remedy),
        Subject(own.replace("64", "1,024"), (__file__, "adapter", "wide"), 48_000.0, remedy=remedy),
        Subject(dummy, (__file__, "dummy", "ppo"), remedy=remedy),
        Subject("`ppo`, one observation, network alone", (__file__, "session", "ppo", "3"), 20_000.0),
        Subject("`ppo`, one observation, predict", (__file__, "predict", "ppo", "3"), 10_000.0),
        Subject("`hybrid` at level 6, one observation, network alone", (__file__, "session", "hybrid", "6"), 20_000.0),
        Subject("`hybrid` at level 6, one observation, predict", (__file__, "predict", "hybrid", "6")),
    ]


def answering(name: str, level: int, alone: bool) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns actions of a shipped agent per second.

    Args:
        name: Name of the agent.
        level: Level of the environment.
        alone: Time the network alone instead of `predict`.
    """
    import gymnasium as gym
    import numpy as np

    import servotrack  # noqa: F401
    from servotrack.baselines.agents.registry import create_agent

    env = gym.make(ENV_ID, level=level)
    agent: Any = create_agent(name, env)
    observation, _ = env.reset(seed=0)
    _, state = agent.predict(observation)
    network = agent.network
    rows, memory = np.zeros((1, network.size), np.float32), np.zeros((1, network.memory), np.float32)

    def run(duration: float) -> float:
        nonlocal observation, state
        answers, spent, state = 0, 0.0, None
        observation, _ = env.reset()
        while spent < duration:
            start = time.perf_counter()
            if alone:
                for _ in range(BLOCK):
                    network(rows, memory)
                answers += BLOCK
            else:
                action, state = agent.predict(observation, state)
                answers += 1
            spent += time.perf_counter() - start
            if not alone:
                observation, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    (observation, _), state = env.reset(), None
        return answers / spent

    return run


if __name__ == "__main__":
    kind, *rest = sys.argv[1:]
    if kind in ("adapter", "dummy"):
        from servotrack.baselines.training.ppo_speed import ppo_speed

        measure = ppo_speed(ENV_ID, rest[0], adapter=kind == "adapter")
    else:
        measure = answering(rest[0], int(rest[1]), alone=kind == "session")
    measure(WARM_UP)
    serve(measure)
