"""Real sequences as a world: a video, a folder of images or a MOTChallenge sequence, answered frame by frame."""

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
    """Count people in a real sequence, say where they are, and keep them apart; scored where the truth is known.

    ## Description

    A recorded sequence is shown frame by frame: a video file, a folder of images, the folder of a MOTChallenge sequence
    (img1, det, gt, seqinfo.ini), or a camera. The agent is an observer. It answers every frame with the set of people
    it believes in, and keeps their identities apart. Without `source` the sequence is 60 frames that
    `PedestrianTracking-v0` rendered, so that the environment works where there is no data.

    The public attribute `scene_model` holds the parameters that agents may know, a
    `servotrack.envs.track.people.camera_model.VideoModel`.

    ## Action Space

    `Box((max_estimates, 5), float64)`: the answer, one row per identity: existence, then left, top, width and height of
    the box around the person, px of the frames that are shown. An existence of at least 0.5 reports the person; from
    0.05 to 0.5 the row keeps its identity silently; below 0.05 the identity ends and the row is free for another.

    ## Observation Space

    By `observation`:

    * `pixels`: `Box(0, 255, (height, width, 3), uint8)`, an RGB frame;
    * `detections`: `Box((max_measurements, 5), float64)`, one row per detection of the sequence's det/det.txt: 1, then
      its box, px, in the order of the file; unused rows are zeros at the end.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each frame over one minus IoU (c = 1): a missed or a
    false person costs one half, a located one its error. People of whom less than a fifth is visible do not count,
    where the truth tells; an answer at one of them is left out. Without truth the reward is 0.

    `info` holds, for evaluation and not for agents: `scored`, whether there is truth, and only where there is, `ospa`,
    `gospa` and its parts `location_error`, `missed_error`, `false_error`, `cardinality_error`, of the last answer and
    from the first answer on; at the episode's end `ospa2`, OSPA(2) over the trajectories, and `mota`, `idf1`, `hota`;
    and `truth` of the newest frame, rows as many as there are people at most: `boxes` (left, top, width, height, px),
    `ids` (0 for nobody, numbered from 1 in the order of the file's), `visibility` and `exists` (who counts).

    ## Starting State

    The frame `start`. The sequence is what it is: every seed shows the same frames, and nothing is random. Only a
    camera never shows the same again.

    ## Episode End

    Never by termination. Truncation: after the last frame, or after `horizon` answers; with a warning where decoding
    ends before the frames that the source claims to have. After the last answer the last frame is shown again.

    ## Arguments

    Every field of `servotrack.envs.track.video.recording.VideoConfig`, for example `gym.make("VideoTracking-v0",
    source="vtest.avi", truth="PETS2009-S2L1.xml", width=384)` or `gym.make("VideoTracking-v0", source="TUD-Campus",
    observation="detections")`. `truth` is MOTChallenge's gt.txt or CAVIAR's XML; that of a MOTChallenge folder is
    found. `render_mode`: `rgb_array` or `human`; with `show_truth=True` pictures show true boxes, too.

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
        """Close the window, if there is one, and let go of the source."""
        self.world.close()
        super().close()

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.people.recorder import PeopleRecorder

        return PeopleRecorder(self.world, 0, self._show_truth)

    def __repr__(self) -> str:
        return f"<VideoTrackingEnv {self.world.recording.name}>"


class VideoTrackingVectorEnv(TrackVectorEnv):
    """`VideoTracking-v0`, N at a time: what `gym.make_vec("VideoTracking-v0", num_envs=N)` makes.

    All show the same sequence, each by a decoder of its own.

    Args:
        num_envs: Number of observers N.
        render_mode: None or `rgb_array`; frames of all N come as a tuple.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Shortens episodes, as `gym.make`'s argument of that name does.
        show_truth: Whether pictures show true boxes, too.
        **axes: As in `VideoTrackingEnv`.
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
    """The configuration with some fields set.

    Raises:
        ValueError: A value outside its bounds.
        TypeError: An unknown keyword; the message suggests the nearest known one.
    """
    check_keywords(axes, [field.name for field in fields(VideoConfig)])
    return VideoConfig(**axes)


def scene_model_of(world: VideoWorld) -> VideoModel:
    """What the agents are told about a sequence."""
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
