"""The default tracker of people under a moving camera: a window that pans over a still scene, or shakes.

    python -m servotrack.baselines.tuning.people_camera SEQUENCE VIDEO

The sequence has the detections and the truth of the video's frames. The window is five eighths of the frame wide. It
goes back and forth by a constant number of px a frame, or by a random walk of that standard deviation. The same boxes
are tracked three times: in the coordinates of the scene, in those of the window with the motion of the camera taken
from the tracks, and with the motion that `PictureMotion` finds in the video's frames. Printed is IDF1.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.running.stopping import program
from servotrack.baselines.track_command.timed import TimedTracker
from servotrack.baselines.tuning.people_sequences import PeopleSequence, read_sequence, tracks_of
from servotrack.envs.track.files.frames import open_frames
from servotrack.estimators.detect import Detections, PictureMotion
from servotrack.estimators.metrics import Track, mot_scores
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Image

SPEEDS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Motions of the window, px per frame."""
SHARE = 0.625
"""Width of the window, frames."""


def window_path(length: int, span: float, speed: float, steady: bool, seed: int = 0) -> Array:
    """Left edge of the window in each frame, whole px. Shape (length,).

    Args:
        length: Number of frames.
        span: Largest value, px.
        speed: Px per frame: constant, back and forth, or the standard deviation of a random walk.
        steady: True for a constant speed.
        seed: Seed of the random walk.
    """
    walk = speed * np.arange(length)
    if not steady:
        walk = span / 2.0 + np.cumsum(np.random.default_rng(seed).normal(0.0, speed, length))
    return np.asarray(np.round(np.abs(walk % (2.0 * span) - span)))


def in_window(sequence: PeopleSequence, path: Array, width: float, moving: bool) -> PeopleSequence:
    """Return the part of a sequence that a window shows: boxes whose middle is in it.

    Args:
        sequence: The whole sequence.
        path: Left edge of the window in each frame, px. Shape (number of frames,).
        width: Width of the window, px.
        moving: True for coordinates of the window, False for those of the scene.
    """

    def shown(boxes: Array, left: Array) -> Array:
        middle = boxes[:, 0] + boxes[:, 2] / 2.0 - left
        return np.asarray((middle > 0.0) & (middle < width))

    frames, truth = [], []
    for found, left in zip(sequence.frames, path, strict=True):
        kept = shown(found.boxes, np.full(len(found.boxes), left))
        part = Detections(*(values[kept] for values in found))
        frames.append(part._replace(boxes=part.boxes - [left * moving, 0.0, 0.0, 0.0]))
    for track in sequence.truth:
        steps, boxes = np.asarray(track.steps), np.array(track.states, dtype=np.float64)
        kept = shown(boxes, path[steps])
        if kept.any():
            boxes[:, 0] -= path[steps] * moving
            truth.append(Track(steps[kept], boxes[kept]))
    size = sequence.frame_size
    if size is not None and moving:
        size = (round(width), size[1])
    return sequence._replace(frames=frames, truth=truth, frame_size=size)


def camera_motions(pictures: list[Image], frames: list[Detections], path: Array, width: float) -> list[Array | None]:
    """Motion of the camera in every frame, as the pictures in the window tell it."""
    motion, found = PictureMotion(), []
    state = motion.initial()
    for picture, seen, left in zip(pictures, frames, path, strict=True):
        part = np.ascontiguousarray(picture[:, int(left) : int(left + width)])
        state, shift = motion.step(state, part, seen.boxes)
        found.append(shift)
    return found


def identity_score(sequence: PeopleSequence, motions: list[Array | None] | None = None) -> float:
    """IDF1 of the default tracker, with the motion of the camera where it is given."""

    def answers() -> Iterator[SetEstimate]:
        tracker = TimedTracker(create_tracker("pmb", sequence.frame_size, sequence.frame_rate), sequence.frame_rate)
        for k, found in enumerate(sequence.frames):
            yield tracker.step(found, None, None if motions is None else motions[k])

    return mot_scores(sequence.truth, tracks_of(answers())).idf1


def main() -> None:
    """The command line above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", help="a folder, or NAME=DETECTIONS,TRUTH,RATE")
    parser.add_argument("video", help="the frames of the sequence")
    arguments = parser.parse_args()
    with program("run the same command again"):
        sequence = read_sequence(arguments.sequence)
        pictures = list(open_frames(arguments.video))
        count = min(len(pictures), len(sequence.frames))
        pictures, sequence = pictures[:count], sequence._replace(frames=sequence.frames[:count])
        sequence = sequence._replace(
            truth=[track for track in sequence.truth if np.asarray(track.steps)[-1] < count],
            frame_size=(pictures[0].shape[1], pictures[0].shape[0]),
        )
        wide = pictures[0].shape[1]
        width = round(SHARE * wide)
        for steady in (True, False):
            for speed in SPEEDS:
                path = window_path(count, wide - width, speed, steady)
                still, moving = (in_window(sequence, path, width, flag) for flag in (False, True))
                motions = camera_motions(pictures, moving.frames, path, width)
                scores = [identity_score(still), identity_score(moving), identity_score(moving, motions)]
                words = [f"{name} {100.0 * score:.1f}" for name, score in zip(_NAMES, scores, strict=True)]
                print(f"{'pan' if steady else 'shake'} {speed:g} px a frame: {', '.join(words)}", flush=True)


_NAMES = ("still", "motion from the tracks", "motion from the pictures")


if __name__ == "__main__":
    main()
