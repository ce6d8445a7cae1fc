"""`servotrack.track` and `servotrack.Tracker`: tracks in a loop of one's own."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.track_command.inputs import NOMINAL_RATE, Input
from servotrack.baselines.track_command.notices import NewNotes
from servotrack.baselines.track_command.opening import SourceRequest, open_input, working_size
from servotrack.baselines.track_command.people import Tracks
from servotrack.baselines.track_command.timed import TimedTracker, estimates
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.validation import as_numbers


class Tracker:
    """A tracker that keeps its state: boxes of a frame in, people with identities out.

    Args:
        name: One of the trackers of `servotrack track`, such as `pmb`.
        frame_rate: Frames per second, for frames without a time.
        frame_size: Width and height of the frames, px; None if unknown.
        **values: Parameters of the tracker that differ from its defaults; those of its parts in the form
            `**{"tracker.filter.survival": 0.99}`.

    Raises:
        ValueError: An unknown name or parameter, or a number out of range.
    """

    def __init__(
        self,
        name: str = "pmb",
        *,
        frame_rate: float = NOMINAL_RATE,
        frame_size: tuple[int, int] | None = None,
        **values: float,
    ) -> None:
        made = with_values(create_tracker(name, frame_size, frame_rate), values)
        self._timed, self._rate = TimedTracker(made, frame_rate), frame_rate
        self._frame, self._start, self._time = -1, None, 0.0  # type: tuple[int, float | None, float]

    def update(
        self,
        detections: Any = (),
        *,
        confidences: ArrayLike | None = None,
        features: ArrayLike | None = None,
        time: float | None = None,
        motion: ArrayLike | None = None,
    ) -> Tracks:
        """Process the detections of the next frame.

        Args:
            detections: Left, top, width, height, px, shape (k, 4), or with the confidence as fifth number, shape
                (k, 5); or `supervision.Detections`; or `servotrack.estimators.detect.Detections`. Call it for frames
                without detections, too.
            confidences: Shape (k,); None for 1, or those of the detections.
            features: Appearance vectors of unit length, shape (k, F); None for none.
            time: Time of the frame, s, on any scale; None: one period after the last frame.
            motion: Motion of the picture by the camera: maps a point (x, y, 1) of the last frame to this one, shape
                (2, 3), px, as `servotrack.estimators.detect.PictureMotion` finds it; None: estimated from the tracks.

        Returns:
            The people in this frame.

        Raises:
            ValueError: Detections of another shape, a time that is not after that of the last frame, or a motion that
                is no similarity.
        """
        found = as_detections(detections, confidences, features)
        estimate = self._timed.step(found, time, motion)
        self._frame += 1
        if time is None:
            self._time += 1.0 / self._rate if self._frame else 0.0
        else:
            self._start = time - self._time if self._start is None else self._start
            self._time = time - self._start
        return _tracks(self._frame, self._time, estimate)


def track(
    source: str | Path | int,
    *,
    detector: str | Path = "auto",
    tracker: str = "pmb",
    classes: Sequence[str | int] | None = None,
    confidence: float | None = None,
    size: str = "auto",
    start: int = 0,
    frames: int | None = None,
    stride: int = 1,
    background: int = 40,
    white: float | None = None,
    values: Mapping[str, float] | None = None,
) -> Iterator[Tracks]:
    """Track people in a video, an image folder, a MOTChallenge sequence, a camera or a stream.

        for tracks in servotrack.track("clip.mp4", detector="people.onnx"):
            print(tracks.frame, tracks.ids, tracks.boxes)

    Args:
        source: Video file, folder, index of a camera, or an address that begins with http, https, rtsp or rtsps.
        detector: Name of a detector, an ONNX file, or `file` for the detections of a MOTChallenge sequence. `auto`:
            those, if there are any, else `masked`.
        tracker: Name of a tracker.
        classes: Names or numbers of the classes that a network finds; None: people.
        confidence: Smallest confidence of detections; None: 0.25 for a network, all of a file.
        size: Frame size for the detector: `WxH`, `source`, `fit` (within 384x288 px), or `auto`: `source` for networks,
            else `fit`.
        start: First frame, from 0.
        frames: Largest number of frames; None for all.
        stride: Use every stride-th frame.
        background: Number of frames of a first pass that shows the background; 0: none, strictly online.
        white: Value that is white in images of more than 8 bits; None: from the images.
        values: Parameters of the tracker that differ from its defaults.

    Yields:
        The people in each frame, with the frame as `image` where there is one. Missing frames are left out.

    Warns:
        UserWarning: Something does not work, or a fact about the source: once, at the frame from which it holds.

    Raises:
        SequenceError: The source cannot be opened, or is broken; tracks of the frames before were yielded.
        ValueError: An unknown name, or a number out of range.
    """
    request = SourceRequest(
        source if isinstance(source, int) else str(source),
        str(detector),
        None if classes is None else tuple(classes),
        confidence,
        size,
        start,
        frames,
        stride,
        background,
        white,
    )
    found, _ = open_input(request)
    made = with_values(create_tracker(tracker, working_size(found), found.frame_rate), values or {})
    return _followed(found, TimedTracker(made, found.frame_rate))


def _followed(source: Input, tracker: TimedTracker) -> Iterator[Tracks]:
    new = NewNotes()
    for step, estimate in estimates(source, tracker):
        for note in new.of(source.notes):
            warnings.warn(note, stacklevel=2)
        yield _tracks(step.number, step.time, estimate, step.picture)


def as_detections(given: Any, confidences: ArrayLike | None = None, features: ArrayLike | None = None) -> Detections:
    """Return detections of any accepted form; see `Tracker.update`.

    Raises:
        ValueError: Another form or shape.
    """
    if isinstance(given, Detections):
        return given
    if hasattr(given, "xyxy"):
        corners = as_numbers("detections.xyxy", given.xyxy)
        if corners.size and (corners.ndim != 2 or corners.shape[1] != 4):
            raise ValueError(f"detections.xyxy must have shape (k, 4), got {corners.shape}")
        corners = corners.reshape(-1, 4)
        boxes = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
        confidences = getattr(given, "confidence", None) if confidences is None else confidences
    else:
        boxes = as_numbers("detections", given)
        boxes = boxes.reshape(0, 4) if boxes.size == 0 else boxes
        if boxes.ndim == 2 and boxes.shape[1] == 5 and confidences is None:
            boxes, confidences = boxes[:, :4], boxes[:, 4]
    found = detections_from_boxes(boxes, confidences)
    if features is None:
        return found
    vectors = as_numbers("features", features)
    if vectors.ndim != 2 or len(vectors) != len(boxes) or not np.isfinite(vectors).all():
        raise ValueError(f"features must be finite with shape ({len(boxes)}, F), got {vectors.shape}")
    return found._replace(features=vectors)


def _tracks(frame: int, time: float, estimate: SetEstimate, image: Any = None) -> Tracks:
    labels, boxes, existence = estimate.labels.copy(), estimate.states.copy(), estimate.existence.copy()
    return Tracks(frame, time, labels, boxes, existence, image, estimate)
