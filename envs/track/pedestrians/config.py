"""Every parameter of the pedestrian scene, and the levels that set them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from servotrack.envs.arguments import check_fields, check_keywords, check_level

SCRIPTS = ("random", "crossing", "crowd", "meet_split_third_guy", "replay")
POPULATED = ("random", "crossing", "crowd")
"""Scripts in which `people` decides how many there are."""
OBSERVATIONS = ("pixels", "blobs", "centroids")
PAPER_FRAMES = 922
"""Frames of paper 000's sequence Meet_Split_3rdGuy."""
PAPER_FRAME_RATE = 25.0
PAPER_EMPTY_FRAMES = 49
"""Its first frames, which show nobody."""
BOX_CUTOFF, POINT_CUTOFF = 1.0, 40.0
"""The c of reward and scores by default: one minus IoU, and px."""


@dataclass(frozen=True)
class PedestrianConfig:
    """All that defines a pedestrian scene. The picture's axes are off by default.

    Attributes:
        script: Who comes when and does what: `random`, `crossing`, `crowd`, `meet_split_third_guy`, or `replay`.
        source: Recorded tracks to replay: a CAVIAR XML file, MOTChallenge's gt.txt or a sequence's folder (`replay`).
        horizon: Frames of an episode that are answered.
        observation: What agents see: `pixels`, `blobs` or `centroids`.
        width: Of the frame, px.
        height: Of the frame, px.
        frame_rate: Frames per second.
        people: Mean number in the scene at a time (`random`, `crossing`, `crowd`).
        max_people: Most at a time.
        empty_frames: How many first frames show the lobby empty, as before opening hours, so that a background can be
            learned; then it is as populated as it will be. Of `meet_split_third_guy` at most 49, and of `replay` what
            the recording has, so that there it says only what agents are told.
        camouflage: Share of clothes in the background's colors, 0 to 1.
        shadow: Opacity of cast shadows, 0 to 1.
        flicker: Standard deviation of the whole frame's brightness from frame to frame, gray levels.
        plant: Sway of a plant's leaves, px.
        light_drift: Amplitude of a slow change of brightness, gray levels.
        light_step: A sudden change of brightness, gray levels, at a frame drawn from the middle third of the episode.
        sensor_noise: Standard deviation of a pixel's noise, gray levels.
        compression: Strength of JPEG artifacts, 0 (none) to 1 (quality 10).
        occluders: Number of pillars, plants and signs that people walk behind.
        max_measurements: Rows of an observation of blobs or centroids; None: 2 max_people + 16.
        max_estimates: Rows of an action; None: 2 max_people + 8.
        cutoff: The c of reward and scores; None: 1 (one minus IoU) for boxes, 40 px for centroids.
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
        """Check every field; raises ValueError that names the argument, the value and what would be right."""
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
                    f"where the first person comes then, got {self.empty_frames}"
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
        """Whether answers are boxes; else they are centroids."""
        return self.observation != "centroids"

    @property
    def score_cutoff(self) -> float:
        """The c of reward and scores."""
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
    """The configuration of a level, with single parameters overridden.

    Args:
        level: 0 `plain`, 1 `crossing`, 2 `crowd`, 3 `camouflage`, 4 `light`, 5 `everything`.
        **axes: Fields of `PedestrianConfig`. The script `meet_split_third_guy` brings a horizon of 922 frames, of
            which the first 49 are empty; `replay` tells agents of no empty frames.

    Raises:
        ValueError: A level that does not exist, or a value outside its bounds.
        TypeError: An unknown keyword; the message suggests the nearest known one.
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
