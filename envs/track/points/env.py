"""RecordedPoints-v0: multi-target tracking of recorded points of a radar, of ships or of any other sensor."""

from __future__ import annotations

from dataclasses import fields
from functools import cached_property
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.arguments import check_count, check_keywords
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.envs.track.env import METADATA, TrackEnv, TrackVectorEnv, set_space
from servotrack.envs.track.points.recording import PointsConfig
from servotrack.envs.track.points.scene_model import scene_model_of
from servotrack.envs.track.points.world import PointsWorld
from servotrack.envs.wrappers import INTERVAL_KEY, NOISE_KEY, OBSERVATION_KEY

_METADATA = METADATA | {"servotrack_kind": "clutter"}


class RecordedPointsEnv(TrackEnv):
    """Track the targets in a file of recorded points, at the times of their measurements; scored if truth is given.

    ## Description

    The scans of a file are observed one by one: positions that a radar measured, messages of ships, or the positions of
    any detector, as CSV with the columns time, x, y[, z] or time, lat, lon. The intervals between scans may vary. The
    agent is a passive observer: it answers every scan with an estimate of the set of targets and of their identities.
    Answers may be delayed by `lag` scans, so that smoothers can be used: the answer to scan k is for scan k - lag.
    Without `source` the environment plays 60 scans that the clutter environment draws, so that it works without
    any data.

    The attribute `scene_model`, a `servotrack.envs.track.clutter.scene_model.SceneModel`, holds the parameters that
    agents may use: motion, position noise, detection probability, clutter, births and survival. They are measured from
    the first 300 scans of the file, without the truth, as `servotrack track` measures them; this takes some seconds
    when an agent first reads the attribute. What is per scan is per usual interval,
    the one that nine of ten intervals do not exceed.

    ## Action Space

    `Box((max_estimates, 1 + d), float64)`: the estimated set, one row per identity: existence probability, then x, y[,
    z] in m. An existence of at least 0.5 reports the target. From 0.05 to 0.5 the target is not reported, but the row
    keeps its identity. Below 0.05 the identity ends and the row is free for another target. By default `max_estimates`
    is twice the number of points of the fullest scan and 16.

    ## Observation Space

    `Dict` of

    * `observation`: `Box((M, 1 + d), float64)`, the scan, one row per point: 1, then x, y[, z] in m, in the order of
      the file. M is the number of points of the fullest scan; unused rows at the end are zeros. Latitudes and
      longitudes become m in a plane about the first position, with x to the east and y to the north;
    * `interval`: `Box((1,), float64)`, the time since the scan before, s; at the first scan the median interval;
    * `noise`, if the file has covariances: `Box((M, d, d), float64)`, that of each point, m^2; zeros in unused rows.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each scan at which the truth is known: a missed or a
    false target costs one half, a localized target costs its position error divided by c. Without truth, before the
    truth begins and after it ends the reward is 0. The first `lag` answers precede the first scan and have reward 0.

    `info` serves evaluation; agents must not use it. It holds `scored`, True if the last answer was compared with the
    truth. Only with truth it also holds the scores of the last answer, 0 at reset: `ospa`, `gospa` and its parts
    `location_error`, `missed_error` and `false_error` (m), and `cardinality_error`. `ospa2` is OSPA(2) over the
    trajectories of the episode, which also penalizes identity switches (m); it is 0 until the whole episode is
    answered, which `episode_scored` reports. `truth` is the ground truth of the newest scan: `positions` (n, d) of all
    n targets of the truth; `exists`; and `source`, the index of the target of each point (-1 for none, -2 for an unused
    row), by the identities in the file, or without these by the assignment to true positions of the least total
    distance.

    ## Starting State

    The scan `start`. Nothing is random: every seed gives the same scans.

    ## Episode End

    Truncation after `horizon` + `lag` answers, by default as many as there are scans; the environment never terminates.
    The last observation is not scored; behind the last scan it repeats that scan.

    ## Arguments

    Every field of `servotrack.envs.track.points.recording.PointsConfig`, for example
    `gym.make("RecordedPoints-v0", source="radar.csv", truth="truth.csv", lag=10)`. `truth` is a file of positions with
    a column of identities, between whose rows targets move on straight lines. `render_mode`: `rgb_array` or `human`.

    ## References

    Rahmathullah, Garcia-Fernandez and Svensson, "Generalized optimal sub-pattern assignment metric", FUSION 2017.
    Beard, Vo and Vo, "OSPA(2): using the OSPA metric to evaluate multi-target tracking performance", ICCAIS 2017.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(self, *, render_mode: str | None = None, **axes: Any) -> None:
        self.config = points_config(**axes)
        world = PointsWorld(self.config, 1)
        super().__init__(world, *_spaces(world), render_mode, "RecordedPoints-v0")

    @cached_property
    def scene_model(self) -> SceneModel:
        """Scene model that agents get, measured from the points."""
        return scene_model_of(self.world.recording)

    def _observe(self) -> Any:
        return {key: value[0].copy() for key, value in self.world.observations.items()}

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.points.recorder import PointsRecorder

        return PointsRecorder(self.world, 0)

    def __repr__(self) -> str:
        return f"<RecordedPointsEnv {self.world.recording.name}>"


class RecordedPointsVectorEnv(TrackVectorEnv):
    """Vector environment of `RecordedPoints-v0`, made by `gym.make_vec("RecordedPoints-v0", num_envs=N)`.

    All sub-environments observe the same scans.

    Args:
        num_envs: Number of observers N.
        render_mode: None or `rgb_array`; `render()` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: all scans.
        **axes: Fields of `PointsConfig`; see `RecordedPointsEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **axes: Any,
    ) -> None:
        self.config = points_config(**axes)
        world = PointsWorld(self.config, check_count(num_envs))
        super().__init__(world, num_envs, *_spaces(world), render_mode, autoreset_mode, max_episode_steps)

    @cached_property
    def scene_model(self) -> SceneModel:
        """Scene model that agents get, measured from the points."""
        return scene_model_of(self.world.recording)

    def _observe(self) -> Any:
        return {key: value.copy() for key, value in self.world.observations.items()}

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.points.recorder import PointsRecorder

        return PointsRecorder(self.world, row)


def points_config(**axes: Any) -> PointsConfig:
    """Return the configuration with some fields set.

    Raises:
        ValueError: If a value is outside its bounds.
        TypeError: If a keyword is unknown; the message suggests the nearest known one.
    """
    check_keywords(axes, [field.name for field in fields(PointsConfig)])
    return PointsConfig(**axes)


def _spaces(world: PointsWorld) -> tuple[gym.spaces.Dict, gym.spaces.Box]:
    """Observation and action space of one observer."""
    recording = world.recording
    low, high = recording.region
    longest = float(recording.intervals.max())
    seen: dict[str, gym.Space[Any]] = {
        OBSERVATION_KEY: set_space(recording.measurements.shape[1], low, high),
        INTERVAL_KEY: gym.spaces.Box(0.0, longest, (1,), np.float64),
    }
    if recording.noises is not None:
        largest = float(np.abs(recording.noises).max())
        seen[NOISE_KEY] = gym.spaces.Box(-largest, largest, recording.noises.shape[1:], np.float64)
    return gym.spaces.Dict(seen), set_space(recording.estimate_rows, low, high)
