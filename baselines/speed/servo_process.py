"""Process that measures steps of a servo, or of its estimator, for an arm of seven joints whose camera sees points.

`python servo_process.py PART POINTS` follows the protocol of `stepping.serve`; PART is a key of `PARTS`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

import servotrack  # noqa: F401
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo, servo_measurement
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.speed.stepping import WARM_UP, serve
from servotrack.estimators.jacobian import AdaptiveKalmanJacobian, ChainJacobian, ServoController

STEPS = 600
EXPLORING = 100
"""First steps of an episode, which are not measured: the arm explores in them, and chains have few keyframes."""
PARTS: Mapping[str, Callable[[], Any]] = {
    "controller": ServoController,
    "chain": ChainJacobian,
    "adaptive": AdaptiveKalmanJacobian,
}


def stepper(part: str, points: int = 4) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns steps per second.

    The measurements are those of an episode that the default controller drives; each part is fed with them.

    Args:
        part: Part to measure.
        points: Number of points that the camera sees.
    """
    env = gym.make("UncalibServo3D-v0", level=3, arm="panda", points=points)
    rate = float(env.get_wrapper_attr("max_joint_rate"))
    agent = JacobianServo(ServoController(max_joint_rate=rate))
    observation, _ = env.reset(seed=take("train", 1)[0])
    stream, memory = [], None
    for step in range(STEPS):
        stream.append(servo_measurement(observation))
        action, memory = agent.predict(observation, memory, np.array(step == 0))
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            raise RuntimeError(f"the episode ended at step {step} of {STEPS}: choose another seed")
    subject: Any = PARTS[part]()
    explored = subject.initial(stream[0])
    for measurement in stream[:EXPLORING]:
        explored, _ = subject.step(explored, measurement)

    def run(duration: float) -> float:
        steps, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            state = explored
            for measurement in stream[EXPLORING:]:
                state, _ = subject.step(state, measurement)
            steps += STEPS - EXPLORING
        return steps / elapsed

    run(WARM_UP)
    return run


if __name__ == "__main__":
    serve(stepper(sys.argv[1], int(sys.argv[2])))
