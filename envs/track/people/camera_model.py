"""What the agents of a world of video frames are told about it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VideoModel:
    """What an observer of video is told: what a user who sets up a camera knows, and nothing of who walks by.

    Attributes:
        observation: What it sees: `pixels` (RGB frames), `blobs` (boxes) or `centroids`.
        width: Of the frame, px.
        height: Of the frame, px.
        frame_rate: Frames per second.
        max_people: Most people at a time, hidden ones included; of a real sequence, the most that an answer can hold.
        empty_frames: How many first frames show nobody for certain; 0 where nothing is known.
        cutoff: The c of reward and scores: one minus IoU of boxes, px of centroids.
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
        """Whether answers are boxes (left, top, width, height); else they are centroids."""
        return self.observation != "centroids"
