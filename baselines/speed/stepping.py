"""Process that measures the rate of one environment.

`servotrack.baselines.speed.rates` runs it as a script, also with the interpreter of another virtual environment.
Therefore it imports only Gymnasium, NumPy and the module that the job names. The job is one JSON argument with the
fields of `Job`. The process prints "ready" once everything is built and warm. Then it answers each line of standard
input, a duration in seconds, with a line that holds a rate.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any, TypedDict

import numpy as np

ACTIONS = 4096
BLOCK = 32
WARM_UP = 0.5


class Job(TypedDict):
    """Environment to measure.

    Attributes:
        module: Module that registers the id; imported first.
        env_id: Gymnasium id.
        kwargs: Arguments of the environment.
        num_envs: Size of the vector environment; 0 for a single environment.
        mode: `vectorization_mode` of `gymnasium.make_vec`.
        counts: "steps"; "silent" for steps with actions of zeros, if scoring random ones would cost more than the step;
            "resets" for calls of `reset` alone; or "frames" for calls of `render` alone, with an untimed step between
            two calls.
    """

    module: str
    env_id: str
    kwargs: dict[str, Any]
    num_envs: int
    mode: str
    counts: str


def serve(measure: Callable[[float], float]) -> None:
    """Answer every duration on standard input with a rate on standard output."""
    print("ready", flush=True)
    for line in sys.stdin:
        print(measure(float(line)), flush=True)


def stepper(job: Job) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns steps of all sub-environments or frames per second.

    Random actions are drawn beforehand. Resets count as part of the time.
    """
    import gymnasium as gym

    importlib.import_module(job["module"])
    if job["num_envs"]:
        env: Any = gym.make_vec(
            job["env_id"], num_envs=job["num_envs"], vectorization_mode=job["mode"], **job["kwargs"]
        )
        run = _reset_run(env, job["num_envs"]) if job["counts"] == "resets" else _vector_run(env, job["num_envs"])
    else:
        env = gym.make(job["env_id"], **job["kwargs"])
        run = _frame_run(env) if job["counts"] == "frames" else _single_run(env, job["counts"] == "silent")
    if "cv2" in sys.modules:
        # OpenCV uses all cores by default; rates are those of one thread.
        sys.modules["cv2"].setNumThreads(1)
    env.reset(seed=0)
    run(WARM_UP)
    return run


def _drawn(space: Any, shape: tuple[int, ...]) -> Any:
    """Uniform actions of a Box, with leading axes `shape`."""
    return np.random.default_rng(0).uniform(space.low, space.high, (*shape, *space.shape)).astype(space.dtype)


def _single_run(env: Any, silent: bool = False) -> Callable[[float], float]:
    actions = _drawn(env.action_space, (ACTIONS,))
    if silent:
        actions = np.zeros_like(actions)

    def run(duration: float) -> float:
        steps, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            for _ in range(BLOCK):
                _, _, terminated, truncated, _ = env.step(actions[steps % ACTIONS])
                steps += 1
                if terminated or truncated:
                    env.reset()
        return steps / elapsed

    return run


def _vector_run(env: Any, num_envs: int) -> Callable[[float], float]:
    actions = _drawn(env.single_action_space, (max(ACTIONS // num_envs, 8), num_envs))

    def run(duration: float) -> float:
        steps, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            env.step(actions[steps % len(actions)])
            steps += 1
        return steps * num_envs / elapsed

    return run


def _reset_run(env: Any, num_envs: int) -> Callable[[float], float]:
    def run(duration: float) -> float:
        resets, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            env.reset()
            resets += num_envs
        return resets / elapsed

    return run


def _frame_run(env: Any) -> Callable[[float], float]:
    actions = _drawn(env.action_space, (ACTIONS,))

    def run(duration: float) -> float:
        frames, spent = 0, 0.0
        while spent < duration:
            _, _, terminated, truncated, _ = env.step(actions[frames % ACTIONS])
            if terminated or truncated:
                env.reset()
            start = time.perf_counter()
            env.render()
            spent += time.perf_counter() - start
            frames += 1
        return frames / spent

    return run


if __name__ == "__main__":
    serve(stepper(json.loads(sys.argv[1])))
