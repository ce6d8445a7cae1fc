"""Agents of the worlds of people on video: a detector and a tracker behind `predict`, one scene after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.clutter.observers import RawObserver, SetObserver
from servotrack.baselines.agents.people.catalog import centroid_filter, create_detector, create_tracker
from servotrack.baselines.agents.row_patience import ReservedRows, allocate_rows, no_rows
from servotrack.envs.track.people.camera_model import VideoModel
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.boxes import DetectThenTrack, RawDetections, set_of_boxes
from servotrack.estimators.detect import detections_from_boxes
from servotrack.estimators.rfs import RowAllocation, SetEstimate
from servotrack.estimators.stateful import add_axis, select_rows
from servotrack.estimators.types import Array, Mask

BOX = (0, 1, 2, 3)
"""Columns of a box that an answer holds: all."""

TRACKER_NAMES: Mapping[str, str] = {"raw-measurements": "no-filter"}
"""Agents whose tracker has another name; all others are called like theirs."""


class VideoObserverState(NamedTuple):
    """Memory of a `VideoObserver`.

    Attributes:
        beliefs: The estimator's state of each of N scenes.
        rows: Which identity owns which row of the answers.
    """

    beliefs: tuple[Any, ...]
    rows: ReservedRows


class DetectionRows:
    """Fixed arrays of detections as a tracker takes them: a stage before any tracker of boxes.

    Args:
        tracker: As in `servotrack.estimators.boxes`.
    """

    def __init__(self, tracker: Any) -> None:
        self.tracker = tracker

    def initial(self, rows: Array) -> Any:
        """State before the first frame."""
        return self.tracker.initial(_detections(rows))

    def step(self, state: Any, rows: Array) -> tuple[Any, SetEstimate]:
        """Fold one frame's rows in, existence and box each. Shape (M, 5)."""
        return self.tracker.step(state, _detections(rows))


class TruePeople:
    """Reports the true boxes under their true identities; privileged, and without memory."""

    def initial(self, observation: Mapping[str, Array]) -> None:
        """Nothing to remember."""

    def step(self, state: None, observation: Mapping[str, Array]) -> tuple[None, SetEstimate]:
        """Report who counts, hold who is hidden."""
        labels = observation["true_ids"].astype(np.int64)
        here = labels > 0
        boxes = np.asarray(observation["true_boxes"], dtype=np.float64)[here]
        existence = np.where(observation["true_existence"][here] > 0.5, 1.0, 0.1)
        return None, set_of_boxes(boxes, np.zeros((len(boxes), 4, 4)), labels[here], existence)


