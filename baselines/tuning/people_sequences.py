"""Sequences of detections with truth, on which trackers of people are compared and tuned.

A sequence is what a detector gives, frame by frame, with the true boxes. Besides sequences as recorded there are three
variants of each that a tracker must follow as well: backwards, at half the frame rate, and both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from servotrack.baselines.agents.people.catalog import BoxTracker, create_detector
from servotrack.envs.track.files.mot_files import find_mot_folder, read_mot_detections, read_mot_tracks
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import FRAME_RATES, SequenceError
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.metrics import MotScores, Track, mot_scores
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Mask

ENVIRONMENT = "PedestrianTracking-v0"
LEAST_VISIBLE = 0.2
"""Visible share from which a rendered person counts."""
NOMINAL_RATE = 25.0
"""Frame rate of a sequence that does not say it, 1/s."""


class PeopleSequence(NamedTuple):
    """A sequence of detections with truth.

    Attributes:
        name: Name for tables.
        frame_rate: Frames per second.
        frame_size: Width and height, px; None if unknown.
        frames: Detections of each frame.
        truth: True tracks; steps count frames from 0, states are boxes (left, top, width, height), px.
    """

    name: str
    frame_rate: float
    frame_size: tuple[int, int] | None
    frames: list[Detections]
    truth: list[Track]


def read_sequence(given: str) -> PeopleSequence:
    """Read a sequence.

    Args:
        given: The folder of a MOTChallenge sequence with det/det.txt and gt/gt.txt, or NAME=DETECTIONS,TRUTH,RATE with
            a det.txt, a file that `read_tracks` reads, and the frames per second.

    Raises:
        SequenceError: A missing or invalid file, or another form.
    """
    if "=" in given and not Path(given).exists():
        name, _, rest = given.partition("=")
        parts = rest.split(",")
        if len(parts) != 3:
            raise SequenceError(
                f"{given!r} must be NAME=DETECTIONS,TRUTH,RATE or the folder of a MOTChallenge sequence"
            )
        try:
            rate = float(parts[2])
        except ValueError:
            rate = 0.0
        if not FRAME_RATES[0] <= rate <= FRAME_RATES[1]:
            raise SequenceError(f"{given!r}: the frame rate must be from 0.1 to 1000, got {parts[2]!r}")
        return _sequence(name, rate, None, Path(parts[0]), read_tracks(parts[1]).tracks, 0)
    folder = find_mot_folder(given)
    if folder is None or folder.detections is None or folder.truth is None:
        raise SequenceError(f"{given} must be a folder with det/det.txt and gt/gt.txt")
    info = folder.info
    size = (info.width, info.height) if info.width and info.height else None
    truth = read_mot_tracks(folder.truth).tracks
    return _sequence(info.name, info.frame_rate or NOMINAL_RATE, size, folder.detections, truth, info.length or 0)


def rendered_sequence(level: int, seed: int, detector: str = "masked") -> PeopleSequence:
    """Detections of a rendered crowd of `PedestrianTracking-v0`.

    Args:
        level: Level of the environment.
        seed: Seed of the episode.
        detector: Name of the detector.
    """
    env = gym.make(ENVIRONMENT, level=level)
    image, info = env.reset(seed=seed)
    model = env.get_wrapper_attr("scene_model")
    answer = np.zeros(env.action_space.shape or (), np.float32)
    found = create_detector(detector, model.frame_rate)
    state: Any = found.initial(image)
    frames: list[Detections] = []
    truth: dict[int, tuple[list[int], list[Any]]] = {}
    over = False
    while not over:
        state, detections = found.step(state, image)
        true = info["truth"]
        for identity, box, visible in zip(true["ids"], true["boxes"], true["visibility"], strict=True):
            if identity > 0 and visible >= LEAST_VISIBLE:
                steps, boxes = truth.setdefault(int(identity), ([], []))
                steps.append(len(frames))
                boxes.append(box)
        frames.append(detections)
        image, _, ended, truncated, info = env.step(answer)
        over = bool(ended or truncated)
    tracks = [Track(np.array(steps), np.array(boxes, dtype=np.float64)) for steps, boxes in truth.values()]
    return PeopleSequence(f"rendered {level}, {seed}", model.frame_rate, (model.width, model.height), frames, tracks)


def reversed_in_time(sequence: PeopleSequence) -> PeopleSequence:
    """Return the sequence backwards."""
    last = len(sequence.frames) - 1
    truth = [Track((last - steps)[::-1].copy(), states[::-1].copy()) for steps, states in sequence.truth]
    return sequence._replace(name=f"{sequence.name} backwards", frames=sequence.frames[::-1], truth=truth)


def thinned(sequence: PeopleSequence, keep: Mask) -> PeopleSequence:
    """Return some frames of a sequence, at the same nominal frame rate.

    Args:
        sequence: The sequence.
        keep: Mask of the frames that are kept. Shape (number of frames,).
    """
    place = np.cumsum(keep) - 1
    truth = []
    for steps, states in sequence.truth:
        there = keep[steps]
        if there.any():
            truth.append(Track(place[steps[there]], states[there]))
    return sequence._replace(frames=[sequence.frames[k] for k in np.flatnonzero(keep)], truth=truth)


def at_half_rate(sequence: PeopleSequence) -> PeopleSequence:
    """Return every second frame of a sequence."""
    half = thinned(sequence, np.arange(len(sequence.frames)) % 2 == 0)
    return half._replace(name=f"{sequence.name} at half rate", frame_rate=sequence.frame_rate / 2.0)


def estimates(
    tracker: BoxTracker, sequence: PeopleSequence, dts: Sequence[float] | None = None
) -> Iterator[SetEstimate]:
    """Yield a tracker's estimate of every frame.

    Args:
        tracker: Tracker of boxes.
        sequence: The sequence.
        dts: Time before each frame, s, for trackers whose `step` takes it; None for the nominal one.
    """
    state: Any = tracker.initial(sequence.frames[0])
    for k, frame in enumerate(sequence.frames):
        if dts is None:
            state, estimate = tracker.step(state, frame)
        else:
            state, estimate = tracker.step(state, frame, dts[k])  # type: ignore[call-arg]
        yield estimate


def tracks_of(answers: Iterator[SetEstimate]) -> list[Track]:
    """Collect the reported boxes of every identity."""
    rows: dict[int, tuple[list[int], list[Any]]] = {}
    for k, estimate in enumerate(answers):
        for label, box in zip(estimate.labels.tolist(), estimate.states, strict=True):
            steps, boxes = rows.setdefault(label, ([], []))
            steps.append(k)
            boxes.append(box)
    return [Track(np.array(steps), np.array(boxes)) for steps, boxes in rows.values()]


def score(tracker: BoxTracker, sequence: PeopleSequence) -> MotScores:
    """Run a tracker over a sequence and score it as MOTChallenge does, boxes matched at an overlap of 0.5."""
    return mot_scores(sequence.truth, tracks_of(estimates(tracker, sequence)))


def _sequence(
    name: str, rate: float, size: tuple[int, int] | None, detections: Path, truth: list[Track], length: int
) -> PeopleSequence:
    found = read_mot_detections(detections)
    last = max([length - 1, *found, *(int(track.steps[-1]) for track in truth)])
    nothing = detections_from_boxes(np.zeros((0, 4)))
    return PeopleSequence(name, rate, size, [found.get(k, nothing) for k in range(last + 1)], truth)
