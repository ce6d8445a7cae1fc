"""Plan on the true model: random shooting with exact states, a privileged anchor beside the classical agents.

    python examples/random_shooting.py --level 3 --episodes 3

At every step the environment's state is given to a vector environment, which tries random changes of the last plan. The
first action of the best one is taken. No agent without the true model can look ahead like this.
"""

from __future__ import annotations

import argparse

import gymnasium as gym
import numpy as np

import servotrack  # noqa: F401

FUTURES, HORIZON, ROUNDS = 256, 6, 3
SCALES = np.geomspace(0.3, 0.003, FUTURES)[:, None, None]  # of the changes: half of them are fine corrections


def play(level: int, seed: int, **axes: float) -> float:
    """Mean tracking error after the first three seconds of an episode, m."""
    env = gym.make("UncalibServo-v0", level=level, engine="compiled", **axes).unwrapped
    futures = gym.make_vec("UncalibServo-v0", num_envs=FUTURES, level=level, engine="compiled", **axes).unwrapped
    rng, plan, errors, over = np.random.default_rng(seed), np.zeros((HORIZON, 2)), [], False
    _, info = env.reset(seed=seed)
    while not over:
        state, plan = env.get_state(), np.vstack([plan[1:], plan[-1:]])
        for _ in range(ROUNDS):
            plans = np.clip(plan + SCALES * rng.standard_normal((FUTURES, HORIZON, 2)), -1.0, 1.0)
            plans[0] = plan
            futures.set_state(state)
            plan = plans[np.argmax(sum(futures.step(plans[:, k])[1] for k in range(HORIZON)))]
        _, _, terminated, truncated, info = env.step(plan[0])
        errors.append(info["tracking_error"])
        over = terminated or truncated
    return float(np.mean(errors[60:]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", type=int, default=3, help="level of difficulty, 0 to 6 (default 3)")
    parser.add_argument("--episodes", type=int, default=3, help="number of seeds, from 0 on (default 3)")
    arguments = parser.parse_args()
    found = [play(arguments.level, seed) for seed in range(arguments.episodes)]
    print(f"level {arguments.level}, {len(found)} episodes: mean error after 3 s {1e3 * np.mean(found):.2f} mm")
