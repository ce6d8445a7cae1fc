"""ColorTracking-v0: single-object tracking by color, with the box of the first frame given."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from servotrack.envs.arguments import available_render_modes, check_count
from servotrack.envs.box_scale import BoxScale
from servotrack.envs.track.color.config import LEVEL_NAMES, ColorConfig, color_config, color_level
from servotrack.envs.track.color.world import ColorWorld
from servotrack.envs.track.env import TrackEnv, TrackVectorEnv
from servotrack.estimators.types import Array

Observation = dict[str, NDArray[Any]]

METADATA: dict[str, Any] = {"servotrack_kind": "color", "render_modes": available_render_modes(), "render_fps": 25}


class ColorTrackingEnv(TrackEnv):
    """Track the head of a person in rendered color video, through motion, occlusion, distractors, scale and light.

    ## Description

    A camera records a person in a room at 25 frames per second. The bounding box of the person's head is given for the
    first frame; the agent then reports the box in every frame. Person, room, motion and light are random. Hair, face
    and clothes are separate layers that shift against each other as the head turns and tilts, so that the color
    histogram of the head changes all the time. Levels 0 to 5 are the scenarios of Zhang and Li 2008:

    | level | scenario |
    |---|---|
    | 0 `irregular` | speeds of up to 8 px per frame; the velocity changes three times per second on average |
    | 1 `occlusion` | an object occludes the head three times, for about 6 frames each |
    | 2 `distractor` | a person with a similar head stays close and passes behind the target |
    | 3 `scale` | the camera zooms in and out by a factor of up to 1.8 |
    | 4 `light` | brightness changes by a factor of up to 1.9, and the color of the light changes |
    | 5 `pan_zoom` | the camera pans and zooms |
    | 6 `rotation` | the person turns over in the image plane, with a standard deviation of 2.5 rad/s |
    | 7 `growth` | the person comes closer or moves away by a factor of up to 1.8 within some tenths of a second |

    ## Action Space

    `Box((4,), float64)`: left, top, width and height of the target in the newest frame, px; pixel i covers [i, i + 1].
    With `normalized_actions=True` it is `Box(-1, 1, (4,), float32)`, as libraries for reinforcement learning expect it:
    -1 and 1 are the bounds of the action in px, which lie up to one frame size outside the frame.

    ## Observation Space

    A `Dict`:

    | key | shape | type | meaning |
    |---|---|---|---|
    | `frame` | (245, 300, 3) | uint8 | newest frame, RGB |
    | `first_box` | (4,) | float64 | left, top, width and height of the target in the first frame of the episode, px |

    ## Rewards

    Intersection over union (IoU) of the answer and the true box of the same frame, 0 to 1. The true box encloses hair
    and face, including their occluded parts.

    `info` serves evaluation; agents must not use it. It holds `iou` and `center_error` (px) of the last answer, 0 at
    reset. `truth` holds `box` (4,), px, the true box of the newest frame. The scores of the one-pass evaluation (OPE)
    are 0 until the whole episode is answered, which `episode_scored` reports: `auc`, the area under the success curve
    (share of frames with an IoU above 0, 0.05, ..., 1); `precision`, the share of frames with a center error of at most
    20 px; and `failures`, the number of runs of frames without overlap. The first frame is scored, as in the object
    tracking benchmark.

    ## Starting State

    The first frame. Every quantity (person, room, path, pose, zoom, pan, light, occlusions, distractors, noise) is
    drawn from the seed by its own random stream, so that all agents get the same frames for the same seed.

    ## Episode End

    Truncation after `horizon` answers (default 200). The environment never terminates: the tracker is not restarted
    after it has lost the target. The last observation is not scored.

    ## Arguments

    `level` (0 to 7, default 0) or `scenario` (its name), and every field of `ColorConfig` as a keyword that overrides
    the value of the level, for example `gym.make("ColorTracking-v0", scenario="distractor", similarity=1.0,
    occlusions=2)`. `normalized_actions`: True for actions in [-1, 1], default False. `render_mode`: `rgb_array` or
    `human`.

    ## References

    Zhang and Li, "Object tracking with Monte Carlo methods", Journal of Image and Graphics 13(5), 2008, pp. 937-943,
    section 4. Wu, Lim and Yang, "Object tracking benchmark", IEEE TPAMI 37(9), 2015, pp. 1834-1848.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self,
        level: int = 0,
        scenario: str | None = None,
        *,
        normalized_actions: bool = False,
        render_mode: str | None = None,
        **axes: Any,
    ) -> None:
        self.level = color_level(level, scenario)
        self.config = color_config(self.level, **axes)
        observation, action, self._scale = _spaces(self.config, normalized_actions)
        super().__init__(ColorWorld(self.config, 1), observation, action, render_mode, "ColorTracking-v0")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode. Arguments and errors: see `TrackEnv.reset`.

        Returns:
            First frame with the box of the target, and info.
        """
        frame, info = super().reset(seed=seed, options=options)
        return self._observation(frame), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Answer the newest frame. Errors: see `TrackEnv.step`.

        Args:
            action: Left, top, width and height of the target, px.

        Returns:
            Next frame with the box of the first frame, reward, terminated, truncated, info.
        """
        frame, reward, terminated, truncated, info = super().step(action)
        return self._observation(frame), reward, terminated, truncated, info

    def _checked(self, action: Any) -> Array:
        return _in_pixels(super()._checked(action), self._scale)

    def _observation(self, frame: NDArray[Any]) -> Observation:
        return {"frame": frame, "first_box": self.world.first_boxes[0].copy()}

    def _make_recorder(self) -> Any:
        from servotrack.envs.track.color.render import ColorRecorder

        return ColorRecorder(self.world, 0)

    def __repr__(self) -> str:
        return f"<ColorTrackingEnv level {self.level} {LEVEL_NAMES[self.level]}>"


