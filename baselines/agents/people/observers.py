"""Observers of people on video: a detector and a tracker behind `predict`, scene by scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.people.catalog import BoxTracker, centroid_filter, create_detector, create_tracker
from servotrack.baselines.agents.row_reservation import (
    ReservedRows,
    allocate_rows,
    join_scenes,
    no_rows,
    select_scene,
)
from servotrack.baselines.agents.set_observer import RawObserver, SetObserver
from servotrack.baselines.worlds import public_attribute
from servotrack.envs.track.people.camera_model import VideoModel
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.boxes import DetectThenTrack, RawDetections, set_of_boxes
from servotrack.estimators.detect import detections_from_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs import RawMeasurements, RowAllocation, SetEstimate
from servotrack.estimators.stateful import add_axis, select_rows
from servotrack.estimators.types import Array, Estimator, Mask

BOX = (0, 1, 2, 3)
"""Entries of a state that an answer holds: left, top, width, height."""

TRACKER_NAMES: Mapping[str, str] = {"raw-measurements": "no-filter"}
"""Tracker of each agent whose name differs from its tracker's."""


class VideoObserverState(NamedTuple):
    """Memory of a `VideoObserver`.

    Attributes:
        beliefs: Estimator state of each of N scenes.
        rows: Owners of the rows of the answers.
    """

    beliefs: tuple[Any, ...]
    rows: ReservedRows


class DetectionRows:
    """Converts fixed arrays of detections for a tracker of boxes.

    Args:
        tracker: A tracker of `servotrack.estimators.boxes`.
    """

    def __init__(self, tracker: BoxTracker) -> None:
        self.tracker = tracker

    def initial(self, rows: Array) -> Any:
        """Return the state before the first frame."""
        return self.tracker.initial(_detections(rows))

    def step(self, state: Any, rows: Array) -> tuple[Any, SetEstimate]:
        """Process the rows of one frame, existence and box each, shape (M, 5)."""
        return self.tracker.step(state, _detections(rows))


class TruePeople:
    """Reports the true boxes under their true identities; privileged, without memory."""

    def initial(self, observation: Mapping[str, Array]) -> None:
        """Return None: there is no memory."""

    def step(self, state: None, observation: Mapping[str, Array]) -> tuple[None, SetEstimate]:
        """Report visible people; hold hidden ones with existence 0.1."""
        labels = observation["true_ids"].astype(np.int64)
        here = labels > 0
        boxes = np.asarray(observation["true_boxes"], dtype=np.float64)[here]
        existence = np.where(observation["true_existence"][here] > 0.5, 1.0, 0.1)
        return None, set_of_boxes(boxes, np.zeros((len(boxes), 4, 4)), labels[here], existence)


class VideoObserver:
    """An estimator of boxes behind `predict`: frames or detections in, sets of people out.

    Args:
        estimator: Estimator of one scene.
        space: Action space of one scene.
        whole: True passes the whole dictionary of a privileged observation to the estimator.
        centers: True answers with the centers of boxes.
        identities: True if the estimator's identities persist between frames; False fills rows in order.
    """

    def __init__(
        self,
        estimator: Estimator[Any, Any, SetEstimate],
        space: Any,
        *,
        whole: bool = False,
        centers: bool = False,
        identities: bool = True,
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
            observation: Image (H, W, 3) or rows (M, 5), or N of them; or a dictionary with that under `observation`
                and the truth beside it.
            state: Result of the last call; None starts every scene anew.
            episode_start: Scenes that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the answer is always deterministic.

        Returns:
            The answer, shape (rows, 1 + d) or (N, rows, 1 + d), and the new state.
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
        """Return the observation of each scene, and True if it came without a leading axis."""
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


def create_video_observer(
    env: Any, estimator: str, detector: str = "masked", values: Mapping[str, float] | None = None
) -> VideoObserver | SetObserver | RawObserver:
    """Create an observer of people on video; only the environment's spaces and its `scene_model` are read.

    Args:
        env: An environment or vector environment whose `scene_model` is a `VideoModel`.
        estimator: A name from `agents.people.catalog.TRACKERS`, "raw-measurements" or "people-oracle".
        detector: A name from `agents.people.catalog.DETECTORS`, used where the observation is an image.
        values: Numbers of the tracker that differ from its defaults, by path; see `with_values`.

    Raises:
        ValueError: An environment without a `VideoModel`, an unknown name, or values that do not fit the tracker.
    """
    scene = public_attribute(env, "scene_model")
    if not isinstance(scene, VideoModel):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {estimator!r} needs an environment whose `unwrapped.scene_model` is a VideoModel; "
            f"{name} has none: choose PedestrianTracking-v0 or VideoTracking-v0, or another agent"
        )
    space = getattr(env, "single_action_space", env.action_space)
    if estimator == "people-oracle":
        return VideoObserver(TruePeople(), space, whole=True, centers=not scene.answers_boxes)
    name = TRACKER_NAMES.get(estimator, estimator)
    if not scene.answers_boxes:
        found = with_values(centroid_filter(name, (scene.width, scene.height), scene.frame_rate), values or {})
        if isinstance(found, RawMeasurements):
            return RawObserver(found, space.low, space.high)
        return SetObserver(found, space.shape[0], space.low, space.high)
    tracker = with_values(create_tracker(name, (scene.width, scene.height), scene.frame_rate), values or {})
    made: Estimator[Any, Any, SetEstimate] = DetectionRows(tracker)
    if scene.observation == "pixels":
        made = DetectThenTrack(create_detector(detector, scene.frame_rate), tracker)
    return VideoObserver(made, space, identities=not isinstance(tracker, RawDetections))


def _detections(rows: Array) -> Detections:
    return detections_from_boxes(rows[rows[:, 0] >= 0.5, 1:])


def _with_axis(estimate: SetEstimate) -> SetEstimate:
    values = [getattr(estimate, name) for name in SetEstimate.__dataclass_fields__]
    return SetEstimate(*[add_axis(value) for value in values])
