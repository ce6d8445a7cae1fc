"""Episodes of the reference engine for the page's arm, which must move alike: `python recorded_arms.py FILE`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.servo.world import ServoWorld

CASES: tuple[tuple[str, int, dict[str, Any]], ...] = (
    ("smooth", 3, {}),
    ("rough", 2, {}),
    ("into the stops", 3, {}),
    ("noisy rates", 4, {}),
    ("weak motors", 3, {"max_motor_torque": 2.0}),
    ("warm-up and short links", 0, {"links": (0.15, 0.2)}),
    ("four substeps, fast joints", 6, {"substeps": 4, "solver_iterations": 10, "max_joint_rate": 6.0}),
)
STEPS = 252


def _actions(name: str, rng: np.random.Generator) -> Any:
    if name == "into the stops":
        return np.sign(np.sin(np.arange(STEPS)[:, None] * (0.021, 0.016) + (0.0, 1.0))) * rng.uniform(0.7, 1.3, (1, 2))
    if name in ("rough", "weak motors"):
        return rng.uniform(-1.4, 1.4, (STEPS, 2))
    return 0.6 * np.sin(np.arange(STEPS)[:, None] * rng.uniform(0.02, 0.15, 2) + rng.uniform(0, 6, 2))


def recorded_arms() -> list[dict[str, Any]]:
    """One episode per case: constants of the arm, actions, and the true motion after each step."""
    episodes = []
    for number, (name, level, axes) in enumerate(CASES):
        config = servo_config(level, **axes)
        world = ServoWorld(config, 1, engine="pymunk")
        world.reset([0], [100_000 + number])
        actions = _actions(name, np.random.default_rng(number))
        joints, tool, target, error = [], [], [], []
        for action in actions:
            world.step(action[None])
            joints.append(world.joints[0].tolist())
            tool.append(world.tool[0].tolist())
            target.append(world.target[0, :2].tolist())
            error.append(float(world.tracking_error[0]))
        noise = world._tables.rate_noise[0]
        names = ("max_joint_rate", "max_motor_torque", "substeps", "solver_iterations")
        episodes.append(
            {
                "name": name,
                "links": world.links[0].tolist(),
                "gain": world.gain[0].tolist(),
                "settings": {key: getattr(config, key) for key in names},
                "noise": noise[LEAD : LEAD + STEPS].tolist() if len(noise) else None,
                "actions": actions.tolist(),
                "joints": joints,
                "tool": tool,
                "target": target,
                "error": error,
            }
        )
    return episodes


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(recorded_arms()), encoding="ascii")
