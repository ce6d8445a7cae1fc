"""Detectors and trackers of people by name, made for a frame's size and rate: what commands and observers choose from.

The parameters were chosen on PETS 2009 S2.L1 and TUD-Campus; docs/video.md has the protocol.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from servotrack.baselines.agents.people.trackers_package import PEERS, PeerTracker
from servotrack.estimators.boxes import (
    BoxPMB,
    BoxSetFilter,
    KalmanHungarian,
    KeptIdentities,
    RawDetections,
    centroid_model,
)
from servotrack.estimators.rfs import (
    GMPHD,
    PMB,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    MeasurementBirth,
    RawMeasurements,
    Reduction,
    Spawn,
)

Size = tuple[int, int]

REFERENCE_HEIGHT = 288.0
"""Height of the frames, px, that lengths in the set filters' presets refer to."""

REFERENCE_AREA = 380.0 * 280.0
"""Of paper 000's frames, px^2."""

BODY_WIDTH = 14.0
"""Of a person in frames of the reference height, px."""

REFERENCE_RATE = 10.0
"""Frames per second that velocities in the set filters' presets refer to."""

PHD_REDUCTION = Reduction(prune=1e-3, merge=4.0, components=30)
CBMEMBER_REDUCTION = Reduction(components=4, tracks=40, existence=1e-2)

MEMORY = 2.0
"""Time for which a lost identity can return, s."""


def create_tracker(name: str, frame_size: Size | None = None, frame_rate: float = 25.0) -> Any:
    """A tracker of boxes.

    Args:
        name: One of `TRACKERS`.
        frame_size: Width and height, px; None where unknown.
        frame_rate: Frames per second.

    Raises:
        ValueError: An unknown name; a size or rate that is not positive.
        ImportError: A peer whose package is not installed.
    """
    _check_name("tracker", name, TRACKERS)
    if frame_size is not None and not min(frame_size) >= 1:
        raise ValueError(f"frame_size must be width and height of at least 1 px, got {frame_size!r}")
    if not (np.isfinite(frame_rate) and frame_rate > 0.0):
        raise ValueError(f"frame_rate must be finite and > 0, got {frame_rate!r}")
    return TRACKERS[name](frame_size, float(frame_rate))


def create_detector(name: str, **parameters: Any) -> Any:
    """A detector of people in frames.

    Args:
        name: One of `DETECTORS`.
        **parameters: Of the detector, beyond its preset.

    Raises:
        ValueError: An unknown name, or a parameter out of range.
    """
    _check_name("detector", name, DETECTORS)
    return DETECTORS[name](**parameters)


def phd_as_printed(spawn: bool = True) -> GMPHD:
    """GM-PHD on centroids with paper 000's Table 1; births and spawning, which it does not give, are assumed.

    Args:
        spawn: Whether targets may split (step 2.2): one term of weight 0.02 and a body's width.
    """
    model = centroid_model(process_noise=4.0, measurement_noise=2.0)
    return GMPHD(
        model,
        MeasurementBirth(expected=0.05, hidden_deviation=2.0, largest=0.05, places=20),
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
    """Arguments of the Gaussian set filters on centroids, lengths by the frame's height and rates by its own."""
    scale = _scale(size)
    pace = scale * REFERENCE_RATE / rate
    return {
        "model": centroid_model(process_noise=2.0 * pace, measurement_noise=4.0 * scale),
        "birth": MeasurementBirth(expected=0.05, hidden_deviation=4.0 * pace, largest=0.05, places=20),
        "clutter_intensity": 0.05 / (REFERENCE_AREA * scale**2),
        "survival": 0.99,
        "detection": 0.9,
    }


def _set_filter(filter_class: Callable[..., Any], reduction: Reduction) -> Callable[[Size | None, float], Any]:
    def make(size: Size | None, rate: float) -> KeptIdentities:
        found = filter_class(**_centroid_setting(size, rate), reduction=reduction)
        return KeptIdentities(BoxSetFilter(found), memory=_frames(MEMORY, rate))

    return make


def centroid_filter(name: str, frame_size: Size | None = None, frame_rate: float = 25.0) -> Any:
    """A filter of `servotrack.estimators.rfs` for worlds whose measurements and answers are centroids.

    Args:
        name: "gm-phd", "gm-phd-paper", "gm-cbmember", "pmb", "kalman-hungarian" or "no-filter".
        frame_size: Width and height, px; None where unknown.
        frame_rate: Frames per second.

    Raises:
        ValueError: Another name.
    """
    setting = _centroid_setting(frame_size, frame_rate)
    pace = _scale(frame_size) * REFERENCE_RATE / frame_rate
    made: dict[str, Callable[[], Any]] = {
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


TRACKERS: Mapping[str, Callable[[Size | None, float], Any]] = {
    "pmb": lambda size, rate: BoxPMB(frame_rate=rate, frame_size=size),
    "gm-phd": _set_filter(GMPHD, PHD_REDUCTION),
    "gm-phd-paper": _paper,
    "gm-cbmember": _set_filter(GMCBMeMBer, CBMEMBER_REDUCTION),
    "kalman-hungarian": lambda size, rate: KalmanHungarian(frame_rate=rate),
    "no-filter": lambda size, rate: RawDetections(),
    **{name: _peer(name) for name in PEERS},
}
"""From a tracker's name to what makes it for a frame's size and rate."""


def _masked(**parameters: Any) -> Any:
    from servotrack.estimators.detect import MaskedBackground

    return MaskedBackground(**parameters)


def _masked_paper(**parameters: Any) -> Any:
    from dataclasses import replace

    from servotrack.estimators.detect import MaskedBackground

    return replace(MaskedBackground.paper(), **parameters)


def _mog2(**parameters: Any) -> Any:
    from servotrack.estimators.detect import MOG2Background

    return MOG2Background(**parameters)


def _knn(**parameters: Any) -> Any:
    from servotrack.estimators.detect import KNNBackground

    return KNNBackground(**parameters)


DETECTORS: Mapping[str, Callable[..., Any]] = {
    "masked": _masked,
    "masked-paper": _masked_paper,
    "mog2": _mog2,
    "knn": _knn,
}
"""From a detector's name to what makes it."""


def _check_name(kind: str, name: str, known: Iterable[str]) -> None:
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}"
    raise ValueError(f"no {kind} is called {name!r}; {hint}")
