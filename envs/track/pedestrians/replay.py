"""Replay of recorded trajectories (CAVIAR, MOTChallenge) by rendered people."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.files.mot_files import read_seqinfo
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import RecordedTracks, SequenceError
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.floor import Camera
from servotrack.envs.track.pedestrians.movement import ImagePath, gait
from servotrack.envs.track.pedestrians.scene import Stream
from servotrack.estimators.types import Array

_WINDOW = 7
"""Number of frames over which feet and height are averaged, because hand-drawn boxes jump."""
_MIN_HEIGHT = 4.0
"""Minimum height of used boxes, px."""


def read_recording(config: PedestrianConfig) -> RecordedTracks:
    """Read the recording to replay. If seqinfo.ini gives the image size, boxes are scaled to the frame.

    Args:
        config: Parameters; `source` is the file or folder.

    Raises:
        SequenceError: If `read_tracks` fails, the file has no tracks, or the boxes lie outside the frame.
    """
    assert config.source is not None
    path = Path(config.source)
    recorded = read_tracks(path)
    if not recorded.tracks:
        raise SequenceError(f"{path} contains no tracks; give a file with tracks")
    scale = np.ones(4)
    if path.is_dir() and (path / "seqinfo.ini").is_file():
        info = read_seqinfo(path / "seqinfo.ini")
        if info.width is not None and info.height is not None:
            scale = np.array([config.width / info.width, config.height / info.height] * 2)
    tracks = [track._replace(states=track.states * scale) for track in recorded.tracks]
    feet = np.concatenate([track.states[:, :2] + track.states[:, 2:] * [0.5, 1.0] for track in tracks])
    reach = np.percentile(feet, 95.0, axis=0)
    if reach[0] > config.width or reach[1] > 1.05 * config.height:
        raise SequenceError(
            f"{path} has people beyond the frame of {config.width} x {config.height} px, many of them at "
            f"({reach[0]:.0f}, {reach[1]:.0f}); give width and height of the recording, or a folder with seqinfo.ini"
        )
    return RecordedTracks(recorded.ids, tracks, recorded.visibilities)


def replay(recorded: RecordedTracks, config: PedestrianConfig, camera: Camera, streams: Streams) -> list[ImagePath]:
    """Return the paths of all people in the image. Gaps in a track are interpolated linearly.

    Args:
        recorded: Recording, read by `read_recording`.
        config: Parameters of the environment.
        camera: Camera, which converts movement in the image to directions on the floor.
        streams: Random streams of the episode, for outfits and gait.

    Returns:
        Paths, ordered by their first frame.
    """
    body = streams[Stream.BODY]
    outfit_seeds = body.integers(0, 2**62, len(recorded.tracks))
    phases = body.uniform(0.0, 2.0 * math.pi, len(recorded.tracks))
    paths = []
    for track, outfit_seed, phase in zip(recorded.tracks, outfit_seeds.tolist(), phases.tolist(), strict=True):
        tall = track.states[:, 3] >= _MIN_HEIGHT
        if not tall.any():
            continue
        known, boxes = track.steps[tall], track.states[tall]
        steps = np.arange(known[0], known[-1] + 1)
        left, top, width, height = (_smooth(np.interp(steps, known, column)) for column in boxes.T)
        feet = np.stack([left + width / 2.0, top + height], axis=1)
        # Feet are moved below the horizon of the rendering camera; the camera of the recording is unknown.
        low = np.maximum(feet[:, 1], camera.horizon + 0.15 * config.height)
        floor = camera.unproject(np.stack([feet[:, 0], low], axis=1))
        direction = np.diff(floor, axis=0, prepend=floor[:1])
        # Length of the way in body heights; movement along the line of sight is foreshortened by about one half.
        way = np.hypot(*(np.diff(feet, axis=0, prepend=feet[:1]) * [1.0, 2.0]).T) / height
        length = np.hypot(*direction.T)
        movement = direction * np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)[:, None]
        walked = gait(movement, np.full(len(steps), math.nan), math.nan, phase, 1.0 / config.frame_rate)
        paths.append(ImagePath(int(steps[0]), feet, height, walked[:, 0], walked[:, 1], walked[:, 2], outfit_seed))
    paths.sort(key=lambda path: path.first)
    return paths


def _smooth(values: Array) -> Array:
    """Return the moving average with fixed end points."""
    reach = min(_WINDOW, len(values)) // 2
    if reach == 0:
        return values
    padded = np.concatenate(
        [2.0 * values[0] - values[reach:0:-1], values, 2.0 * values[-1] - values[-2 : -2 - reach : -1]]
    )
    total = np.cumsum(np.concatenate([[0.0], padded]))
    window = 2 * reach + 1
    return (total[window:] - total[:-window]) / window
