"""SonarTracking-v0: multi-target bearing tracking with a passive sonar."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.arguments import check_count
from servotrack.envs.track.env import METADATA, TrackEnv, TrackVectorEnv, set_space
from servotrack.envs.track.sonar.array_model import SonarModel, scene_model_of
from servotrack.envs.track.sonar.config import LEVEL_NAMES, SonarConfig, sonar_config
from servotrack.envs.track.sonar.world import SonarWorld

_METADATA = METADATA | {"servotrack_kind": "sonar"}


class SonarTrackingEnv(TrackEnv):
    """Track an unknown number of targets with crossing bearings in the beam powers of a passive sonar.

    ## Description

    A passive sonar with a uniform line array of 48 elements receives 500 to 1600 Hz. Every second it delivers a record:
    the power in each of 721 beams from 0 to 180 deg, relative to the noise level. In the bearing-time record a target
    is a ridge with the width of a beam and with sidelobes. Targets appear, move at about 1 deg/s and disappear. Tonal
    and broadband targets have different beam patterns, and loud targets mask faint ones. Where two tracks cross, only
    their motion distinguishes them. The agent is a passive observer: it answers every record with an estimate of the
    set of bearings and of their identities. Answers are delayed by `lag` records, so that smoothers can be used: the
    answer to record k is for record k - lag.

    | level | world |
    |---|---|
    | 0 `rates` | Jiang and Zhou 2016, their rates: a tone (-15 dB) and a broadband target (-10 dB) cross after 40 s |
    | 1 `cross30` | the same targets at 1.5 deg/s; they cross after 30 s |
    | 2 `random` | 1 to 6 random tonal and broadband targets with -26 to -14 dB |
    | 3 `trial` | like their sea trial: 4 to 6 such targets, one with -5 dB, at least 3 crossings, colored noise |
    | 4 `faint` | level 1 with an SNR that is 20 dB lower |
    | 5 `noise` | no targets, only noise |

    SNRs are those of one target in one element, relative to its noise power up to 6 kHz. A negative `snr_offset` makes
    any level harder.

    The attribute `scene_model`, a `servotrack.envs.track.sonar.array_model.SonarModel`, describes the receiver and the
    lag for the agents. It contains nothing about the targets.

    ## Action Space

    `Box((max_estimates, 2), float64)`: the estimated set, one row per identity: existence probability, and bearing in
    deg. An existence of at least 0.5 reports the target. From 0.05 to 0.5 the target is not reported, but the row keeps
    its identity. Below 0.05 the identity ends and the row is free for another target.

    ## Observation Space

    `Box((721,), float64)`: the newest record: mean power of each beam, divided by the noise level, which is estimated
    by a two-pass truncated mean over the beams. Noise has mean 1 and standard deviation 0.03; the targets of level 0
    reach 9 and 27. The beams have equally spaced bearings from 0 to 180 deg. Powers are clipped at a bound above the
    loudest scene.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer: a missed or a false target costs one half, a localized
    target costs its bearing error divided by c. The first `lag` answers precede the first record and have reward 0.

    `info` serves evaluation; agents must not use it. It holds `scored`, True if the last answer was for a record, and
    the scores of the last answer, 0 at reset: `ospa`, `gospa` and its parts `location_error`, `missed_error` and
    `false_error` (deg), and `cardinality_error`. `ospa2` is OSPA(2) over the trajectories of the episode, which also
    penalizes identity switches (deg); it is 0 until the whole episode is answered, which `episode_scored` reports.
    `truth` is the ground truth of the newest record: `bearings` (max_targets,), deg; `rates`, deg/s; and `exists`.

    ## Starting State

    The first record. Lifetimes, motion, sounds and the noise of every record are drawn from the seed, each from its own
    random stream, so that all agents get the same records for the same seed, with any lag. The bearing of a target that
    passes 0 or 180 deg is reflected, because a line array cannot distinguish its two sides.

    ## Episode End

    Truncation after `horizon` + `lag` answers (levels 0, 1 and 4: 60 + 5); the environment never terminates. The last
    observation is not answered.

    ## Arguments

    `level` (0 to 5, default 0), and every field of `SonarConfig` as a keyword that overrides the value of the level,
    for example `gym.make("SonarTracking-v0", variant="trial", snr_offset=-10, lag=0)`. `render_mode`: `rgb_array` or
    `human`.

    ## References

    Jiang and Zhou, "Application of hidden Markov model in multi-target automatic detection and tracking", Technical
    Acoustics and Electronic Engineering (Sheng Xue Yu Dian Zi Gong Cheng), 2016(4). Rahmathullah, Garcia-Fernandez and
    Svensson, "Generalized optimal sub-pattern assignment metric", FUSION 2017.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = _METADATA  # type: ignore[misc]

    def __init__(self, level: int = 0, *, render_mode: str | None = None, **axes: Any) -> None:
        self.config = sonar_config(level, **axes)
        self.level = level
        self.scene_model: SonarModel = scene_model_of(self.config)
        super().__init__(SonarWorld(self.config, 1), *_spaces(self.config), render_mode, "SonarTracking-v0")

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.sonar.recorder import SonarRecorder

        return SonarRecorder(self.world, 0)

    def __repr__(self) -> str:
        return f"<SonarTrackingEnv level {self.level} {LEVEL_NAMES[self.level]}>"


class SonarTrackingVectorEnv(TrackVectorEnv):
    """Vector environment of `SonarTracking-v0`, made by `gym.make_vec("SonarTracking-v0", num_envs=N)`.

    Args:
        num_envs: Number of scenes N.
        level: Level from 0 to 5; see `SonarTrackingEnv`.
        render_mode: None or `rgb_array`; `render()` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: `horizon` + `lag`.
        **axes: Fields of `SonarConfig`; see `SonarTrackingEnv`.
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
        self.config = sonar_config(level, **axes)
        self.level = level
        self.scene_model: SonarModel = scene_model_of(self.config)
        world = SonarWorld(self.config, check_count(num_envs))
        super().__init__(world, num_envs, *_spaces(self.config), render_mode, autoreset_mode, max_episode_steps)

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.sonar.recorder import SonarRecorder

        return SonarRecorder(self.world, row)


def _spaces(config: SonarConfig) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observation and action space of one scene."""
    observation = gym.spaces.Box(0.0, config.max_power, (config.beams,), dtype=np.float64)
    return observation, set_space(config.estimate_rows, [0.0], [180.0])
