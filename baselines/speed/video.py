"""Frames per second of detectors, box trackers and color trackers on rendered frames, beside OpenCV's.

`python video.py detector|filter|both|color|mog2 NAME` follows the protocol of `stepping.serve`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np

from servotrack.baselines.evaluation.seeds import TEST
from servotrack.baselines.speed.environments import stepping_command
from servotrack.baselines.speed.rates import Subject
from servotrack.baselines.speed.stepping import WARM_UP, serve
from servotrack.estimators.types import Array, Estimator, Image

VIDEO = Path(__file__)
FRAMES = 250
SIX_PEOPLE: dict[str, Any] = {"level": 5, "script": "random", "people": 6.0}
"""All disturbances of the image on, with six people on average."""
MOG2, MIL = "OpenCV's MOG2, mask alone", "OpenCV's MIL"


def subjects() -> list[Subject]:
    """Return the rows of the table: frames per second at 384 x 288 px, color trackers at 300 x 245 px, one thread."""
    pedestrians = "PedestrianTracking-v0"

    def row(kind: str, name: str, title: str, target: float = 0.0, ratios: dict[str, float] | None = None) -> Subject:
        return Subject(title, (str(VIDEO), kind, name), target, ratios or {})

    return [
        Subject(f"{pedestrians}, default scene", stepping_command(pedestrians, silent=True), 1_000.0),
        Subject(
            f"{pedestrians}, six people, every axis on", stepping_command(pedestrians, silent=True, **SIX_PEOPLE), 400.0
        ),
        Subject(f"{pedestrians}, default scene, 16 random boxes scored", stepping_command(pedestrians)),
        row("detector", "masked", "detector `masked`", 950.0),
        row("detector", "masked-paper", "detector `masked-paper`"),
        row("filter", "gm-phd", "filter `gm-phd`", 2_000.0),
        row("filter", "pmb", "filter `pmb`", 2_000.0),
        row("both", "gm-phd", "`masked` and `gm-phd`", 600.0),
        row("both", "pmb", "`masked` and `pmb`", 600.0),
        row("color", "monte-carlo-color", "color tracker `monte-carlo-color`, 200 samples", 1_000.0),
        row("color", "monte-carlo-color-plus", "color tracker `monte-carlo-color-plus`", 1_000.0),
        row("mog2", "mog2", MOG2),
        row("color", "mil", MIL),
    ]


def pedestrian_frames(count: int = FRAMES) -> list[Image]:
    """Return frames of the default scene, kept in memory so that rendering is not timed."""
    env = gym.make("PedestrianTracking-v0", horizon=count)
    assert env.action_space.shape is not None
    nothing = np.zeros(env.action_space.shape)
    frames = [env.reset(seed=TEST[0])[0]]
    frames += [env.step(nothing)[0] for _ in range(count - 1)]
    env.close()
    return frames


def color_frames(count: int = 150) -> tuple[list[Image], Array]:
    """Return frames of the color world's first scenario, and the true box of the first frame."""
    env = gym.make("ColorTracking-v0")
    observation, _ = env.reset(seed=TEST[0])
    frames, box = [observation["frame"]], observation["first_box"]
    for _ in range(count - 1):
        observation, *_ = env.step(box)
        frames.append(observation["frame"])
    env.close()
    return frames, box


def steps(kind: str, name: str) -> tuple[Callable[[], Any], int]:
    """Return a function that processes all frames once, and the number of frames.

    Args:
        kind: Part that is measured: detector, filter, both, color or mog2.
        name: Name of the detector, filter or tracker.

    Raises:
        ValueError: Unknown kind.
    """
    if kind == "color":
        return _color_steps(name)
    from servotrack.baselines.agents.people.catalog import create_detector, create_tracker

    frames = pedestrian_frames()
    size = (frames[0].shape[1], frames[0].shape[0])
    if kind == "mog2":
        subtractor = cv2.createBackgroundSubtractorMOG2()
        return lambda: _drain(subtractor.apply, frames), len(frames)
    if kind == "detector":
        return lambda: _run(create_detector(name), frames[0], frames), len(frames)
    tracker = create_tracker(name, size, 25.0)
    if kind == "filter":
        found = _run(create_detector("masked"), frames[0], frames)
        return lambda: _run(tracker, found[0], found), len(frames)
    if kind == "both":
        return lambda: _run(tracker, None, _run(create_detector("masked"), frames[0], frames)), len(frames)
    raise ValueError(f"kind must be detector, filter, both, color or mog2, got {kind!r}")


def _color_steps(name: str) -> tuple[Callable[[], Any], int]:
    from servotrack.baselines.agents.color.catalog import color_tracker

    frames, box = color_frames()
    tracker = color_tracker(name)

    def track() -> None:
        state = tracker.initial(frames[0], box)
        for frame in frames[1:]:
            state, _ = tracker.step(state, frame)

    return track, len(frames) - 1


def _run(estimator: Estimator[Any, Any, Any], first: Any, stream: Sequence[Any]) -> list[Any]:
    """Estimates of an estimator for a whole stream of measurements."""
    state, answers = estimator.initial(stream[0] if first is None else first), []
    for measurement in stream:
        state, answer = estimator.step(state, measurement)
        answers.append(answer)
    return answers


def _drain(call: Callable[[Any], Any], frames: Sequence[Image]) -> None:
    for frame in frames:
        call(frame)


def timer(kind: str, name: str) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns frames per second."""
    cv2.setNumThreads(1)
    once, count = steps(kind, name)

    def run(duration: float) -> float:
        passes, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            once()
            passes += 1
        return passes * count / elapsed

    run(WARM_UP)
    return run


if __name__ == "__main__":
    import servotrack  # noqa: F401

    serve(timer(*sys.argv[1:3]))
