"""Tracks of a run in other formats, made of its MOTChallenge file once that is complete."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.track_command.people import Tracks, write_tracks
from servotrack.baselines.track_command.run import TRACKS, TrackRun
from servotrack.envs.track.files.mot_files import read_mot_detections, read_mot_tracks

FORMATS: Mapping[str, str] = {"csv": "tracks.csv", "jsonl": "tracks.jsonl", "coco": "tracks.json"}
"""Name of the file of each format."""


def write_formats(out: Path, formats: Sequence[str], run: TrackRun, size: tuple[int, int] | None) -> list[Path]:
    """Write the tracks of a run in other formats.

    Args:
        out: Folder of the run.
        formats: Names in `FORMATS`.
        run: The run.
        size: Width and height of the frames, px; None if unknown.

    Returns:
        Paths of the files.
    """
    paths = [out / FORMATS[name] for name in formats]
    for path in paths:
        write_tracks(_tracks(out / TRACKS, run), path, size)
    return paths


def _tracks(path: Path, run: TrackRun) -> Iterator[Tracks]:
    """Yield the tracks of every frame of a run."""
    people, scores = read_mot_tracks(path).by_frame(), read_mot_detections(path)
    for frame, time in zip(run.frames, run.times, strict=True):
        who = people.get(frame)
        if who is None:
            none = np.zeros(0)
            yield Tracks(frame, time, none.astype(np.int64), np.zeros((0, 4)), none)
            continue
        # Rows of a frame are in the order of its file, people in that of their ids.
        yield Tracks(
            frame, time, who.ids, who.boxes, _existence(scores[frame].boxes, scores[frame].confidences, who.boxes)
        )


def _existence(boxes: np.ndarray, confidences: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    distance = np.abs(boxes[None, :, :] - wanted[:, None, :]).sum(axis=2)
    return confidences[distance.argmin(axis=1)]
