"""Sequences for gm_phd_video and transfer: rendered ones, and recordings of the user."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.baselines.papers.parts import setting_of
from servotrack.baselines.papers.request import Recording
from servotrack.envs.track.files.frames import open_frames
from servotrack.envs.track.files.read import read_tracks
from servotrack.estimators.metrics import Track, tracks_from_rows
from servotrack.estimators.types import Image, Labels

SCRIPT = "meet_split_third_guy"
ENVIRONMENT = "PedestrianTracking-v0"
BACKGROUND_FRAMES = 40
WIDTH, HEIGHT = 384, 288
"""Frame size of the paper, px. Other sequences are scaled to this height."""


@dataclass
class Sequence:
    """Frames that can be read once, and the truth, which is complete after the last frame.

    Attributes:
        name: Name in tables.
        frames: RGB frames, uint8; can be read once.
        size: Width and height, px.
        frame_rate: Frames per second.
        background: Spaced frames that initialize a background model; None if the first frame is empty.
        truth: Tracks of the people that count. Complete only after the last frame.
        numbers: Number of people in each frame, including hidden ones, shape (T,). Complete only after the last frame.
    """

    name: str
    frames: Iterator[Image]
    size: tuple[int, int]
    frame_rate: float
    background: list[Image] | None
    truth: list[Track]
    numbers: Labels


def rendered(seed: int, **axes: Any) -> Sequence:
    """Return an episode of the pedestrian scene.

    Args:
        seed: Seed of the environment.
        **axes: Keywords of `PedestrianTracking-v0`.
    """
    env = gym.make(ENVIRONMENT, **axes)
    made = Sequence(f"seed {seed}", iter(()), (WIDTH, HEIGHT), 0.0, None, [], np.zeros(0, np.int64))
    scene: Any = env.get_wrapper_attr("scene_model")
    made.size, made.frame_rate = (scene.width, scene.height), scene.frame_rate

    def run() -> Iterator[Image]:
        observation, info = env.reset(seed=seed)
        nothing = np.zeros(env.action_space.shape or (), np.float64)
        labels, boxes, numbers = [], [], []
        over = False
        while not over:
            truth = info["truth"]
            labels.append(np.where(truth["exists"], truth["ids"], -1))
            boxes.append(truth["boxes"])
            numbers.append(int((truth["ids"] > 0).sum()))
            yield observation
            observation, _, terminated, truncated, info = env.step(nothing)
            over = terminated or truncated
        env.close()
        made.truth[:] = tracks_from_rows(np.array(labels), np.array(boxes))
        made.numbers = np.array(numbers)

    made.frames = run()
    return made


def recorded(recording: Recording) -> Sequence:
    """Return a recording of the user, scaled to the paper's height.

    Raises:
        SequenceError: The files cannot be used.
        ValueError: The recording has no truth.
    """
    tracks = read_tracks(recording.truth or recording.source)
    frames = open_frames(recording.source, height=HEIGHT)
    scale = np.array([frames.size[0] / frames.source_size[0], frames.size[1] / frames.source_size[1]] * 2)
    truth = [Track(track.steps, track.states * scale) for track in tracks.tracks]
    stride = max((frames.length or BACKGROUND_FRAMES) // BACKGROUND_FRAMES, 1)
    spaced = open_frames(recording.source, height=HEIGHT, stride=stride, count=BACKGROUND_FRAMES)
    made = Sequence(
        str(recording.source), iter(()), frames.size, frames.frame_rate or 25.0, list(spaced), truth,
        np.zeros(0, np.int64),
    )  # fmt: skip

    def run() -> Iterator[Image]:
        shown = 0
        for frame in frames.held():
            shown += 1
            yield frame
        counts = np.zeros(shown, np.int64)
        made.truth[:] = [_until(track, shown) for track in truth]
        for track in made.truth:
            counts[track.steps] += 1
        made.numbers = counts

    made.frames = run()
    return made


def part_name(recording: Recording) -> str:
    """Return the name of the file that keeps the results of a recording."""
    return f"recording-{hashlib.sha256(str(recording).encode()).hexdigest()[:12]}.npz"


def setting_of_recording(recording: Recording, **values: Any) -> str:
    """Return the settings that the results of a recording depend on: its files as they are now, and `values`."""
    files = [Path(name) for name in (recording.source, recording.truth) if name is not None]
    states = [(found.stat().st_size, found.stat().st_mtime_ns) if found.exists() else None for found in files]
    return setting_of(recording=list(recording), states=states, **values)


def _until(track: Track, frames: int) -> Track:
    """Part of a track within the first `frames` frames, which could be decoded."""
    kept = track.steps < frames
    return Track(track.steps[kept], track.states[kept])
