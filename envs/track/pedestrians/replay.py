"""Recorded trajectories walked again by people of our own: CAVIAR's XML and MOTChallenge's rows."""

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
"""Frames over which feet and height are averaged, for boxes drawn by hand jump."""
_SMALLEST = 4.0
"""Boxes less high than this are left out, px."""


def read_recording(config: PedestrianConfig) -> RecordedTracks:
    """The recording that a scene replays, scaled to its frame where the folder of a sequence tells the recording's.

    Args:
        config: Whose `source` names the file or folder.

    Raises:
        SequenceError: As `read_tracks`; nobody in it; or boxes beyond the scene's frame.
    """
    assert config.source is not None
    path = Path(config.source)
    recorded = read_tracks(path)
    if not recorded.tracks:
        raise SequenceError(f"{path} holds no tracks; give a file with some")
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
    """Everybody's life in the image; who is gone for some frames of the recording goes on straight meanwhile.

    Args:
        recorded: As `read_recording` returned it.
        config: The scene.
        camera: Which turns movement in the image into directions on the floor.
        streams: Of the episode, for looks.
    """
    body = streams[Stream.BODY]
    outfit_seeds = body.integers(0, 2**62, len(recorded.tracks))
    phases = body.uniform(0.0, 2.0 * math.pi, len(recorded.tracks))
    paths = []
    for track, outfit_seed, phase in zip(recorded.tracks, outfit_seeds.tolist(), phases.tolist(), strict=True):
        tall = track.states[:, 3] >= _SMALLEST
        if not tall.any():
            continue
        known, boxes = track.steps[tall], track.states[tall]
        steps = np.arange(known[0], known[-1] + 1)
        left, top, width, height = (_smooth(np.interp(steps, known, column)) for column in boxes.T)
        feet = np.stack([left + width / 2.0, top + height], axis=1)
        # Below the horizon of our camera, or the recording's would have to be known.
        low = np.maximum(feet[:, 1], camera.horizon + 0.15 * config.height)
        floor = camera.unproject(np.stack([feet[:, 0], low], axis=1))
        direction = np.diff(floor, axis=0, prepend=floor[:1])
        # How far, the image tells in body heights; ways along the line of sight are foreshortened by a half or so.
        way = np.hypot(*(np.diff(feet, axis=0, prepend=feet[:1]) * [1.0, 2.0]).T) / height
        length = np.hypot(*direction.T)
        movement = direction * np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)[:, None]
        walked = gait(movement, np.full(len(steps), math.nan), math.nan, phase, 1.0 / config.frame_rate)
        paths.append(ImagePath(int(steps[0]), feet, height, walked[:, 0], walked[:, 1], walked[:, 2], outfit_seed))
    paths.sort(key=lambda path: path.first)
    return paths


def _smooth(values: Array) -> Array:
    """Moving average that keeps the ends in place."""
    reach = min(_WINDOW, len(values)) // 2
    if reach == 0:
        return values
    padded = np.concatenate(
        [2.0 * values[0] - values[reach:0:-1], values, 2.0 * values[-1] - values[-2 : -2 - reach : -1]]
    )
    total = np.cumsum(np.concatenate([[0.0], padded]))
    window = 2 * reach + 1
    return (total[window:] - total[:-window]) / window
