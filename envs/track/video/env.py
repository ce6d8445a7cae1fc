"""VideoTracking-v0: multi-person tracking in recorded video, image folders and MOTChallenge sequences."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.arguments import check_count, check_keywords
from servotrack.envs.track.env import METADATA, TrackEnv, TrackVectorEnv, set_space
from servotrack.envs.track.people.camera_model import VideoModel
from servotrack.envs.track.video.recording import VideoConfig, detection_bounds
from servotrack.envs.track.video.world import VideoWorld

_METADATA = METADATA | {"servotrack_kind": "people", "render_fps": 25}


class VideoTrackingEnv(TrackEnv):
    """Track the people in a recorded video, image folder, MOTChallenge sequence or camera; scored if truth is given.

    ## Description

    The frames of a sequence are observed one by one. The source is a video file, a folder of images, the folder of a
    MOTChallenge sequence (img1, det, gt, seqinfo.ini), or a camera. The agent is a passive observer: it answers every
    frame with an estimate of the set of people and of their identities. Without `source` the sequence consists of 60
    frames rendered by `PedestrianTracking-v0`, so that the environment works without any data.

    The attribute `scene_model`, a `servotrack.envs.track.people.camera_model.VideoModel`, holds the parameters that
    agents may use: frame size and rate, and maximum number of people.

    ## Action Space

    `Box((max_estimates, 5), float64)`: the estimated set, one row per identity: existence probability, then left, top,
    width and height of the bounding box of the person, px of the observed frames. An existence of at least 0.5 reports
    the person. From 0.05 to 0.5 the person is not reported, but the row keeps its identity. Below 0.05 the identity
    ends and the row is free for another person.

    ## Observation Space

    Depends on `observation`:

    * `pixels`: `Box(0, 255, (height, width, 3), uint8)`, an RGB frame;
    * `detections`: `Box((max_measurements, 5), float64)`, one row per detection in det/det.txt of the sequence: 1, then
      the box, px, in the order of the file; unused rows at the end are zeros.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each frame, with 1 - IoU as base distance (c = 1): a
    missed or a false person costs one half, a localized person costs 1 - IoU. People with a visible share below 0.2
    according to the ground truth are ignored: they do not count as missed, and an answer that matches one of
    them is left out. Without ground truth the reward is 0.

    `info` serves evaluation; agents must not use it. It holds `scored`, True if the last answer was compared with
    ground truth. Only with ground truth it also holds the scores of the last answer, 0 at reset: `ospa`, `gospa` and
    its parts `location_error`, `missed_error` and `false_error`, and `cardinality_error`; and the scores of the
    episode, 0 until it is answered as a whole, which `episode_scored` reports: `ospa2`, OSPA(2) over the trajectories,
    and `mota`, `idf1` and `hota`. `truth` is the ground truth of the newest frame, with as many rows as
    people in the fullest frame: `boxes` (left, top, width, height, px), `ids` (numbered from 1 in the order of the ids
    of the file, 0 for an unused row), `visibility` and `exists` (True for scored people).

    ## Starting State

    The frame `start`. Nothing is random: every seed gives the same frames. Only a camera never repeats its frames.

    ## Episode End

    Truncation after the last frame or after `horizon` answers; the environment never terminates. If decoding ends
    before the number of frames that the source claims, a warning is given. The last observation repeats the last frame.

    ## Arguments

    Every field of `servotrack.envs.track.video.recording.VideoConfig`, for example `gym.make("VideoTracking-v0",
    source="vtest.avi", truth="PETS2009-S2L1.xml", width=384)` or `gym.make("VideoTracking-v0", source="TUD-Campus",
    observation="detections")`. `truth` is a gt.txt of MOTChallenge or an XML file of CAVIAR; the gt/gt.txt of a
    MOTChallenge folder is found automatically. `render_mode`: `rgb_array` or `human`. `show_truth=True` also draws the
    true boxes.

    ## References

    Leal-Taixe, Milan, Reid, Roth and Schindler, "MOTChallenge 2015: towards a benchmark for multi-target tracking",
    arXiv:1504.01942. List and Fisher, "CVML - an XML-based computer vision markup language", ICPR 2004 (CAVIAR).
    Rahmathullah, Garcia-Fernandez and Svensson, "Generalized optimal sub-pattern assignment metric", FUSION 2017.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(self, *, render_mode: str | None = None, show_truth: bool = False, **axes: Any) -> None:
        self._show_truth = show_truth
        self.config = video_config(**axes)
        world = VideoWorld(self.config, 1, pictures=render_mode is not None)
        self.scene_model: VideoModel = scene_model_of(world)
        super().__init__(world, *_spaces(world), render_mode, "VideoTracking-v0")

    def close(self) -> None:
        """Close the window, if one is open, and the source."""
        self.world.close()
        super().close()

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.people.recorder import PeopleRecorder

        return PeopleRecorder(self.world, 0, self._show_truth)

    def __repr__(self) -> str:
        return f"<VideoTrackingEnv {self.world.recording.name}>"


class VideoTrackingVectorEnv(TrackVectorEnv):
    """Vector environment of `VideoTracking-v0`, made by `gym.make_vec("VideoTracking-v0", num_envs=N)`.

    All sub-environments observe the same sequence, each with its own decoder.

    Args:
        num_envs: Number of observers N.
        render_mode: None or `rgb_array`; `render()` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: all frames.
        show_truth: If True, pictures also show the true boxes.
        **axes: Fields of `VideoConfig`; see `VideoTrackingEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        show_truth: bool = False,
        **axes: Any,
    ) -> None:
        self._show_truth = show_truth
        self.config = video_config(**axes)
        world = VideoWorld(self.config, check_count(num_envs), pictures=render_mode is not None)
        self.scene_model: VideoModel = scene_model_of(world)
        super().__init__(world, num_envs, *_spaces(world), render_mode, autoreset_mode, max_episode_steps)

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.people.recorder import PeopleRecorder

        return PeopleRecorder(self.world, row, self._show_truth)


def video_config(**axes: Any) -> VideoConfig:
    """Return the configuration with some fields set.

    Raises:
        ValueError: If a value is outside its bounds.
        TypeError: If a keyword is unknown; the message suggests the nearest known one.
    """
    check_keywords(axes, [field.name for field in fields(VideoConfig)])
    return VideoConfig(**axes)


def scene_model_of(world: VideoWorld) -> VideoModel:
    """Return the scene model of a sequence."""
    recording, config = world.recording, world.config
    return VideoModel(
        observation="pixels" if recording.detections is None else "blobs",
        width=recording.width,
        height=recording.height,
        frame_rate=recording.frame_rate,
        max_people=config.max_estimates,
        empty_frames=0,
        cutoff=config.cutoff,
    )


def _spaces(world: VideoWorld) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observation and action space of one observer."""
    recording = world.recording
    low, high = detection_bounds(recording.width, recording.height)
    answers = set_space(world.config.max_estimates, low, high)
    if recording.detections is None:
        return gym.spaces.Box(0, 255, (recording.height, recording.width, 3), np.uint8), answers
    return set_space(recording.detections.shape[1], low, high), answers
