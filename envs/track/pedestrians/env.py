"""PedestrianTracking-v0: multi-person tracking in rendered video."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.arguments import check_count
from servotrack.envs.track.env import METADATA, TrackEnv, TrackVectorEnv, set_space
from servotrack.envs.track.pedestrians.config import (
    LEVEL_NAMES,
    PAPER_EMPTY_FRAMES,
    PedestrianConfig,
    pedestrian_config,
)
from servotrack.envs.track.pedestrians.world import PedestrianWorld
from servotrack.envs.track.people.camera_model import VideoModel

_METADATA = METADATA | {"servotrack_kind": "people", "render_fps": 25}


class PedestrianTrackingEnv(TrackEnv):
    """Track the people in the rendered video of a surveillance camera in a lobby, from pixels or from blobs.

    ## Description

    A camera looks down into a lobby. People enter at the sides, walk, stand, meet, continue together or apart, occlude
    each other, and leave; a social force model moves them. The agent is a passive observer: its actions do not
    influence the people. It answers every frame with an estimate of the set of people and of their identities.

    | level | scene |
    |---|---|
    | 0 `plain` | four people on average, one in three standing, constant light |
    | 1 `crossing` | five people whose paths cross all the time |
    | 2 `crowd` | ten people on average, in groups |
    | 3 `camouflage` | nine in ten clothes have colors of the background; more sensor noise |
    | 4 `light` | cast shadows, flicker, slow drift and a sudden change of the light |
    | 5 `everything` | a crowd of eight with the effects above, swaying plants, compression and occluding pillars |

    Every difficulty is a separate keyword. `script` selects the motion of the people: `random`, `crossing`, `crowd`,
    `meet_split_third_guy` (922 frames as in the CAVIAR sequence Meet_Split_3rdGuy: two people meet, form one region at
    about frame 450 and separate at about 468; a third passes), or `replay`, where rendered people walk along recorded
    tracks given by `source`.

    The attribute `scene_model`, a `servotrack.envs.track.people.camera_model.VideoModel`, holds the parameters that
    agents may use: frame size and rate, maximum number of people, and number of empty frames at the start.

    ## Action Space

    `Box((max_estimates, 5), float64)`: the estimated set, one row per identity: existence probability, then left, top,
    width and height of the bounding box of the whole person, including occluded parts, clipped at the frame border, px.
    With `observation="centroids"` `Box((max_estimates, 3), float64)`: existence and the center of that box. An
    existence of at least 0.5 reports the person. From 0.05 to 0.5 the person is not reported, but the row keeps its
    identity. Below 0.05 the identity ends and the row is free for another person.

    ## Observation Space

    Depends on `observation`:

    * `pixels`: `Box(0, 255, (height, width, 3), uint8)`, an RGB frame;
    * `blobs`: `Box((max_measurements, 5), float64)`, the regions of a motion detector: 1, then the box, px;
    * `centroids`: `Box((max_measurements, 3), float64)`: 1, then the center of gravity of each region, px.

    The motion detector is that of Wu and Hu 2010 (`servotrack.estimators.detect.MaskedBackground`), with the background
    learned from the empty lobby. People who stand close together form one blob; a person in background colors gives
    several blobs or none. The rows are in random order; unused rows at the end are zeros. If there are too many
    regions, the smallest ones are dropped.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each frame. The base distance is 1 - IoU of boxes, with
    c = 1, or the distance of centroids, with c = 40 px. A missed or a false person costs one half, a localized person
    costs its distance divided by c.

    People with a visible share below 0.2 are ignored, like the ignore regions of MOTChallenge: they do not count
    as missed, and an answer that matches one of them (within half the cut-off, one answer per ignored person, and only
    if no scored person is assigned to it) is left out of the reward and of all scores.

    `info` serves evaluation; agents must not use it. It holds the scores of the last answer, 0 at reset: `ospa`,
    `gospa` and its parts `location_error`, `missed_error` and `false_error`, and `cardinality_error`. The scores of the
    episode are 0 until it is answered as a whole, which `episode_scored` reports: `ospa2`, OSPA(2) over the
    trajectories, which also penalizes identity switches, and `mota`, `idf1` and `hota`. `truth` is the ground truth of
    the newest frame, `max_people` rows: `boxes` (left, top, width, height, px), `ids` (0 for an unused row),
    `visibility` (visible share, 0 to 1) and `exists` (True for scored people). `world.true_tracks(0)` and
    `world.answered_tracks(0)` return the tracks of the episode so far.

    ## Starting State

    Frame 0. The first `empty_frames` frames (default 25) show the empty lobby, so that a background can be learned;
    then the lobby is populated. With `empty_frames=0` people are present from the first frame on. Every quantity is
    drawn from the seed by its own random stream, so that all agents get the same frames for the same seed.

    ## Episode End

    Truncation after `horizon` answers (default 300); the environment never terminates. The last observation is not
    scored.

    ## Arguments

    `level` (0 to 5, default 0), and every field of `PedestrianConfig` as a keyword that overrides the value of the
    level, for example `gym.make("PedestrianTracking-v0", observation="blobs", people=8, shadow=0.5)`.
    `render_mode`: `rgb_array` or `human`. `show_truth=True` also draws the true boxes.

    ## References

    Wu and Hu, "Multi-target tracking based on Gaussian mixture PHD filter in video", 2010. Helbing and
    Molnar, "Social force model for pedestrian dynamics", Physical Review E 51(5), 1995. Rahmathullah, Garcia-Fernandez
    and Svensson, "Generalized optimal sub-pattern assignment metric", FUSION 2017.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(
        self, level: int = 0, *, render_mode: str | None = None, show_truth: bool = False, **axes: Any
    ) -> None:
        self._show_truth = show_truth
        self.config = pedestrian_config(level, **axes)
        self.level = level
        self.scene_model: VideoModel = scene_model_of(self.config)
        world = PedestrianWorld(self.config, 1)
        super().__init__(world, *_spaces(self.config), render_mode, "PedestrianTracking-v0")

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.people.recorder import PeopleRecorder

        return PeopleRecorder(self.world, 0, self._show_truth)

    def __repr__(self) -> str:
        return f"<PedestrianTrackingEnv level {self.level} {LEVEL_NAMES[self.level]}>"


