"""The scene model that agents get in video environments: camera and frame parameters."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VideoModel:
    """Model that agents get. It describes the camera, and contains nothing about the people.

    Attributes:
        observation: Kind of observation: `pixels` (RGB frames), `blobs` (boxes) or `centroids`.
        width: Width of the frame, px.
        height: Height of the frame, px.
        frame_rate: Frames per second.
        max_people: Maximum number of people at a time, including occluded ones; for a recorded sequence, the number of
            rows of an answer.
        empty_frames: Number of first frames that are known to show no people; 0 if unknown.
        cutoff: Cut-off c of the reward and of all scores: 1 - IoU for boxes, px for centroids.
    """

    observation: str
    width: int
    height: int
    frame_rate: float
    max_people: int
    empty_frames: int
    cutoff: float

    @property
    def answers_boxes(self) -> bool:
        """True if answers are boxes (left, top, width, height), False if they are centroids."""
        return self.observation != "centroids"
