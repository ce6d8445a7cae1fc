"""Run color trackers over stored episodes of the color world, for tuning and for `monte_carlo_color`."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.color.catalog import ColorTracker
from servotrack.envs.track.color.scoring import center_errors, failures, overlaps, precision, success_curve
from servotrack.estimators.types import Array

ENV_ID = "ColorTracking-v0"


class Film(NamedTuple):
    """An episode of the color world: frames and true boxes.

    Attributes:
        frames: RGB frames, uint8, F of them.
        boxes: True boxes, shape (F, 4), px.
    """

    frames: list[NDArray[np.uint8]]
    boxes: Array


class Pass(NamedTuple):
    """Result of a tracker's pass over a film.

    Attributes:
        boxes: Estimated boxes; the first is the given one. Shape (F, 4), px.
        iou: Overlap with the true box in each frame, shape (F,).
        center_error: Distance to the true center in each frame, shape (F,), px.
        seconds: Duration of each step but the first two, shape (F - 3,), s.
    """

    boxes: Array
    iou: Array
    center_error: Array
    seconds: Array

    @property
    def auc(self) -> float:
        """Area under the success curve."""
        return float(success_curve(self.iou).mean())

    @property
    def precision(self) -> float:
        """Share of frames within 20 px."""
        return precision(self.center_error)

    @property
    def failures(self) -> int:
        """Number of times that the target was lost."""
        return failures(self.iou)


def film(seed: int, **env_kwargs: Any) -> Film:
    """Record an episode of the color world. Answers do not influence this world.

    Args:
        seed: Seed of the environment.
        **env_kwargs: Arguments of the environment.
    """
    env = gym.make(ENV_ID, **env_kwargs)
    observation, info = env.reset(seed=seed)
    answer = observation["first_box"]
    frames, boxes, truncated = [observation["frame"]], [info["truth"]["box"]], False
    while not truncated:
        observation, _, _, truncated, info = env.step(answer)
        frames.append(observation["frame"])
        boxes.append(info["truth"]["box"])
    # The frame after the last answer is not answered.
    return Film(frames[:-1], np.array(boxes[:-1]))


def track(tracker: ColorTracker, seen: Film) -> Pass:
    """Run a tracker over a film from the true box of its first frame.

    Args:
        tracker: A tracker of one object.
        seen: The film.
    """
    state = tracker.initial(seen.frames[0], seen.boxes[0])
    boxes, seconds = [seen.boxes[0]], []
    for frame in seen.frames[1:]:
        begin = time.perf_counter()
        state, estimate = tracker.step(state, frame)
        seconds.append(time.perf_counter() - begin)
        boxes.append(estimate.box)
    answers = np.array(boxes)
    return Pass(answers, overlaps(answers, seen.boxes), center_errors(answers, seen.boxes), np.array(seconds[2:]))
