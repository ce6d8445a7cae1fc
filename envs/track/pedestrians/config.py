"""Parameters of the pedestrian environment, and the levels that set them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from servotrack.envs.arguments import check_fields, check_keywords, check_level

SCRIPTS = ("random", "crossing", "crowd", "meet_split_third_guy", "replay")
POPULATED = ("random", "crossing", "crowd")
"""Scripts in which `people` sets the mean number of people."""
OBSERVATIONS = ("pixels", "blobs", "centroids")
PAPER_FRAMES = 922
"""Length of the CAVIAR sequence Meet_Split_3rdGuy, which Wu and Hu 2010 use, frames."""
PAPER_FRAME_RATE = 25.0
"""Frame rate of that sequence, frames per second."""
PAPER_EMPTY_FRAMES = 49
"""Number of empty frames at the start of that sequence."""
BOX_CUTOFF, POINT_CUTOFF = 1.0, 40.0
"""Default cut-off c of reward and scores: 1 - IoU for boxes, px for centroids."""


@dataclass(frozen=True)
class PedestrianConfig:
    """Parameters of a pedestrian environment. Most difficulties of the picture are off by default.

    Attributes:
        script: Motion of the people: `random`, `crossing`, `crowd`, `meet_split_third_guy`, or `replay`.
        source: Recorded tracks to replay: a CAVIAR XML file, MOTChallenge's gt.txt or the folder of a sequence
            (`replay`).
        horizon: Number of answered frames of an episode.
        observation: Kind of observation: `pixels`, `blobs` or `centroids`.
        width: Width of the frame, px.
        height: Height of the frame, px.
        frame_rate: Frames per second.
        people: Mean number of people in the scene at a time (`random`, `crossing`, `crowd`).
        max_people: Maximum number of people at a time.
        empty_frames: Number of first frames that show the empty lobby, so that a background can be learned; then the
            lobby has its usual population. At most 49 with `meet_split_third_guy`. With `replay` the recording decides,
            and this value is only passed to agents in the scene model.
        camouflage: Probability that a piece of clothing has a color of the background, 0 to 1.
        shadow: Opacity of cast shadows, 0 to 1.
        flicker: Standard deviation of the brightness of the whole frame, independent in each frame, gray levels.
        plant: Amplitude of the sway of plant leaves, px.
        light_drift: Amplitude of a slow change of brightness, gray levels.
        light_step: Sudden change of brightness at a random frame in the middle third of the episode, gray levels.
        sensor_noise: Standard deviation of the pixel noise, gray levels.
        compression: Strength of JPEG artifacts, 0 (none) to 1 (quality 10).
        occluders: Number of pillars, plants and signs in front of the people.
        max_measurements: Rows of an observation of blobs or centroids; None: 2 max_people + 16.
        max_estimates: Rows of an action; None: 2 max_people + 8.
        cutoff: Cut-off c of the reward and of all scores; None: 1 (1 - IoU) for boxes, 40 px for centroids.
    """

    script: str = "random"
    source: str | None = None
    horizon: int = 300
    observation: str = "pixels"
    width: int = 384
    height: int = 288
    frame_rate: float = 25.0
    people: float = 4.0
    max_people: int = 12
    empty_frames: int = 25
    camouflage: float = 0.4
    shadow: float = 0.0
    flicker: float = 0.0
    plant: float = 0.0
    light_drift: float = 0.0
    light_step: float = 0.0
    sensor_noise: float = 5.0
    compression: float = 0.0
    occluders: int = 0
    max_measurements: int | None = None
    max_estimates: int | None = None
    cutoff: float | None = None

    def __post_init__(self) -> None:
        """Check every field. A ValueError names the argument, its value and the valid values."""
        for name, options in (("script", SCRIPTS), ("observation", OBSERVATIONS)):
            if getattr(self, name) not in options:
                raise ValueError(f"{name} must be one of {', '.join(options)}, got {getattr(self, name)!r}")
        check_fields(self, _BOUNDS, _WHOLE, _OPTIONAL)
        if self.script in POPULATED and self.people > self.max_people:
            raise ValueError(f"people must be at most max_people = {self.max_people}, got {self.people!r}")
        if self.script == "meet_split_third_guy":
            if self.empty_frames > PAPER_EMPTY_FRAMES:
                raise ValueError(
                    f"empty_frames must be at most {PAPER_EMPTY_FRAMES} in the script 'meet_split_third_guy', "
                    f"where the first person enters then, got {self.empty_frames}"
                )
            if self.frame_rate != PAPER_FRAME_RATE:
                raise ValueError(
                    f"frame_rate must be {PAPER_FRAME_RATE:g} in the script 'meet_split_third_guy', "
                    f"whose schedule counts frames, got {self.frame_rate!r}"
                )
            if self.max_people < 3:
                raise ValueError(
                    f"max_people must be at least 3 in the script 'meet_split_third_guy', got {self.max_people}"
                )
        if (self.script == "replay") != (self.source is not None):
            raise ValueError(
                "source, a file of recorded tracks, and script='replay' go together, "
                f"got source={self.source!r} and script={self.script!r}"
            )

    @property
    def measurement_rows(self) -> int:
        """Rows of an observation of blobs or centroids."""
        return 2 * self.max_people + 16 if self.max_measurements is None else self.max_measurements

    @property
    def estimate_rows(self) -> int:
        """Rows of an action."""
        return 2 * self.max_people + 8 if self.max_estimates is None else self.max_estimates

    @property
    def answers_boxes(self) -> bool:
        """True if answers are boxes, False if they are centroids."""
        return self.observation != "centroids"

    @property
    def score_cutoff(self) -> float:
        """Cut-off c of the reward and of all scores."""
        if self.cutoff is not None:
            return self.cutoff
        return BOX_CUTOFF if self.answers_boxes else POINT_CUTOFF


_PAPER = {"horizon": PAPER_FRAMES, "empty_frames": PAPER_EMPTY_FRAMES}
_BY_SCRIPT: dict[Any, dict[str, Any]] = {"meet_split_third_guy": _PAPER, "replay": {"empty_frames": 0}}
_LIGHT = {"shadow": 0.4, "flicker": 1.5, "light_drift": 15.0, "light_step": 25.0}
_LEVELS: tuple[dict[str, Any], ...] = (
    {},
    {"script": "crossing", "people": 5.0},
    {"script": "crowd", "people": 10.0, "max_people": 20},
    {"camouflage": 0.9, "sensor_noise": 8.0},
    _LIGHT,
    {
        **_LIGHT,
        "script": "crowd",
        "people": 8.0,
        "max_people": 20,
        "camouflage": 0.6,
        "sensor_noise": 7.0,
        "plant": 2.0,
        "compression": 0.5,
        "occluders": 2,
    },
)
LEVEL_NAMES = ("plain", "crossing", "crowd", "camouflage", "light", "everything")
AXES = tuple(f.name for f in fields(PedestrianConfig))


def pedestrian_config(level: int = 0, **axes: Any) -> PedestrianConfig:
    """Return the configuration of a level, with some parameters overridden.

    Args:
        level: 0 `plain`, 1 `crossing`, 2 `crowd`, 3 `camouflage`, 4 `light`, 5 `everything`.
        **axes: Fields of `PedestrianConfig` with the values to use. The script `meet_split_third_guy` sets a horizon
            of 922 frames, of which the first 49 are empty; `replay` sets `empty_frames` to 0.

    Raises:
        ValueError: If the level does not exist or a value is outside its bounds.
        TypeError: If a keyword is unknown; the message suggests the nearest known one.
    """
    level = check_level(level, len(_LEVELS))
    check_keywords(axes, AXES)
    settings = _LEVELS[level] | _BY_SCRIPT.get(axes.get("script"), {})
    return replace(PedestrianConfig(), **{**settings, **axes})


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("horizon", 1, 100_000),
    ("width", 64, 4096),
    ("height", 64, 4096),
    ("frame_rate", 5.0, 100.0),
    ("people", 0.0, 60.0),
    ("max_people", 1, 60),
    ("empty_frames", 0, 100_000),
    ("camouflage", 0.0, 1.0),
    ("shadow", 0.0, 1.0),
    ("flicker", 0.0, 50.0),
    ("plant", 0.0, 20.0),
    ("light_drift", 0.0, 100.0),
    ("light_step", -150.0, 150.0),
    ("sensor_noise", 0.0, 50.0),
    ("compression", 0.0, 1.0),
    ("occluders", 0, 8),
    ("max_measurements", 1, 1000),
    ("max_estimates", 1, 1000),
    ("cutoff", 1e-3, 1e6),
)
_WHOLE = frozenset(
    {
        "horizon",
        "width",
        "height",
        "max_people",
        "empty_frames",
        "occluders",
        "max_measurements",
        "max_estimates",
    }
)
_OPTIONAL = frozenset({"max_measurements", "max_estimates", "cutoff"})
