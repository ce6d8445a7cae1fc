"""Point targets in clutter: the world of the random-finite-set filters."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from servotrack.envs.arguments import check_count
from servotrack.envs.track.clutter.config import LEVEL_NAMES, ClutterConfig, clutter_config
from servotrack.envs.track.clutter.scene_model import SceneModel, scene_model_of
from servotrack.envs.track.clutter.world import ClutterWorld
from servotrack.envs.track.env import METADATA, TrackEnv, TrackVectorEnv, set_space

_METADATA = METADATA | {"servotrack_kind": "clutter"}


class ClutterTrackingEnv(TrackEnv):
    """Count and locate targets, nobody knows how many, by scans in which some are missing and most is clutter.

    ## Description

    Targets move over a square region with nearly constant velocity. They appear and vanish. Every second a sensor
    delivers a scan: of each target at most one noisy measurement, and false measurements, in no order. The agent is an
    observer. It changes nothing in the world; it answers every scan with the set of targets it believes in, and keeps
    their identities apart.

    | level | world |
    |---|---|
    | 0 `paper` | paper 004: twelve targets at known times, 20 false measurements per scan, pairwise Markov noise S1 |
    | 1 `random` | births, deaths and motion drawn anew |
    | 2 `low detection` | detection probability 0.6, 60 false measurements per scan |
    | 3 `maneuvers` | targets that turn at up to 0.2 rad/s |
    | 4 `range-bearing` | a sensor beside the region measures range (5 m) and bearing (0.005 rad) |
    | 5 `wrong detection` | agents are told a detection probability of 0.98; it is 0.8 |
    | 6 `wrong clutter` | agents are told 5 false measurements per scan; there are 40 |
    | 7 `wrong births` | agents are told four birth sites; targets appear anywhere |

    The public attribute `scene_model` holds the parameters that agents may know, a
    `servotrack.envs.track.clutter.scene_model.SceneModel`.

    ## Action Space

    `Box((max_estimates, 3), float64)`: the answer, one row per identity: existence, x and y in m. An existence of at
    least 0.5 reports the target; from 0.05 to 0.5 the row keeps its identity silently; below 0.05 the identity ends and
    the row is free for another.

    ## Observation Space

    `Box((max_measurements, 3), float64)`: the scan, one row per measurement: 1, then x and y in m (range in m and
    bearing in rad at level 4). The rows are in random order; unused rows are zeros at the end. `max_measurements` is by
    default the most targets plus what the clutter exceeds once in 1e9 scans; on overflow only clutter is dropped.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each scan: a missed or a false target costs one half, a
    located one its error over c.

    `info` holds, for evaluation and not for agents: `ospa`, `gospa` and its parts `location_error`, `missed_error`,
    `false_error` (m), `cardinality_error`, all of the last answer and from the first answer on; at the episode's end
    `ospa2`, OSPA(2) over the trajectories, where identity counts (m); and `truth` of the newest scan: `states`
    (max_targets, 4) as x, vx, y, vy, `exists`, and `source`, the target behind each measurement (-1 clutter, -2 none).

    ## Starting State

    Scan one. Motion, births, deaths, detections, noise, clutter and order are drawn from the seed, each from a stream
    of its own; all observers on one seed see the same scans. In the paper's scenario a path that leaves the region is
    drawn again; at the other levels such a target is gone.

    ## Episode End

    Never by termination. Truncation: after `horizon` answers (default 100). The scan that then comes is not scored.

    ## Arguments

    `level` (0 to 7, default 0) and every field of `ClutterConfig` as a keyword that overrides the level's value, for
    example `gym.make("ClutterTracking-v0", level=1, detection_probability=0.9, max_targets=100, birth_rate=1.0)`.
    `render_mode`: `rgb_array` or `human`.

    ## References

    Zhang, Han, Lian and Zeng, "Cardinality balanced multi-target multi-Bernoulli filter for pairwise Markov model",
    Acta Automatica Sinica 43(12), 2017, pp. 2100-2108, section 3.2. Rahmathullah, Garcia-Fernandez and Svensson,
    "Generalized optimal sub-pattern assignment metric", FUSION 2017.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(self, level: int = 0, *, render_mode: str | None = None, **axes: Any) -> None:
        self.config = clutter_config(level, **axes)
        self.level = level
        self.scene_model: SceneModel = scene_model_of(self.config)
        super().__init__(ClutterWorld(self.config, 1), *_spaces(self.config), render_mode, "ClutterTracking-v0")

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.clutter.recorder import Recorder

        return Recorder(self.world, 0)

    def __repr__(self) -> str:
        return f"<ClutterTrackingEnv level {self.level} {LEVEL_NAMES[self.level]}>"


class ClutterTrackingVectorEnv(TrackVectorEnv):
    """`ClutterTracking-v0`, N at a time: what `gym.make_vec("ClutterTracking-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of scenes N.
        level: As in `ClutterTrackingEnv`.
        render_mode: None or `rgb_array`; frames of all N come as a tuple.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Shortens episodes, as `gym.make`'s argument of that name does.
        **axes: As in `ClutterTrackingEnv`.
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
        **axes: Any,
    ) -> None:
        self.config = clutter_config(level, **axes)
        self.level = level
        self.scene_model: SceneModel = scene_model_of(self.config)
        world = ClutterWorld(self.config, check_count(num_envs))
        super().__init__(world, num_envs, *_spaces(self.config), render_mode, autoreset_mode, max_episode_steps)

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.clutter.recorder import Recorder

        return Recorder(self.world, row)


def _spaces(config: ClutterConfig) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observation and action space of one scene."""
    bound = config.estimate_bound
    return (
        set_space(config.measurement_rows, *config.measurement_bounds),
        set_space(config.estimate_rows, [-bound, -bound], [bound, bound]),
    )