class VideoObserver:
    """An estimator of boxes behind `predict`: frames or detections in, sets of people out.

    Args:
        estimator: With `initial(observation)` and `step(state, observation)` for one scene.
        space: Action space of one scene.
        whole: Whether the estimator is given the whole dictionary of a privileged observation.
        centers: Whether answers are the centers of boxes.
        identities: Whether the estimator's identities last; if not, they are given rows in order.
    """

    def __init__(
        self, estimator: Any, space: Any, *, whole: bool = False, centers: bool = False, identities: bool = True
    ) -> None:
        self.estimator = estimator
        self._low, self._high = space.low, space.high
        self._whole, self._centers, self._identities = whole, centers, identities
        self._allocation = RowAllocation(space.shape[0], BOX)

    def predict(
        self,
        observation: Any,
        state: VideoObserverState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, VideoObserverState]:
        """Answer a frame.

        Args:
            observation: An image (H, W, 3) or rows (M, 5), or N of them; or a dictionary with that under `observation`
                and the truth beside it.
            state: What the last call returned; None starts anew.
            episode_start: Scenes that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: These agents always are.

        Returns:
            Shape (rows, 1 + d) or (N, rows, 1 + d); and the new state.
        """
        scenes, single = self._scenes(observation)
        count = len(scenes)
        starts = np.zeros(count, np.bool_) if episode_start is None else np.broadcast_to(episode_start, (count,))
        fresh = no_rows(self._allocation, count, 4)
        if state is None or len(state.beliefs) != count:
            state, starts = VideoObserverState((None,) * count, fresh), np.ones(count, np.bool_)
        rows = select_rows(starts, fresh, state.rows)
        beliefs, memories, answers = [], [], []
        for k, scene in enumerate(scenes):
            belief = self.estimator.initial(scene) if starts[k] else state.beliefs[k]
            belief, estimate = self.estimator.step(belief, scene)
            memory, answer = self._answer(select_scene(rows, k), estimate)
            beliefs.append(belief)
            memories.append(memory)
            answers.append(answer)
        joined = np.clip(np.concatenate(answers), self._low, self._high)
        return (joined[0] if single else joined), VideoObserverState(tuple(beliefs), join_scenes(memories))

    def _answer(self, memory: ReservedRows, estimate: SetEstimate) -> tuple[ReservedRows, Array]:
        if self._identities:
            memory, answer = allocate_rows(self._allocation, memory, _with_axis(estimate))
        else:
            answer = np.zeros((1, self._allocation.rows, 5))
            kept = min(len(estimate.labels), self._allocation.rows)
            answer[0, :kept, 0], answer[0, :kept, 1:] = estimate.existence[:kept], estimate.states[:kept]
        if self._centers:
            middle = answer[..., 1:3] + answer[..., 3:] / 2.0
            answer = np.concatenate([answer[..., :1], middle], axis=-1)
        return memory, answer

    def _scenes(self, observation: Any) -> tuple[list[Any], bool]:
        """The observation of each scene, and whether there was one without a leading axis."""
        parts = dict(observation) if isinstance(observation, Mapping) else {OBSERVATION_KEY: observation}
        shown = np.asarray(parts[OBSERVATION_KEY])
        # Images have three axes, sets two.
        single = shown.ndim == (3 if shown.dtype == np.uint8 else 2)
        if not self._whole:
            return ([shown] if single else list(shown)), single
        arrays = {key: np.asarray(value) for key, value in parts.items()}
        if single:
            return [arrays], True
        return [{key: value[k] for key, value in arrays.items()} for k in range(len(shown))], False


def create_video_observer(env: Any, estimator: str, detector: str = "masked") -> Any:
    """An observer for a world of people on video; only the spaces and what it tells its agents (`told`) are read.

    Args:
        env: An environment or vector environment whose `scene_model` is a `VideoModel`.
        estimator: A name from `agents.people.catalog.TRACKERS`, "raw-measurements" or "people-oracle".
        detector: A name from `agents.people.catalog.DETECTORS`, for worlds that show frames.

    Raises:
        ValueError: The environment tells no `VideoModel`, or an unknown name.
    """
    told = getattr(env.unwrapped, "scene_model", None)
    if not isinstance(told, VideoModel):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {estimator!r} needs a world of people on video; {name} is none: choose PedestrianTracking-v0 or "
            "VideoTracking-v0, or another agent"
        )
    space = getattr(env, "single_action_space", env.action_space)
    if estimator == "people-oracle":
        return VideoObserver(TruePeople(), space, whole=True, centers=not told.answers_boxes)
    name = TRACKER_NAMES.get(estimator, estimator)
    if not told.answers_boxes:
        found = centroid_filter(name, (told.width, told.height), told.frame_rate)
        if name == "no-filter":
            return RawObserver(found, space.low, space.high)
        return SetObserver(found, space.shape[0], space.low, space.high)
    tracker = create_tracker(name, (told.width, told.height), told.frame_rate)
    sees = told.observation == "pixels"
    made = DetectThenTrack(create_detector(detector), tracker) if sees else DetectionRows(tracker)
    return VideoObserver(made, space, identities=not isinstance(tracker, RawDetections))


def select_scene(rows: ReservedRows, k: int) -> ReservedRows:
    """The rows of one scene, with an axis of one."""
    return ReservedRows(type(rows.rows)(rows.rows.label[k : k + 1]), rows.absent[k : k + 1], rows.states[k : k + 1])


def join_scenes(memories: list[ReservedRows]) -> ReservedRows:
    """The rows of several scenes."""
    return ReservedRows(
        type(memories[0].rows)(np.concatenate([memory.rows.label for memory in memories])),
        np.concatenate([memory.absent for memory in memories]),
        np.concatenate([memory.states for memory in memories]),
    )


def _detections(rows: Array) -> Any:
    return detections_from_boxes(rows[rows[:, 0] >= 0.5, 1:])


def _with_axis(estimate: SetEstimate) -> SetEstimate:
    values = [getattr(estimate, name) for name in SetEstimate.__dataclass_fields__]
    return SetEstimate(*[add_axis(value) for value in values])
