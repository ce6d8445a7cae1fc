"""Adapter that runs trackers of the PyPI package `trackers` (optional) on our worlds.

Their trackers change in place: only the newest state can be stepped from.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from servotrack.estimators.boxes import checked_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import SetEstimate

PEERS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "sort": ("SORTTracker", {}),
    "bytetrack": ("ByteTrackTracker", {}),
    "oc-sort": ("OCSORTTracker", {}),
    # Without images there is no camera motion to compensate.
    "bot-sort": ("BoTSORTTracker", {"enable_cmc": False}),
    "c-biou": ("CBIoUTracker", {}),
}
"""Class in the package, and the arguments that differ from its defaults, by our name."""


class _PackageTracker(Protocol):
    """Interface of the trackers of the package `trackers`."""

    def update(self, detections: Any) -> Any:
        """Update the tracks with the detections of one frame."""


class _Model:
    """A tracker of the package and the number of frames that it has processed."""

    def __init__(self, tracker: _PackageTracker) -> None:
        self.tracker = tracker
        self.frames = 0


class PeerState(NamedTuple):
    """State of a `PeerTracker`.

    Attributes:
        model: Tracker that all states of a sequence share: only the newest state can be stepped from.
        frames: Number of frames processed.
    """

    model: _Model
    frames: int


@dataclass(frozen=True)
class PeerTracker:
    """A tracker of the package `trackers` with its own default parameters.

    Args:
        name: One of `PEERS`.
        frame_rate: Frames per second.

    Raises:
        ValueError: An unknown name.
        ImportError: The package is not installed.
    """

    name: str
    frame_rate: float = 25.0

    def __post_init__(self) -> None:
        if self.name not in PEERS:
            raise ValueError(
                f"no tracker of the package trackers is called {self.name!r}; known are {', '.join(PEERS)}"
            )
        _package("trackers")
        _package("supervision")

    def initial(self, detections: Detections) -> PeerState:
        """Return the state of a new tracker; the detections are ignored."""
        class_name, parameters = PEERS[self.name]
        made = getattr(_package("trackers"), class_name)(frame_rate=self.frame_rate, **parameters)
        return PeerState(_Model(made), 0)

    def step(self, state: PeerState, detections: Detections) -> tuple[PeerState, SetEstimate]:
        """Process a frame. The state before cannot be stepped from again.

        Raises:
            ValueError: Detections that are not finite, or a state that is not the newest.
        """
        checked_detections(detections)
        model = state.model
        if model.frames != state.frames:
            raise ValueError(
                f"state is of frame {state.frames}, but its tracker is at frame {model.frames}; "
                "step from the last state"
            )
        boxes, count = np.array(detections.boxes, dtype=np.float64), len(detections.boxes)
        corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
        seen = _package("supervision").Detections(
            xyxy=corners, confidence=np.array(detections.confidences), class_id=np.zeros(count, np.int64)
        )
        found = model.tracker.update(seen)
        model.frames += 1
        labels = np.full(len(found), -1) if found.tracker_id is None else np.asarray(found.tracker_id, np.int64)
        # The package's identities start at 0, and -1 is a track that it does not report yet.
        shown = labels >= 0
        xyxy = np.asarray(found.xyxy, dtype=np.float64).reshape(-1, 4)[shown]
        reported = np.concatenate([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]], axis=1)
        total = int(shown.sum())
        estimate = set_of_boxes(reported, np.zeros((total, 4, 4)), labels[shown] + 1, np.ones(total))
        return PeerState(model, model.frames), estimate


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f'this tracker needs the package {name}, which is not installed: pip install "servotrack[trackers]"'
        ) from error
