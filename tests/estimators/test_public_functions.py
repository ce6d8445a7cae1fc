"""Functions beside the estimators refuse what is no array of numbers by the argument's name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from servotrack.estimators import boxes, color, detect, follow, hmm, metrics, rfs, sonar

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
BOXES = np.array([[1.0, 2.0, 10.0, 20.0]])
POINTS = np.array([[1.0, 2.0]])
PATHS = np.random.default_rng(0).random((2, 5, 2))
METER, MOTION = color.LightMeter(), detect.PictureMotion()

CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "detections_from_boxes": (detect.detections_from_boxes, {"boxes": BOXES, "confidences": np.array([0.5])}),
    "box_appearance": (detect.box_appearance, {"image": IMAGE, "boxes": BOXES}),
    "color_bins": (detect.color_bins, {"image": IMAGE}),
    "PictureMotion": (
        lambda frame, boxes: MOTION.step(MOTION.step(MOTION.initial(), IMAGE, boxes)[0], frame, ()),
        {"frame": IMAGE, "boxes": BOXES},
    ),
    "LightMeter": (lambda image: METER.next(METER.initial(IMAGE), image), {"image": IMAGE}),
    "patch_color": (follow.patch_color, {"patch": IMAGE[:32, :32].astype(np.float64)}),
    "box_distances": (metrics.box_distances, {"first": BOXES, "second": BOXES}),
    "centroid_distances": (metrics.centroid_distances, {"first": BOXES, "second": BOXES}),
    "point_distances": (metrics.point_distances, {"first": POINTS, "second": POINTS}),
    "gospa": (lambda truth, estimate: metrics.gospa(truth, estimate, 10.0), {"truth": POINTS, "estimate": POINTS}),
    "ospa2": (lambda truth, estimate: metrics.ospa2(truth, estimate, 10.0), {"truth": PATHS, "estimate": PATHS}),
    "trajectory_gospa": (
        lambda truth, estimate: metrics.trajectory_gospa(truth, estimate, 10.0, 1.0),
        {"truth": PATHS, "estimate": PATHS},
    ),
    "tracks_from_rows": (metrics.tracks_from_rows, {"labels": np.array([[1, 2]]), "states": PATHS[:1, :2]}),
    "rows_to_tracks": (rfs.rows_to_tracks, {"rows": np.array([[1.0, 2.0, 3.0]])}),
    "measurements_to_rows": (lambda measurements: rfs.measurements_to_rows(measurements, 5), {"measurements": POINTS}),
    "normalize": (sonar.normalize, {"powers": PATHS[0].T + 1.0}),
    "presence": (hmm.presence, {"existence_likelihood": PATHS[0, :, 0]}),
    "spans": (hmm.spans, {"probability": PATHS[0, :, 0]}),
    "people_count": (lambda corners: boxes.ZoneCount(corners), {"corners": [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0)]}),
}
ARGUMENTS = [(name, argument) for name, (_, arguments) in CALLS.items() for argument in arguments]
READS_GAPS = ("distances", "gospa", "ospa2", "tracks_from_rows")
"""Parts of the names of functions in which NaN stands for a member that is not there, or stays what it is."""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("name", "argument"), ARGUMENTS)
def test_arguments_are_numbers(name: str, argument: str) -> None:
    call, arguments = CALLS[name]
    call(**arguments)
    plain = np.asarray(arguments[argument])
    bad = [plain.astype(str), plain.astype(complex), np.full(plain.shape, None), [[1.0], [1.0, 2.0]]]
    bad += [None] if argument != "confidences" else []
    if plain.dtype.kind == "f" and not any(part in name for part in READS_GAPS):
        for value in (np.nan, np.inf):
            bad.append(plain.copy())
            bad[-1][(0,) * plain.ndim] = value
    if plain.dtype == np.uint8:
        bad += [plain.astype(np.uint16), plain.astype(np.float64)]
    for value in bad:
        with pytest.raises(ValueError, match=rf"\b{argument}|\b(frame|image) must"):
            call(**{**arguments, argument: value})


def test_the_light_meter_refuses_frames_of_another_size() -> None:
    with pytest.raises(ValueError, match=r"image must have the height and width .* got \(5, 5\)"):
        METER.next(METER.initial(IMAGE), IMAGE[:5, :5])


@pytest.mark.parametrize(
    "values", [{"width": np.inf}, {"window": 6.5}, {"corners": 1e9}, {"tolerance": np.inf}, {"least_corners": np.nan}]
)
def test_parameters_of_the_picture_motion_are_checked(values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        detect.PictureMotion(**values)
