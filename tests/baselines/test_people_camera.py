"""A window that moves over a still scene, and what the report says of a camera that moves."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.baselines.track_command.notices import CameraReport
from servotrack.baselines.tuning.people_camera import camera_motions, identity_score, in_window, window_path
from servotrack.baselines.tuning.people_sequences import PeopleSequence
from servotrack.estimators.detect import detections_from_boxes
from servotrack.estimators.metrics import Track

COUNT, SIZE, WIDTH = 80, (480, 240), 300


@pytest.fixture(scope="module")
def scene() -> tuple[PeopleSequence, list[np.ndarray]]:
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(40, 220, (24, 48, 3), np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    feet = [(100.0, 1.0), (160.0, 1.3), (260.0, -0.8), (330.0, -1.1)]
    boxes = np.array([[[x + v * k, 60.0 + 15 * i, 30.0, 80.0] for i, (x, v) in enumerate(feet)] for k in range(COUNT)])
    noisy = boxes + rng.normal(0.0, 1.0, boxes.shape)
    frames = [detections_from_boxes(one, rng.uniform(0.6, 0.9, len(one))) for one in noisy]
    truth = [Track(np.arange(COUNT), boxes[:, i]) for i in range(len(feet))]
    return PeopleSequence("scene", 10.0, SIZE, frames, truth), [ground.copy() for _ in range(COUNT)]


def test_the_window_shows_the_same_boxes_in_other_coordinates(scene) -> None:
    sequence, _ = scene
    path = window_path(COUNT, SIZE[0] - WIDTH, 6.0, True)
    assert path.min() >= 0.0 and path.max() <= SIZE[0] - WIDTH and np.abs(np.diff(path)).max() == 6.0
    still, moving = (in_window(sequence, path, WIDTH, flag) for flag in (False, True))
    for a, b, left in zip(still.frames, moving.frames, path, strict=True):
        assert np.allclose(a.boxes - [left, 0.0, 0.0, 0.0], b.boxes)
    assert moving.frame_size == (WIDTH, SIZE[1]) and still.frame_size == SIZE
    assert len(still.truth) == len(moving.truth)


def test_pictures_make_a_moving_camera_as_good_as_a_still_one(scene) -> None:
    sequence, pictures = scene
    path = window_path(COUNT, SIZE[0] - WIDTH, 12.0, False)
    still, moving = (in_window(sequence, path, WIDTH, flag) for flag in (False, True))
    motions = camera_motions(pictures, moving.frames, path, WIDTH)
    assert motions[0] is None
    shifts = np.array([motion[0, 2] for motion in motions[1:]])
    assert np.abs(shifts + np.diff(path)).max() < 0.6
    best, with_pictures, with_tracks = identity_score(still), identity_score(moving, motions), identity_score(moving)
    assert with_pictures > best - 0.03
    assert with_pictures >= with_tracks


def test_the_report_says_how_far_the_camera_moved() -> None:
    report = CameraReport()
    report.take(0, None, (240, 320, 3))
    for k in range(1, 20):
        report.take(k, np.eye(2, 3), (240, 320, 3))
    assert report.lines() == []
    for k in range(20, 30):
        report.take(k, np.array([[1.0, 0.0, 6.4], [0.0, 1.0, 0.0]]), (240, 320, 3))
    (line,) = report.lines()
    assert line.startswith("the camera moves from frame 20 on, by 2.00 % of the width")
    for k in range(30, 60):
        report.take(k, None, (240, 320, 3))
    assert "unknown in 30 frames" in report.lines()[1]
