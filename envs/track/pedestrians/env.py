"""People on video: the world of the observers that count and follow them."""

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
    """Count people who walk through a lobby, say where they are, and keep them apart, by the frames of a camera.

    ## Description

    A camera looks down into a lobby. People come in at the sides, walk, stand, meet, go on together or apart, hide one
    another, and leave; a social force model moves them. The agent is an observer. It changes nothing in the world; it
    answers every frame with the set of people it believes in, and keeps their identities apart.

    | level | scene |
    |---|---|
    | 0 `plain` | four people on average, one in three standing, even light |
    | 1 `crossing` | five who cross each other's ways all the time |
    | 2 `crowd` | ten on average, in groups |
    | 3 `camouflage` | nine in ten clothes in the background's colors, more noise |
    | 4 `light` | cast shadows, flicker, slow drift of the light and a sudden change of it |
    | 5 `everything` | a crowd of eight with all of this, swaying plants, compression and pillars to walk behind |

    Every axis of difficulty is a keyword of its own. `script` chooses who comes when: `random`, `crossing`, `crowd`,
    `meet_split_third_guy` (the 922 frames of paper 000's sequence: two meet, become one region at about frame 450 and
    part at about 468, a third comes by), or `replay` with `source`, recorded tracks that people of our own walk again.

    The public attribute `scene_model` holds the parameters that agents may know, a
    `servotrack.envs.track.people.camera_model.VideoModel`.

    ## Action Space

    `Box((max_estimates, 5), float64)`: the answer, one row per identity: existence, then left, top, width and height of
    the box around the whole person, hidden parts included, cut at the frame's border, px. With
    `observation="centroids"` `Box((max_estimates, 3), float64)`: existence and the middle of that box. An existence of
    at least 0.5 reports the person; from 0.05 to 0.5 the row keeps its identity silently; below 0.05 the identity ends
    and the row is free for another.

    ## Observation Space

    By `observation`:

    * `pixels`: `Box(0, 255, (height, width, 3), uint8)`, an RGB frame;
    * `blobs`: `Box((max_measurements, 5), float64)`, what a motion detector finds: 1, then a box, px;
    * `centroids`: `Box((max_measurements, 3), float64)`: 1, then the center of gravity of each region, px.

    The detector is paper 000's (`servotrack.estimators.detect.MaskedBackground`), which has seen the lobby empty.
    People who stand together are one blob, somebody in the background's colors is several or none. Rows are in random
    order; unused rows are zeros at the end; where there are too many, the smallest regions are dropped.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each frame, over one minus IoU (c = 1) of boxes or the
    distance (c = 40 px) of centroids: a missed or a false person costs one half, a located one its error over c.

    People of whom less than a fifth is visible do not count: nobody misses them, and an answer at one of them (within
    half the cutoff; one answer for each, and only one that is at nobody who counts) is left out as if it had not been
    given, in rewards and in all scores.

    `info` holds, for evaluation and not for agents: `ospa`, `gospa` and its parts `location_error`, `missed_error`,
    `false_error`, `cardinality_error`, all of the last answer and from the first answer on; at the episode's end
    `ospa2`, OSPA(2) over the trajectories, where identity counts, and `mota`, `idf1` and `hota`; and `truth` of the
    newest frame, rows of `max_people`: `boxes` (left, top, width, height, px), `ids` (0 for nobody), `visibility` (from
    0 to 1) and `exists` (who counts). `world.true_tracks(0)` and `world.answered_tracks(0)` are the episode's tracks so
    far.

    ## Starting State

    Frame 0: an empty lobby, from which a background can be learned; after `empty_frames` (default 25) a lobby with
    people in it; with 0 they are there from the first frame on. Everything is drawn from the seed, each
    quantity from a stream of its own; all observers on one seed see the same frames.

    ## Episode End

    Never by termination. Truncation: after `horizon` answers (default 300). The frame that then comes is not scored.

    ## Arguments

    `level` (0 to 5, default 0) and every field of `PedestrianConfig` as a keyword that overrides the level's value, for
    example `gym.make("PedestrianTracking-v0", observation="blobs", people=8, shadow=0.5)`.
    `render_mode`: `rgb_array` or `human`; with `show_truth=True` pictures show true boxes, too.

    ## References

    Wu and Hu, "Multi-target tracking based on Gaussian mixture PHD filter in video", 2010 (paper 000). Helbing and
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
    """`PedestrianTracking-v0`, N at a time: what `gym.make_vec("PedestrianTracking-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of scenes N.
        level: As in `PedestrianTrackingEnv`.
        render_mode: None or `rgb_array`; frames of all N come as a tuple.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Shortens episodes, as `gym.make`'s argument of that name does.
        show_truth: Whether pictures show true boxes, too.
        **axes: As in `PedestrianTrackingEnv`.
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
    """What the agents of a scene are told about it."""
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
    # People are tracked beyond the border, and half a frame is enough for that.
    reach = [0.5 * config.width, 0.5 * config.height]
    low, far = [-x for x in reach], [x + r for x, r in zip(size, reach, strict=True)]
    if config.answers_boxes:
        low, far = [*low, 0.0, 0.0], [*far, *far]
    answers = set_space(config.estimate_rows, low, far)
    if config.observation == "pixels":
        return gym.spaces.Box(0, 255, (config.height, config.width, 3), np.uint8), answers
    return set_space(config.measurement_rows, [0.0] * len(high), high), answers
