"""Loading of a recorded sequence: frames, detections and ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.envs.arguments import check_fields
from servotrack.envs.track.files.frames import SIDES, FrameSource, open_frames, resized
from servotrack.envs.track.files.mot_files import MotFolder, SequenceInfo, find_mot_folder
from servotrack.envs.track.files.pixel_detections import read_pixel_detections
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import PeopleInFrame, RecordedTracks, SequenceError
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.world import PedestrianWorld
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.types import Array, Image, Labels

VIDEO_OBSERVATIONS = ("pixels", "detections")
DEFAULT_MAX_FRAMES = 3000
"""Maximum number of frames of an episode if no horizon is given: two minutes at 25 frames per second."""
_DEFAULT_FRAME_RATE = 25.0
"""Frame rate of sources that have none, frames per second."""
_RENDERED_FRAMES, _RENDERED_EMPTY = 60, 10
"""Number of frames of the rendered sequence, and of empty ones at its start."""
_RENDERED_SEED = 0
_MAX_BOXES = 20_000_000
"""Largest number of rows of all frames together, about 1 GB: frames times boxes of the fullest frame."""


@dataclass(frozen=True)
class VideoConfig:
    """Parameters of an environment of recorded frames.

    Attributes:
        source: Video file, folder of images, folder of a MOTChallenge sequence, or index of a camera; None: 60 frames
            rendered by the pedestrian environment.
        truth: File of the ground truth, a gt.txt of MOTChallenge or an XML file of CAVIAR; None: the one in the folder
            of the sequence, if any.
        observation: `pixels`, or `detections` for those in det/det.txt of the sequence.
        width: Width to which frames are resized, px; None: follows from `height`, or no resizing. Boxes are scaled with
            the frames.
        height: Height to which frames are resized, px; None: follows from `width`, or no resizing.
        start: First frame, counted from 0.
        stride: Use every N-th frame.
        horizon: Maximum number of answered frames; None: all, at most 3000.
        least_confidence: Minimum confidence of detections; None: all are used.
        max_estimates: Rows of an action.
        cutoff: Cut-off c of the reward and of all scores, as 1 - IoU.

    Raises:
        ValueError: If a field is out of its range.
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
    """Sequence of K frames with at most n people and m detections in a frame.

    Attributes:
        name: Name for titles.
        width: Width of the delivered frames, px.
        height: Height of the delivered frames, px.
        frame_rate: Frames per second.
        horizon: Number of frames K. Decoding may end earlier.
        open: Function that starts an iteration over the frames; None if there are no images.
        scored: True if there is ground truth.
        ids: Identity in each row at each frame, from 1, 0 for an unused row, shape (K, n), int.
        boxes: True boxes (left, top, width, height), shape (K, n, 4), px.
        visibility: Visible shares, shape (K, n).
        detections: Sets of detections with existence in column 0, shape (K, m, 5); None if frames are observed.
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
    """Open a sequence and read its detections and ground truth.

    Raises:
        SequenceError: If the source or a file cannot be used.
    """
    if config.source is None:
        return _rendered(config)
    sequence = find_mot_folder(str(config.source))
    found: Mapping[int, Detections] = {}
    if config.observation == "detections" and (sequence is None or sequence.detections is None):
        raise SequenceError(
            f"source {config.source!r} holds no det/det.txt; give a MOTChallenge sequence or observation='pixels'"
        )
    truth = _truth(config, sequence)
    info = SequenceInfo(str(config.source)) if sequence is None else sequence.info
    frames = None
    if config.observation == "pixels" or (sequence is not None and sequence.images is not None):
        frames = _open(config)
        info = info._replace(name=frames.name, frame_rate=frames.frame_rate)
        size, scale = frames.size, (frames.size[0] / frames.source_size[0], frames.size[1] / frames.source_size[1])
        last = frames.length
        source_size: tuple[int, int] | None = frames.source_size
    else:
        size, scale = _declared_size(config, info)
        assert info.width is not None and info.height is not None
        source_size = (info.width, info.height)
    if config.observation == "detections" and sequence is not None and sequence.detections is not None:
        found = _read_detections(sequence.detections, source_size)
    if frames is None:
        last = max([step + 1 for step in found] + [truth.length if truth else 0])
    horizon = config.horizon or DEFAULT_MAX_FRAMES
    if last is not None:
        # At least one frame; the decoder reports an error if there is none.
        horizon = min(horizon, max(-(-(last - config.start) // config.stride), 1))
    numbers = range(config.start, config.start + horizon * config.stride, config.stride)
    people = {} if truth is None else truth.by_frame()
    return Recording(
        name=info.name,
        width=size[0],
        height=size[1],
        frame_rate=(info.frame_rate or _DEFAULT_FRAME_RATE) / config.stride,
        horizon=horizon,
        # Every observer has its own decoder; a camera has only one.
        open=None if frames is None else frames.held if frames.live else lambda: _open(config).held(),
        scored=truth is not None,
        **_truth_arrays(people, numbers, np.array([*scale, *scale])),
        detections=_detections(config, found, numbers, scale, size) if config.observation == "detections" else None,
    )


def _read_detections(path: Path, size: tuple[int, int] | None) -> Mapping[int, Detections]:
    found, note = read_pixel_detections(path, size)
    if note:
        gym.logger.warn(note)
    return found


def _open(config: VideoConfig) -> FrameSource:
    assert config.source is not None
    return open_frames(
        config.source, width=config.width, height=config.height, start=config.start, stride=config.stride
    )


def _truth(config: VideoConfig, sequence: MotFolder | None) -> RecordedTracks | None:
    path = config.truth if config.truth is not None else None if sequence is None else sequence.truth
    return None if path is None else read_tracks(path)


def _declared_size(config: VideoConfig, info: SequenceInfo) -> tuple[tuple[int, int], tuple[float, float]]:
    """Return the size of the frames, from seqinfo.ini if there are no images, and the scale of boxes (x, y)."""
    if info.width is None or info.height is None or max(info.width, info.height) > SIDES[1]:
        raise SequenceError(f"{config.source}: without images, seqinfo.ini must give imWidth and imHeight")
    size = resized((info.width, info.height), config.width, config.height)
    return size, (size[0] / info.width, size[1] / info.height)


def _truth_arrays(people: Mapping[int, PeopleInFrame], numbers: range, scale: Array) -> dict[str, Any]:
    """Return ids, boxes and visibility; identities are numbered from 1 in the order of the ids of the file."""
    inside = {k: people[number] for k, number in enumerate(numbers) if number in people}
    names = np.unique(np.concatenate([who.ids for who in inside.values()] or [np.zeros(0, np.int64)]))
    most = max((len(who.ids) for who in inside.values()), default=0)
    _check_rows("truth", len(numbers), most)
    ids, boxes = np.zeros((len(numbers), most), np.int64), np.zeros((len(numbers), most, 4))
    visibility = np.zeros((len(numbers), most))
    for k, who in inside.items():
        count = len(who.ids)
        ids[k, :count] = np.searchsorted(names, who.ids) + 1
        boxes[k, :count], visibility[k, :count] = who.boxes * scale, who.visibilities
    return {"ids": ids, "boxes": boxes, "visibility": visibility}


def _detections(
    config: VideoConfig,
    found: Mapping[int, Detections],
    numbers: range,
    scale: tuple[float, float],
    size: tuple[int, int],
) -> Array:
    """Return the observed sets of detections, clipped to `detection_bounds`."""
    least = -math.inf if config.least_confidence is None else config.least_confidence
    kept = {step: one.boxes[one.confidences >= least] for step, one in found.items()}
    most = max([1, *(len(boxes) for boxes in kept.values())])
    _check_rows("detections", len(numbers), most)
    sets = np.zeros((len(numbers), most, 5))
    low, high = detection_bounds(*size)
    for k, number in enumerate(numbers):
        boxes = kept.get(number, np.zeros((0, 4)))
        sets[k, : len(boxes), 0] = 1.0
        sets[k, : len(boxes), 1:] = np.clip(boxes * [*scale, *scale], low, high)
    return sets


def _check_rows(name: str, frames: int, most: int) -> None:
    if frames * most > _MAX_BOXES:
        raise SequenceError(
            f"{name}: {frames} frames of up to {most} boxes need {frames * most} rows, the limit is {_MAX_BOXES}; "
            "set a smaller horizon"
        )


def detection_bounds(width: int, height: int) -> tuple[list[float], list[float]]:
    """Return the lowest and highest detected box: up to one frame size beyond every border."""
    w, h = float(width), float(height)
    return [-w, -h, 0.0, 0.0], [2.0 * w, 2.0 * h, 3.0 * w, 3.0 * h]


@lru_cache(maxsize=2)
def _rendered(config: VideoConfig) -> Recording:
    """Return frames rendered by the pedestrian environment, the same for every seed."""
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
