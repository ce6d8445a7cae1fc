"""One colored object in a video, its box given in the first frame: the world of paper 001."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from servotrack.envs.arguments import RENDER_MODES, check_count
from servotrack.envs.track.color.config import LEVEL_NAMES, ColorConfig, color_config, color_level
from servotrack.envs.track.color.world import ColorWorld
from servotrack.envs.track.env import TrackEnv, TrackVectorEnv

Observation = dict[str, NDArray[Any]]

METADATA: dict[str, Any] = {"servotrack_kind": "color", "render_modes": list(RENDER_MODES), "render_fps": 25}


class ColorTrackingEnv(TrackEnv):
    """Keep a box around a head that moves, hides, grows and changes color, in a room full of colors like its own.

    ## Description

    A camera films a person in a room, at 25 frames a second. The box of the person's head is given in the first frame;
    from then on the agent says in every frame where it is. Person, room, motion and light are drawn anew for every
    seed: hair, face and clothes move a little apart as the head turns and tilts, so that its colors and their shares
    change all the time. The levels are the scenarios of paper 001:

    | level | scenario |
    |---|---|
    | 0 `irregular` | up to 8 px a frame, another velocity three times a second |
    | 1 `occlusion` | three times something passes before the head and hides it for about 6 frames |
    | 2 `distractor` | somebody with nearly the same head stays near and goes past behind the target |
    | 3 `scale` | the camera zooms in and out, up to 1.8 |
    | 4 `light` | the light gets brighter and darker, up to 1.9, warmer and colder |
    | 5 `pan_zoom` | the camera pans and zooms |

    ## Action Space

    `Box((4,), float64)`: left, top, width and height of the target in the newest frame, px; pixel i spans i to i + 1.
    `gymnasium.wrappers.RescaleAction` gives learners the range -1 to 1 that `check_env` recommends.

    ## Observation Space

    A `Dict`:

    | key | shape | type | meaning |
    |---|---|---|---|
    | `frame` | (245, 300, 3) | uint8 | the newest frame, RGB |
    | `first_box` | (4,) | float64 | left, top, width and height of the target in the episode's first frame, px |

    ## Rewards

    Intersection over union of the answer with the true box of the frame that was answered, 0 to 1. The true box holds
    hair and face, also those parts of it that something hides.

    `info` holds, for evaluation and not for agents: `iou` and `center_error` (px) of the last answer, from the first
    answer on; `truth` of the newest frame: `box` (4,), px; at the episode's end the scores of a one-pass evaluation:
    `auc`, the area under the success curve (share of frames with an overlap above 0, 0.05, ..., 1), `precision`, the
    share of frames with a center error of at most 20 px, and `failures`, the number of runs of frames without overlap.
    The first frame counts, as in the object tracking benchmark.

    ## Starting State

    The first frame. Every quantity (figure, room, path, pose, zoom, pan, light, occlusions, distractors, noise) is
    drawn from the seed by a stream of its own; all agents on one seed see the same frames.

    ## Episode End

    Never by termination, also when the target is lost: there is no second start. Truncation: after `horizon` answers
    (default 200). The frame that then comes is not scored.

    ## Arguments

    `level` (0 to 5, default 0) or `scenario` (its name), and every field of `ColorConfig` as a keyword that overrides
    the level's value, for example `gym.make("ColorTracking-v0", scenario="distractor", similarity=1.0, occlusions=2)`.
    `render_mode`: `rgb_array` or `human`.

    ## References

    Zhang and Li, "Object tracking with Monte Carlo methods", Journal of Image and Graphics 13(5), 2008, pp. 937-943,
    section 4. Wu, Lim and Yang, "Object tracking benchmark", IEEE TPAMI 37(9), 2015, pp. 1834-1848.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self, level: int = 0, scenario: str | None = None, *, render_mode: str | None = None, **axes: Any
    ) -> None:
        self.level = color_level(level, scenario)
        self.config = color_config(self.level, **axes)
        observation, action = _spaces(self.config)
        super().__init__(ColorWorld(self.config, 1), observation, action, render_mode, "ColorTracking-v0")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; arguments and errors as in `TrackEnv.reset`.

        Returns:
            The first frame with the target's box, and info.
        """
        frame, info = super().reset(seed=seed, options=options)
        return self._observation(frame), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Answer the newest frame; errors as in `TrackEnv.step`.

        Args:
            action: Left, top, width and height, px.

        Returns:
            The next frame with the first frame's box, reward, terminated, truncated, info.
        """
        frame, reward, terminated, truncated, info = super().step(action)
        return self._observation(frame), reward, terminated, truncated, info

    def _observation(self, frame: NDArray[Any]) -> Observation:
        return {"frame": frame, "first_box": self.world.first_boxes[0].copy()}

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.color.render import ColorRecorder

        return ColorRecorder(self.world, 0)

    def __repr__(self) -> str:
        return f"<ColorTrackingEnv level {self.level} {LEVEL_NAMES[self.level]}>"


class ColorTrackingVectorEnv(TrackVectorEnv):
    """`ColorTracking-v0`, N at a time: what `gym.make_vec("ColorTracking-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of scenes N.
        level: As in `ColorTrackingEnv`.
        scenario: As in `ColorTrackingEnv`.
        render_mode: None or `rgb_array`; frames of all N come as a tuple.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Shortens episodes, as `gym.make`'s argument of that name does.
        **axes: As in `ColorTrackingEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 0,
        scenario: str | None = None,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **axes: Any,
    ) -> None:
        self.level = color_level(level, scenario)
        self.config = color_config(self.level, **axes)
        observation, action = _spaces(self.config)
        world = ColorWorld(self.config, check_count(num_envs))
        super().__init__(world, num_envs, observation, action, render_mode, autoreset_mode, max_episode_steps)

    def _observe(self) -> Observation:
        return {"frame": self.world.observations.copy(), "first_box": self.world.first_boxes.copy()}

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.color.render import ColorRecorder

        return ColorRecorder(self.world, row)


def _spaces(config: ColorConfig) -> tuple[gym.spaces.Dict, gym.spaces.Box]:
    """Observation and action space of one scene; an answer may leave the frame by its size."""
    size = np.array([config.width, config.height], dtype=np.float64)
    low, high = np.concatenate([-size, np.zeros(2)]), np.concatenate([2.0 * size, 2.0 * size])
    frame = gym.spaces.Box(0, 255, (config.height, config.width, 3), np.uint8)
    box = gym.spaces.Box(low, high, dtype=np.float64)
    return gym.spaces.Dict({"frame": frame, "first_box": box}), gym.spaces.Box(low, high, dtype=np.float64)
