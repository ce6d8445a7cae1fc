"""Every parameter of the pedestrian scene, and the levels that set them."""

from __future__ import annotations

from dataclasses import dataclass

SCRIPTS = ("random", "crossing", "crowd", "meet_split_third_guy", "replay")
OBSERVATIONS = ("pixels", "blobs", "centroids")


@dataclass(frozen=True)
class PedestrianConfig:
    """All that defines a pedestrian scene. The picture's axes are off by default.

    Attributes:
        script: Who comes when and does what: `random`, `crossing`, `crowd`, `meet_split_third_guy`, or `replay`.
        horizon: Frames of an episode that are answered.
        observation: What agents see: `pixels`, `blobs` or `centroids`.
        width: Of the frame, px.
        height: Of the frame, px.
        frame_rate: Frames per second.
        people: Mean number in the scene at a time (`random`).
        max_people: Most at a time.
        empty_frames: How many first frames show nobody.
        camouflage: Share of clothes in the background's colors, 0 to 1.
        shadow: Opacity of cast shadows, 0 to 1.
        flicker: Standard deviation of the whole frame's brightness from frame to frame, gray levels.
        plant: Sway of a plant's leaves, px.
        light_drift: Amplitude of a slow change of brightness, gray levels.
        light_step: A sudden change of brightness, gray levels, at a frame drawn from the middle third of the episode.
        sensor_noise: Standard deviation of a pixel's noise, gray levels.
        compression: Strength of JPEG artifacts, 0 (none) to 1 (quality 10).
        occluders: Number of pillars, plants and signs that people walk behind.
        max_estimates: Rows of an action; None: 2 max_people + 8.
        cutoff: The c of reward and scores; None: 1 (one minus IoU) for boxes, 40 px for centroids.
    """

    script: str = "random"
    horizon: int = 300
    observation: str = "pixels"
    width: int = 384
    height: int = 288
    frame_rate: float = 25.0
    people: float = 4.0
    max_people: int = 12
    empty_frames: int = 0
    camouflage: float = 0.4
    shadow: float = 0.0
    flicker: float = 0.0
    plant: float = 0.0
    light_drift: float = 0.0
    light_step: float = 0.0
    sensor_noise: float = 5.0
    compression: float = 0.0
    occluders: int = 0
    max_estimates: int | None = None
    cutoff: float | None = None
