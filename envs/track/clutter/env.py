"""ClutterTracking-v0: multi-target tracking of point targets in clutter, the setting of random-finite-set filters."""

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
    """Track an unknown and changing number of point targets in scans with missed detections and clutter.

    ## Description

    Targets move over a square region with nearly constant velocity. They appear and disappear. Every second a sensor
    delivers a scan: at most one noisy measurement of each target, and false measurements (clutter), in random order.
    The agent is a passive observer: its actions do not influence the targets. It answers every scan with an estimate of
    the set of targets and of their identities. Answers may be delayed by `lag` scans, so that smoothers can be used:
    the answer to scan k is for scan k - lag.

    | level | world |
    |---|---|
    | 0 `paper` | Zhang et al. 2017: 12 targets at fixed times, 20 false detections per scan, pairwise Markov noise S1 |
    | 1 `random` | random births and deaths, up to 40 targets |
    | 2 `low detection` | detection probability 0.6, 60 false measurements per scan |
    | 3 `maneuvers` | targets turn at up to 0.2 rad/s |
    | 4 `range-bearing` | a sensor beside the region measures range (sigma 5 m) and bearing (sigma 0.005 rad) |
    | 5 `wrong detection` | the scene model gives a detection probability of 0.98; the true one is 0.8 |
    | 6 `wrong clutter` | the scene model gives 5 false measurements per scan; the true mean is 40 |
    | 7 `wrong births` | the scene model gives four birth sites; targets appear anywhere |

    `scenario` chooses other published scenarios, each with parameters, targets and births of its own, which keywords
    override as they do those of a level:

    | scenario | world |
    |---|---|
    | `vo-ma-2006` | Vo and Ma 2006, example 1: two targets that cross, a third that splits off, 50 false measurements |
    | `vo-ma-2006-pair` | Vo and Ma 2006, example 2: the two targets that cross |
    | `vo-demo` | demonstration of B.-T. Vo's Matlab code: the lives of `paper`, nearly, among 60 false measurements |
    | `williams-2015` | six targets that meet at one point in the middle of 201 scans, detection probability 0.5 |
    | `garcia-fernandez-2018` | four targets that come together in the middle of 81 scans, where one dies |
    | `pinto-2021` | MT3's task 2: 20 scans in which targets appear anywhere among 30 false measurements |

    The attribute `scene_model`, a `servotrack.envs.track.clutter.scene_model.SceneModel`, holds the parameters that
    agents may use: motion and measurement model, detection probability, clutter and births. On levels 5 to 7 one of
    them is wrong on purpose.

    ## Action Space

    `Box((max_estimates, 3), float64)`: the estimated set, one row per identity: existence probability, x and y in m. An
    existence of at least 0.5 reports the target. From 0.05 to 0.5 the target is not reported, but the row keeps its
    identity. Below 0.05 the identity ends and the row is free for another target.

    ## Observation Space

    `Box((max_measurements, 3), float64)`: the scan, one row per measurement: 1, then x and y in m (range in m and
    bearing in rad on level 4). The rows are in random order; unused rows at the end are zeros. By default
    `max_measurements` is `max_targets` plus the number of false measurements that is exceeded once in 1e9 scans. If a
    scan has more measurements than rows, false measurements are dropped.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer to each scan: a missed or a false target costs one half, a
    localized target costs its position error divided by c. The first `lag` answers precede the first scan and have
    reward 0.

    `info` serves evaluation; agents must not use it. It holds `scored`, True if the last answer was for a scan, and the
    scores of the last answer, 0 at reset: `ospa`, `gospa` and its parts `location_error`, `missed_error` and
    `false_error` (m), and `cardinality_error`. `ospa2` is OSPA(2) over the trajectories of the episode, which also
    penalizes identity switches (m); it is 0 until the whole episode is answered, which `episode_scored` reports.
    `truth` is the ground truth of the newest scan: `states` (max_targets, 4) as x, vx, y, vy; `exists`; and `source`,
    the index of the target that caused each measurement (-1 for clutter, -2 for an unused row).

    ## Starting State

    The first scan. Motion, births, deaths, detections, noise, clutter and order are drawn from the seed, each from its
    own random stream, so that all agents get the same scans for the same seed, with any lag. On level 0 a path that
    leaves the region is drawn again; on the other levels the target disappears. Targets that meet in the middle are
    drawn forward and backward from there, and may leave the region.

    ## Episode End

    Truncation after `horizon` + `lag` answers (default 100 + 0); the environment never terminates. The last observation
    is not scored.

    ## Arguments

    `level` (0 to 7, default 0), and every field of `ClutterConfig` as a keyword that overrides the value of the level,
    for example `gym.make("ClutterTracking-v0", level=1, detection_probability=0.9, max_targets=100, birth_rate=1.0)`.
    `render_mode`: `rgb_array` or `human`.

    ## References

    Zhang, Han, Lian and Zeng, "Cardinality balanced multi-target multi-Bernoulli filter for pairwise Markov model",
    Acta Automatica Sinica 43(12), 2017, pp. 2100-2108, section 3.2. Rahmathullah, Garcia-Fernandez and Svensson,
    "Generalized optimal sub-pattern assignment metric", FUSION 2017. Published scenarios: Vo and Ma, "The Gaussian
    mixture probability hypothesis density filter", IEEE Transactions on Signal Processing 54(11), 2006; Williams,
    "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA, and association-based MeMBer", IEEE Transactions on
    Aerospace and Electronic Systems 51(3), 2015; Garcia-Fernandez, Williams, Granstrom and Svensson, "Poisson
    multi-Bernoulli mixture filter: direct derivation and implementation", the same 54(4), 2018; Pinto et al., "Next
    generation multitarget trackers: random finite set methods vs transformer-based deep learning", FUSION 2021.

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
    """Vector environment of `ClutterTracking-v0`, made by `gym.make_vec("ClutterTracking-v0", num_envs=N)`.

    Args:
        num_envs: Number of scenes N.
        level: Level from 0 to 7; see `ClutterTrackingEnv`.
        render_mode: None or `rgb_array`; `render()` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: `horizon` + `lag`.
        **axes: Fields of `ClutterConfig`; see `ClutterTrackingEnv`.
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
