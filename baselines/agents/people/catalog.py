"""Detectors and trackers of people by name, created for a frame size and frame rate.

The parameters were chosen on PETS 2009 S2.L1 and TUD-Campus; docs/video.md has the protocol.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.people.trackers_package import PEERS, PeerTracker
from servotrack.estimators.boxes import (
    BoxPMB,
    BoxSetFilter,
    KalmanHungarian,
    KeptIdentities,
    RawDetections,
    centroid_model,
)
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs import (
    GMPHD,
    PMB,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    MeasurementBirth,
    RawMeasurements,
    Reduction,
    SetEstimate,
    Spawn,
)
from servotrack.estimators.types import Estimator

Size = tuple[int, int]

CentroidFilter: TypeAlias = GMPHD | GMCBMeMBer | PMB | GlobalNearestNeighbor | RawMeasurements

BoxTracker: TypeAlias = "Estimator[Detections, Any, SetEstimate]"
"""Tracker of boxes: the detections of a frame in, people with identities out."""

Detector: TypeAlias = "Estimator[ArrayLike, Any, Detections]"
"""Detector of people: a frame in, detections out."""

REFERENCE_HEIGHT = 288.0
"""Frame height that lengths in the set filters' presets refer to, px."""

REFERENCE_AREA = 380.0 * 280.0
"""Area of Wu and Hu 2010's frames, px^2."""

BODY_WIDTH = 14.0
"""Width of a person in frames of the reference height, px."""

REFERENCE_RATE = 10.0
"""Frame rate that velocities in the set filters' presets refer to, 1/s."""

PHD_REDUCTION = Reduction(prune=1e-3, merge=4.0, components=30)
CBMEMBER_REDUCTION = Reduction(components=4, tracks=40, existence=1e-2)

MEMORY = 2.0
"""Longest time after which a lost identity can return, s."""


def create_tracker(name: str, frame_size: Size | None = None, frame_rate: float = 25.0) -> BoxTracker:
    """Create a tracker of boxes.

    Args:
        name: One of `TRACKERS`.
        frame_size: Width and height, px; None where unknown.
        frame_rate: Frames per second.

    Raises:
        ValueError: An unknown name; a size or rate that is not positive.
        ImportError: A tracker of the package `trackers`, which is not installed.
    """
    _check_name("tracker", name, TRACKERS)
    if frame_size is not None and (np.shape(frame_size) != (2,) or not all(side >= 1 for side in frame_size)):
        raise ValueError(f"frame_size must be width and height of at least 1 px, got {frame_size!r}")
    if not (np.isfinite(frame_rate) and frame_rate > 0.0):
        raise ValueError(f"frame_rate must be finite and > 0, got {frame_rate!r}")
    return TRACKERS[name](frame_size, float(frame_rate))


def create_detector(name: str, frame_rate: float | None = None, **parameters: Any) -> Detector:
    """Create a detector of people in frames.

    Args:
        name: One of `DETECTORS`.
        frame_rate: Frames per second, for detectors whose `step` is not given the time; None for their default.
        **parameters: Parameters of the detector that differ from its preset.

    Raises:
        ValueError: An unknown name, or a parameter out of range.
    """
    _check_name("detector", name, DETECTORS)
    if frame_rate is not None and name in TIMED_DETECTORS:
        parameters = {"frame_rate": float(frame_rate), **parameters}
    return DETECTORS[name](**parameters)


def phd_as_printed(spawn: bool = True) -> GMPHD:
    """Create the GM-PHD filter of centroids with Wu and Hu 2010's Table 1; births and spawning are assumed.

    Args:
        spawn: True lets targets split (step 2.2): one term of weight 0.02 and the width of a body.
    """
    model = centroid_model(process_noise=4.0, measurement_noise=2.0)
    return GMPHD(
        model,
        MeasurementBirth(expected=0.05, hidden_deviation=2.0, largest=0.05),
        clutter_intensity=0.01 / REFERENCE_AREA,
        survival=0.9,
        detection=0.99,
        spawn=(_split(0.02, 1.0),) if spawn else (),
        reduction=Reduction(prune=0.2, merge=5.0, components=50),
    )


def _paper(size: Size | None, rate: float) -> BoxSetFilter:
    return BoxSetFilter(phd_as_printed())


def _split(weight: float, scale: float) -> Spawn:
    noise = np.diag([(BODY_WIDTH * scale) ** 2, 1.0, (BODY_WIDTH * scale) ** 2, 1.0])
    return Spawn(weight, noise, centroid_model(1.0, 1.0).transition)


