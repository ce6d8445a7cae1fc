"""Bearings of ships out of noise: the world of the HMM sonar trackers."""

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
    """Count, locate and keep apart what a line of hydrophones hears, by a bearing-time record in which tracks cross.

    ## Description

    A passive sonar listens with a uniform line array of 48 elements from 500 to 1600 Hz. Every second it delivers a
    record: the power in each of 721 beams from 0 to 180 deg, over its noise level. A target is a ridge in these
    records, as broad as a beam, with skirts and sidelobes; it appears, moves at a degree a second or so, and vanishes.
    Tones and broadband sounds look different, loud targets hide faint ones, and where two tracks cross nothing but
    their motion tells which is which. The agent is an observer: it answers every record with the bearings it believes
    in, and keeps their identities apart. It may take its time: the answer to record k is for record k - lag.

    | level | world |
    |---|---|
    | 0 `rates` | paper 003's rates: a tone (-15 dB) and a broadband target (-10 dB) cross after 40 s |
    | 1 `cross30` | the same with its crossing after 30 s, at 1.5 deg/s |
    | 2 `random` | 1 to 6 tones and broadband targets of -26 to -14 dB, drawn anew |
    | 3 `trial` | like the paper's sea trial: 4 to 6 such targets, one of -5 dB, 3 crossings or more, colored noise |
    | 4 `faint` | level 1, 20 dB fainter |
    | 5 `noise` | nobody is there |

    SNRs are of one target in one element, over all its noise up to 6 kHz. `snr_offset` makes any level harder.

    The public attribute `scene_model` is what agents are told: their own receiver and the lag, see
    `servotrack.envs.track.sonar.array_model.SonarModel`.

    ## Action Space

    `Box((max_estimates, 2), float64)`: the answer, one row per identity: existence, and bearing in deg. An existence of
    at least 0.5 reports the target; from 0.05 to 0.5 the row keeps its identity silently; below 0.05 the identity ends
    and the row is free for another.

    ## Observation Space

    `Box((721,), float64)`: the newest record, mean power of each beam over the noise level, which a two-pass truncated
    mean over the beams finds: noise has mean 1 and standard deviation 0.03, and the paper's targets reach 9 and 27.
    Beams look in equal steps from 0 to 180 deg. Powers are cut at a bound that the loudest scene does not reach.

    ## Rewards

    `-GOSPA(c = cutoff, p = 1, alpha = 2) / c` of the answer: a missed or a false target costs one half, a located one
    its error over c. The first `lag` answers, which are for no record, have reward 0.

    `info` holds, for evaluation and not for agents: `scored`, whether the last answer was for a record; `ospa`, `gospa`
    and its parts `location_error`, `missed_error`, `false_error` (deg), `cardinality_error`, all of the last answer and
    from the first answer on; at the episode's end `ospa2`, OSPA(2) over the trajectories, where identity counts (deg);
    and `truth` of the newest record: `bearings` (max_targets,), deg, `rates`, deg/s, and `exists`.

    ## Starting State

    The first record. Lives, motion, sounds and every record's noise are drawn from the seed, each from a stream of its
    own; all observers on one seed see the same records, whatever their lag. A target that passes 0 or 180 deg comes
    back: the array cannot tell its two sides apart.

    ## Episode End

    Never by termination. Truncation: after `horizon` + `lag` answers (levels 0, 1 and 4: 60 + 5). The record that then
    comes is not answered.

    ## Arguments

    `level` (0 to 5, default 0), and every field of `SonarConfig` as a keyword that overrides the level's value, for
    example `gym.make("SonarTracking-v0", variant="trial", snr_offset=-10, lag=0)`. `render_mode`: `rgb_array` or
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
    """`SonarTracking-v0`, N at a time: what `gym.make_vec("SonarTracking-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of scenes N.
        level: As in `SonarTrackingEnv`.
        render_mode: None or `rgb_array`; frames of all N come as a tuple.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Shortens episodes, as `gym.make`'s argument of that name does.
        **axes: As in `SonarTrackingEnv`.
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
    observation = gym.spaces.Box(0.0, config.most_power, (config.beams,), dtype=np.float64)
    return observation, set_space(config.estimate_rows, [0.0], [180.0])
