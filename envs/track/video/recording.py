"""A recorded sequence, ready to be answered frame by frame: its frames, detections and truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.envs.arguments import check_fields
from servotrack.envs.track.files.frames import SIDES, FrameSource, open_frames, resized
from servotrack.envs.track.files.mot_files import MotFolder, SequenceInfo, find_mot_folder, read_mot_detections
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import PeopleInFrame, RecordedTracks, SequenceError
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.world import PedestrianWorld
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.types import Array, Image, Labels

VIDEO_OBSERVATIONS = ("pixels", "detections")
LONGEST = 3000
"""Frames of an episode unless a horizon is given: two minutes."""
_NOMINAL_RATE = 25.0
_RENDERED_FRAMES, _RENDERED_EMPTY = 60, 10
_RENDERED_SEED = 0


@dataclass(frozen=True)
class VideoConfig:
    """All that defines a world of recorded frames.

    Attributes:
        source: A video file, a folder of images, the folder of a MOTChallenge sequence, or a camera's index; None for
            60 frames that the pedestrian scene renders.
        truth: A file of truth, MOTChallenge's gt.txt or CAVIAR's XML; None for the one in the sequence's folder.
        observation: `pixels`, or `detections`: those of the sequence's det/det.txt.
        width: Resize frames to this, px; with only one of width and height, the shape is kept. Boxes follow.
        height: Resize frames to this, px.
        start: First frame, counted from 0.
        stride: Every so manieth frame.
        horizon: Most frames that are answered; None for all, at most 3000.
        least_confidence: Detections of less are left out; None for none.
        max_estimates: Rows of an action.
        cutoff: The c of reward and scores, over one minus IoU.

    Raises:
        ValueError: A field out of its range.
    """

    source: str | int | None = None
    truth: str | None = None
    observation: str = "pixels"
    width: int | None = None
    height: int | None = None
    start: int = 0
    stride: int = 1
    horizon: int | None = None
    least_confidence: float | None = None
    max_estimates: int = 64
    cutoff: float = 1.0

    def __post_init__(self) -> None:
        """Check every field."""
        if self.observation not in VIDEO_OBSERVATIONS:
            raise ValueError(f"observation must be one of {', '.join(VIDEO_OBSERVATIONS)}, got {self.observation!r}")
        check_fields(self, _BOUNDS, _WHOLE, _OPTIONAL)
        for name in _OF_A_SOURCE:
            if self.source is None and getattr(self, name) != getattr(VideoConfig, name):
                raise ValueError(f"{name} needs a source, got {getattr(self, name)!r} without one")


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("width", *SIDES),
    ("height", *SIDES),
    ("start", 0, 1e9),
    ("stride", 1, 1e6),
    ("horizon", 1, 1_000_000),
    ("least_confidence", -1e9, 1e9),
    ("max_estimates", 1, 1000),
    ("cutoff", 1e-3, 1.0),
)
_WHOLE = ("width", "height", "start", "stride", "horizon", "max_estimates")
_OF_A_SOURCE = ("truth", "width", "height", "start", "stride", "least_confidence")
_OPTIONAL = ("width", "height", "horizon", "least_confidence")


@dataclass(frozen=True)
class Recording:
    """A sequence of K frames of which n people are at most in one, and m detections at most.

    Attributes:
        name: For titles.
        width: Of the frames that are delivered, px.
        height: Of the frames that are delivered, px.
        frame_rate: Frames per second.
        horizon: K. Decoding may end earlier.
        open: Starts an iteration over the frames; None where there are no images.
        scored: Whether there is truth.
        ids: Who is in a row at each frame, from 1, 0 for nobody. Shape (K, n), int.
        boxes: Shape (K, n, 4), px.
        visibility: Shape (K, n).
        detections: Sets with existence in column 0. Shape (K, m, 5); None where frames are observed.
    """

    name: str
    width: int
    height: int
    frame_rate: float
    horizon: int
    open: Callable[[], Iterator[Image]] | None
    scored: bool
    ids: Labels
    boxes: Array
    visibility: Array
    detections: Array | None


def load_recording(config: VideoConfig) -> Recording:
    """Open a sequence and read what comes with it.

    Raises:
        SequenceError: A source or file that cannot be used.
    """
    if config.source is None:
        return _rendered(config)
    sequence = find_mot_folder(str(config.source)) if Path(str(config.source)).is_dir() else None
    found: dict[int, Detections] = {}
    if config.observation == "detections":
        if sequence is None or sequence.detections is None:
            raise SequenceError(
                f"source {config.source!r} holds no det/det.txt; give a MOTChallenge sequence or observation='pixels'"
            )
        found = read_mot_detections(sequence.detections)
    truth = _truth(config, sequence)
    info = SequenceInfo(str(config.source)) if sequence is None else sequence.info
    frames = None
    if config.observation == "pixels" or (sequence is not None and sequence.images is not None):
        frames = _open(config)
        info = info._replace(name=frames.name, frame_rate=frames.frame_rate)
        size, scale = frames.size, (frames.size[0] / frames.source_size[0], frames.size[1] / frames.source_size[1])
        last = frames.length
    else:
        size, scale = _told_size(config, info)
        last = max([step + 1 for step in found] + [truth.length if truth else 0])
    horizon = config.horizon or LONGEST
    if last is not None:
        # One frame at least: whether there is one is for the decoder to say.
        horizon = min(horizon, max(-(-(last - config.start) // config.stride), 1))
    numbers = range(config.start, config.start + horizon * config.stride, config.stride)
    people = {} if truth is None else truth.by_frame()
    return Recording(
        name=info.name,
        width=size[0],
        height=size[1],
        frame_rate=(info.frame_rate or _NOMINAL_RATE) / config.stride,
        horizon=horizon,
        # A decoder for each observer; of a camera there is one.
        open=None if frames is None else frames.__iter__ if frames.live else lambda: iter(_open(config)),
        scored=truth is not None,
        **_truth_arrays(people, numbers, np.array([*scale, *scale])),
        detections=_detections(config, found, numbers, scale, size) if config.observation == "detections" else None,
    )


def _open(config: VideoConfig) -> FrameSource:
    assert config.source is not None
    return open_frames(
        config.source, width=config.width, height=config.height, start=config.start, stride=config.stride
    )


def _truth(config: VideoConfig, sequence: MotFolder | None) -> RecordedTracks | None:
    path = config.truth if config.truth is not None else None if sequence is None else sequence.truth
    return None if path is None else read_tracks(path)


def _told_size(config: VideoConfig, info: SequenceInfo) -> tuple[tuple[int, int], tuple[float, float]]:
    """Size of frames that are not there, and by what boxes are scaled."""
    if info.width is None or info.height is None or max(info.width, info.height) > SIDES[1]:
        raise SequenceError(f"{config.source}: without images, seqinfo.ini must tell imWidth and imHeight")
    size = resized((info.width, info.height), config.width, config.height)
    return size, (size[0] / info.width, size[1] / info.height)


def _truth_arrays(people: Mapping[int, PeopleInFrame], numbers: range, scale: Array) -> dict[str, Any]:
    """Ids, boxes and visibility, identities numbered from 1 in the order of the file's."""
    inside = {k: people[number] for k, number in enumerate(numbers) if number in people}
    names = np.unique(np.concatenate([who.ids for who in inside.values()] or [np.zeros(0, np.int64)]))
    most = max((len(who.ids) for who in inside.values()), default=0)
    ids, boxes = np.zeros((len(numbers), most), np.int64), np.zeros((len(numbers), most, 4))
    visibility = np.zeros((len(numbers), most))
    for k, who in inside.items():
        count = len(who.ids)
        ids[k, :count] = np.searchsorted(names, who.ids) + 1
        boxes[k, :count], visibility[k, :count] = who.boxes * scale, who.visibilities
    return {"ids": ids, "boxes": boxes, "visibility": visibility}


