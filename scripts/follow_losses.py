"""Causes of the episodes in which an agent of PedestrianServo loses its person: print their shares, level by level.

An episode is lost at the last frame in which the agent's belief is within half a meter or so of the person (40 px). Run
`python scripts/follow_losses.py crowd-servo --levels 4,5,6 --episodes 100`; seeds are those for tuning.
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import Any

import numpy as np

from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.seeds import take

NEAR = 40.0
"""Largest distance of a belief that is right, px."""
OTHER = 25.0
"""Largest distance of a belief that is at another person, px."""
AROUND = 3
"""Frames before a loss in which a cover counts as its cause."""
AFTERWARDS = 12
"""Frames after a loss in which a swap counts as its cause."""


def causes(agent: str, level: int, seeds: list[int]) -> Counter[str]:
    """Play one episode per seed and count the causes; "kept" counts the others."""
    env = make_vector("PedestrianServo-v0", len(seeds), {"level": level}, privileged=True)
    player = create_agent(agent_card(agent), env)
    observation, _ = env.reset(seed=seeds)
    state: Any = None
    starts, ended, alive = np.ones(len(seeds), np.bool_), np.zeros(len(seeds), np.bool_), np.ones(len(seeds), np.bool_)
    tables: list[tuple[np.ndarray, ...]] = []
    found: Counter[str] = Counter()
    while alive.any():
        action, state = player.predict(observation, state=state, episode_start=starts)
        people, belief = observation["true_people"], state.belief
        away = np.hypot(*(people[:, :, 1:3] - belief[:, None]).transpose(2, 0, 1))
        outside = (people[:, :, 3] == 0.0) & (people[:, :, 4] == 0.0)
        away = np.where(outside, np.inf, away)
        tables.append((away[:, 0], people[:, 0, 0] < 0.5, ~outside[:, 0], away[:, 1:].min(axis=1)))
        observation, _, terminated, truncated, info = env.step(action)
        starts, ended = ended, terminated | truncated
        for row in np.flatnonzero(alive & ended):
            kept = bool(info["kept"][row] and truncated[row])
            found["kept" if kept else _cause([tuple(column[row] for column in table) for table in tables])] += 1
        alive &= ~ended
    env.close()
    return found


def _cause(episode: list[tuple[Any, ...]]) -> str:
    own, covered, inside, other = (np.array(column) for column in zip(*episode, strict=True))
    right = np.flatnonzero(own < NEAR)
    lost = int(right[-1]) + 1 if len(right) else 0
    if lost >= len(own) - AROUND:
        return "right belief, arm too late"
    around = slice(max(lost - AROUND, 0), lost + 2)
    if not inside[around].all():
        return "out of view"
    swap = other[lost : lost + AFTERWARDS].min() < OTHER
    return ("hidden" if covered[around].any() else "in plain view") + (", then another person" if swap else "")


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agent")
    parser.add_argument("--levels", default="4,5,6")
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    for level in map(int, arguments.levels.split(",")):
        found = causes(arguments.agent, level, take("tune", arguments.episodes))
        print(f"level {level}: " + "; ".join(f"{cause} {count}" for cause, count in found.most_common()))


if __name__ == "__main__":
    main()