class PedestrianTrackingVectorEnv(TrackVectorEnv):
    """Vector environment of `PedestrianTracking-v0`, made by `gym.make_vec("PedestrianTracking-v0", num_envs=N)`.

    Args:
        num_envs: Number of scenes N.
        level: Level from 0 to 5; see `PedestrianTrackingEnv`.
        render_mode: None or `rgb_array`; `render()` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: `horizon`.
        show_truth: If True, pictures also show the true boxes.
        **axes: Fields of `PedestrianConfig`; see `PedestrianTrackingEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 0,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        show_truth: bool = False,
        **axes: Any,
    ) -> None:
        self._show_truth = show_truth
        self.config = pedestrian_config(level, **axes)
        self.level = level
        self.scene_model: VideoModel = scene_model_of(self.config)
        world = PedestrianWorld(self.config, check_count(num_envs))
        super().__init__(world, num_envs, *_spaces(self.config), render_mode, autoreset_mode, max_episode_steps)

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.people.recorder import PeopleRecorder

        return PeopleRecorder(self.world, row, self._show_truth)


def scene_model_of(config: PedestrianConfig) -> VideoModel:
    """Return the scene model of an environment with these parameters."""
    paper = config.script == "meet_split_third_guy"
    return VideoModel(
        observation=config.observation,
        width=config.width,
        height=config.height,
        frame_rate=config.frame_rate,
        max_people=config.max_people,
        empty_frames=PAPER_EMPTY_FRAMES if paper else config.empty_frames,
        cutoff=config.score_cutoff,
    )


def _spaces(config: PedestrianConfig) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observation and action space of one scene."""
    size = [float(config.width), float(config.height)]
    high = size * 2 if config.answers_boxes else size
    # Trackers may follow people beyond the border, by up to half a frame.
    reach = [0.5 * config.width, 0.5 * config.height]
    low, far = [-x for x in reach], [x + r for x, r in zip(size, reach, strict=True)]
    if config.answers_boxes:
        low, far = [*low, 0.0, 0.0], [*far, *far]
    answers = set_space(config.estimate_rows, low, far)
    if config.observation == "pixels":
        return gym.spaces.Box(0, 255, (config.height, config.width, 3), np.uint8), answers
    return set_space(config.measurement_rows, [0.0] * len(high), high), answers
