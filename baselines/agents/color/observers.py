"""Agents of the color world: a tracker of one object behind `predict`, and two baselines without a tracker."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.color.catalog import ColorTracker, color_tracker
from servotrack.estimators.types import Array, Mask


class ColorObserverState(NamedTuple):
    """Memory of a `ColorObserver`: tracker state of each scene."""

    rows: tuple[Any, ...]


class ColorObserver:
    """A tracker of one object behind `predict`: frames in, boxes out.

    Args:
        tracker: Tracker of one object; see `servotrack.baselines.agents.color.catalog.color_tracker`.
        low: Lowest answer, shape (4,); answers are clipped to the action space.
        high: Highest answer, shape (4,).
    """

    def __init__(self, tracker: ColorTracker, low: Array, high: Array) -> None:
        self.tracker = tracker
        self._low, self._high = low, high

    def predict(
        self,
        observation: Any,
        state: ColorObserverState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, ColorObserverState]:
        """Answer a frame: the first one of an episode with the given box, later ones with the tracker's box.

        Args:
            observation: Entries `frame` (H, W, 3) and `first_box` (4,), or the same with a leading axis of N.
            state: Result of the last call; None starts every scene anew.
            episode_start: Scenes that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the answer is always deterministic.

        Returns:
            The box, shape (4,) or (N, 4), px, and the new state.

        Raises:
            ValueError: A frame or box that the tracker refuses.
        """
        frames, boxes, single = _batched(observation)
        starts = np.zeros(len(frames), np.bool_)
        if state is None:
            state, starts = ColorObserverState((None,) * len(frames)), ~starts
        elif episode_start is not None:
            starts = np.broadcast_to(np.asarray(episode_start, dtype=np.bool_).reshape(-1), (len(frames),))
        answers, rows = np.empty((len(frames), 4)), []
        # Scene by scene: a tracker spends its time in its own compiled loops over a frame.
        for row, (frame, box) in enumerate(zip(frames, boxes, strict=True)):
            if starts[row]:
                rows.append(self.tracker.initial(frame, box))
                answers[row] = box
            else:
                memory, estimate = self.tracker.step(state.rows[row], frame)
                rows.append(memory)
                answers[row] = estimate.box
        answers = np.clip(answers, self._low, self._high)
        return (answers[0] if single else answers), ColorObserverState(tuple(rows))


class BoxReader:
    """Answers with a box of the observation: the first frame's (no skill) or the true one (the upper anchor).

    Args:
        key: Entry of the observation, `first_box` or `true_box`.
    """

    def __init__(self, key: str) -> None:
        self._key = key

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Answer a frame; arguments as in `ColorObserver.predict`."""
        return np.array(observation[self._key], dtype=np.float64), None


def create_color_observer(env: Any, tracker: str, **parameters: Any) -> ColorObserver | BoxReader:
    """Create an agent for the color world; only the environment's spaces are read.

    Args:
        env: A `ColorTracking-v0` environment or vector environment.
        tracker: A name of `servotrack.baselines.agents.color.catalog`, "first-box" or "true-box".
        **parameters: Fields of the tracker that differ from the defaults.

    Raises:
        ValueError: An environment without frames and first boxes, or a tracker that is unknown or not installed.
    """
    seen = getattr(env, "single_observation_space", env.observation_space)
    space = getattr(env, "single_action_space", env.action_space)
    if not isinstance(seen, gym.spaces.Dict) or not {"frame", "first_box"} <= seen.spaces.keys():
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {tracker!r} needs the observations frame and first_box; {name} has none: "
            "choose ColorTracking-v0, or another agent"
        )
    if space != seen["first_box"]:
        raise ValueError(f"agent {tracker!r} answers with boxes in px; make the environment without normalized_actions")
    if tracker in ("first-box", "true-box"):
        return BoxReader(tracker.replace("-", "_"))
    return ColorObserver(color_tracker(tracker, **parameters), space.low, space.high)


def _batched(observation: Any) -> tuple[NDArray[np.uint8], Array, bool]:
    """Return frames and first boxes with a leading axis of scenes, and True if they came without one."""
    frames, boxes = np.asarray(observation["frame"]), np.asarray(observation["first_box"], dtype=np.float64)
    single = boxes.ndim == 1
    return (frames[None], boxes[None], True) if single else (frames, boxes, False)