def _scale(size: Size | None) -> float:
    return 1.0 if size is None else size[1] / REFERENCE_HEIGHT


def _centroid_setting(size: Size | None, rate: float) -> dict[str, Any]:
    """Return arguments of the Gaussian set filters of centroids, scaled to the frame's height and rate."""
    scale = _scale(size)
    pace = scale * REFERENCE_RATE / rate
    return {
        "model": centroid_model(process_noise=2.0 * pace, measurement_noise=4.0 * scale),
        "birth": MeasurementBirth(expected=0.05, hidden_deviation=4.0 * pace, largest=0.05),
        "clutter_intensity": 0.05 / (REFERENCE_AREA * scale**2),
        "survival": 0.99,
        "detection": 0.9,
    }


def _set_filter(
    filter_class: Callable[..., GMPHD | GMCBMeMBer], reduction: Reduction
) -> Callable[[Size | None, float], KeptIdentities]:
    def make(size: Size | None, rate: float) -> KeptIdentities:
        found = filter_class(**_centroid_setting(size, rate), reduction=reduction)
        return KeptIdentities(BoxSetFilter(found), memory=_frames(MEMORY, rate))

    return make


def centroid_filter(name: str, frame_size: Size | None = None, frame_rate: float = 25.0) -> CentroidFilter:
    """Create a filter of `servotrack.estimators.rfs` for worlds whose measurements and answers are centroids.

    Args:
        name: "gm-phd", "gm-phd-paper", "gm-cbmember", "pmb", "kalman-hungarian" or "no-filter".
        frame_size: Width and height, px; None where unknown.
        frame_rate: Frames per second.

    Raises:
        ValueError: Another name.
    """
    setting = _centroid_setting(frame_size, frame_rate)
    pace = _scale(frame_size) * REFERENCE_RATE / frame_rate
    made: dict[str, Callable[[], CentroidFilter]] = {
        "gm-phd": lambda: GMPHD(**setting, reduction=PHD_REDUCTION),
        "gm-phd-paper": phd_as_printed,
        "gm-cbmember": lambda: GMCBMeMBer(**setting, reduction=CBMEMBER_REDUCTION),
        "pmb": lambda: PMB(**setting, reduction=Reduction(components=4, tracks=40)),
        "kalman-hungarian": lambda: GlobalNearestNeighbor(setting["model"], hidden_deviation=4.0 * pace, misses=8),
        "no-filter": lambda: RawMeasurements(setting["model"]),
    }
    _check_name("filter of centroids", name, made)
    return made[name]()


def _frames(seconds: float, rate: float) -> int:
    return max(round(seconds * rate), 1)


def _peer(name: str) -> Callable[[Size | None, float], PeerTracker]:
    return lambda size, rate: PeerTracker(name, rate)


TRACKERS: Mapping[str, Callable[[Size | None, float], BoxTracker]] = {
    "pmb": lambda size, rate: BoxPMB(frame_rate=rate, frame_size=size),
    "gm-phd": _set_filter(GMPHD, PHD_REDUCTION),
    "gm-phd-paper": _paper,
    "gm-cbmember": _set_filter(GMCBMeMBer, CBMEMBER_REDUCTION),
    "kalman-hungarian": lambda size, rate: KalmanHungarian(frame_rate=rate),
    "no-filter": lambda size, rate: RawDetections(),
    **{name: _peer(name) for name in PEERS},
}
"""Factory of each tracker, called with frame size and frame rate."""


def _masked(**parameters: Any) -> Detector:
    from servotrack.estimators.detect import MaskedBackground

    return MaskedBackground(**parameters)


def _masked_paper(**parameters: Any) -> Detector:
    from dataclasses import replace

    from servotrack.estimators.detect import MaskedBackground

    return replace(MaskedBackground.paper(), **parameters)


def _mog2(**parameters: Any) -> Detector:
    from servotrack.estimators.detect import MOG2Background

    return MOG2Background(**parameters)


def _knn(**parameters: Any) -> Detector:
    from servotrack.estimators.detect import KNNBackground

    return KNNBackground(**parameters)


DETECTORS: Mapping[str, Callable[..., Detector]] = {
    "masked": _masked,
    "masked-paper": _masked_paper,
    "mog2": _mog2,
    "knn": _knn,
}
"""Factory of each detector."""

TIMED_DETECTORS = ("masked", "masked-paper")
"""Detectors with rules in seconds, which take a frame rate."""


def _check_name(kind: str, name: str, known: Iterable[str]) -> None:
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}"
    raise ValueError(f"no {kind} is called {name!r}; {hint}")