class ColorTrackingVectorEnv(TrackVectorEnv):
    """Vector environment of `ColorTracking-v0`, made by `gym.make_vec("ColorTracking-v0", num_envs=N)`.

    Args:
        num_envs: Number of scenes N.
        level: Level from 0 to 7; see `ColorTrackingEnv`.
        scenario: Name of a level, instead of `level`.
        normalized_actions: True for actions in [-1, 1] instead of px.
        render_mode: None or `rgb_array`; `render()` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: `horizon`.
        **axes: Fields of `ColorConfig`; see `ColorTrackingEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 0,
        scenario: str | None = None,
        *,
        normalized_actions: bool = False,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **axes: Any,
    ) -> None:
        self.level = color_level(level, scenario)
        self.config = color_config(self.level, **axes)
        observation, action, self._scale = _spaces(self.config, normalized_actions)
        world = ColorWorld(self.config, check_count(num_envs))
        super().__init__(world, num_envs, observation, action, render_mode, autoreset_mode, max_episode_steps)

    def _observe(self) -> Observation:
        return {"frame": self.world.observations.copy(), "first_box": self.world.first_boxes.copy()}

    def _checked(self, actions: Any) -> Array:
        return _in_pixels(super()._checked(actions), self._scale)

    def _recorder(self, row: int) -> Any:
        from servotrack.envs.track.color.render import ColorRecorder

        return ColorRecorder(self.world, row)


def _spaces(config: ColorConfig, normalized: bool) -> tuple[gym.spaces.Dict, gym.spaces.Box, BoxScale | None]:
    """Return observation and action space of one scene, and the scale of normalized actions.

    Boxes may lie up to one frame size outside the frame.
    """
    size = np.array([config.width, config.height], dtype=np.float64)
    low, high = np.concatenate([-size, np.zeros(2)]), np.concatenate([2.0 * size, 2.0 * size])
    frame = gym.spaces.Box(0, 255, (config.height, config.width, 3), np.uint8)
    box = gym.spaces.Box(low, high, dtype=np.float64)
    observation, action = (
        gym.spaces.Dict({"frame": frame, "first_box": box}),
        gym.spaces.Box(low, high, dtype=np.float64),
    )
    if not isinstance(normalized, bool):
        raise ValueError(f"normalized_actions must be True or False, got {normalized!r}")
    if not normalized:
        return observation, action, None
    scale = BoxScale(action, "action")
    return observation, scale.space, scale


def _in_pixels(values: Array, scale: BoxScale | None) -> Array:
    return values if scale is None else scale.restored(values)