def _detections(
    config: VideoConfig,
    found: dict[int, Detections],
    numbers: range,
    scale: tuple[float, float],
    size: tuple[int, int],
) -> Array:
    """Sets of detections as they are observed, cut to three frames' width and height."""
    least = -math.inf if config.least_confidence is None else config.least_confidence
    kept = {step: one.boxes[one.confidences >= least] for step, one in found.items()}
    sets = np.zeros((len(numbers), max([1, *(len(boxes) for boxes in kept.values())]), 5))
    low, high = detection_bounds(*size)
    for k, number in enumerate(numbers):
        boxes = kept.get(number, np.zeros((0, 4)))
        sets[k, : len(boxes), 0] = 1.0
        sets[k, : len(boxes), 1:] = np.clip(boxes * [*scale, *scale], low, high)
    return sets


def detection_bounds(width: int, height: int) -> tuple[list[float], list[float]]:
    """Lowest and highest detected box: a frame's width and height beyond every border."""
    w, h = float(width), float(height)
    return [-w, -h, 0.0, 0.0], [2.0 * w, 2.0 * h, 3.0 * w, 3.0 * h]


@lru_cache(maxsize=2)
def _rendered(config: VideoConfig) -> Recording:
    """Frames of the pedestrian scene, the same whatever the seed, as those of a file are."""
    detects = config.observation == "detections"
    shown = "blobs" if detects else "pixels"
    scene = PedestrianConfig(horizon=_RENDERED_FRAMES, empty_frames=_RENDERED_EMPTY, observation=shown)
    world = PedestrianWorld(scene, 1)
    world.reset([0], [_RENDERED_SEED])
    horizon = min(config.horizon or _RENDERED_FRAMES, _RENDERED_FRAMES)
    images, seen, truth = [], [], []
    for _ in range(horizon):
        images.append(world.images[0].copy())
        seen.append(world.observations[0].copy() if detects else None)
        truth.append((world.ids[0], world.boxes[0], world.visibility[0]))
        world.step(np.zeros((1, scene.estimate_rows, 5)))
    return Recording(
        name="rendered",
        width=scene.width,
        height=scene.height,
        frame_rate=scene.frame_rate,
        horizon=horizon,
        open=images.__iter__,
        scored=True,
        ids=np.array([ids for ids, _, _ in truth]),
        boxes=np.array([boxes for _, boxes, _ in truth]),
        visibility=np.array([visibility for _, _, visibility in truth]),
        detections=np.array(seen) if detects else None,
    )
