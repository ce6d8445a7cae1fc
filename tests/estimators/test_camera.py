"""Motion of the camera, from pictures and from tracks: what moves with it, and what a still camera does not do."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from servotrack.estimators.boxes import BoxPMB
from servotrack.estimators.boxes.camera import CameraRules
from servotrack.estimators.detect import PictureMotion, detections_from_boxes
from servotrack.estimators.types import Array

FRAMES, PEOPLE, HEIGHT = 60, 6, 80.0


def crowd(shifts: Array, seed: int = 0) -> list[Array]:
    """Boxes of people who walk on a plane, as a camera sees them that moves by these shifts. Lists of (k, 4)."""
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(150.0, 450.0, PEOPLE), 40.0 * np.arange(PEOPLE) + 60.0])
    velocity = rng.normal(0.0, 1.0, (PEOPLE, 2))
    frames = []
    for moved in np.cumsum(shifts, axis=0):
        place = place + velocity
        noise = rng.normal(0.0, 1.5, (PEOPLE, 2))
        frames.append(np.column_stack([place + moved + noise, np.full(PEOPLE, 0.4 * HEIGHT), np.full(PEOPLE, HEIGHT)]))
    return frames


def follow(frames: list[Array], motions: list[Any] | None = None, **values: Any) -> tuple[int, Array, Any]:
    """Number of identities, the estimated shifts (frames, 2), and the state after the last frame."""
    tracker = BoxPMB(frame_rate=10.0, frame_size=None, **values)
    state = tracker.initial(detections_from_boxes(np.zeros((0, 4))))
    labels: set[int] = set()
    shifts = []
    for k, boxes in enumerate(frames):
        motion = None if motions is None else motions[k]
        state, estimate = tracker.step(state, detections_from_boxes(boxes), None, motion)
        labels.update(estimate.labels.tolist())
        shifts.append(state.camera.shift)
    return len(labels), np.array(shifts), state


def test_jolts_of_the_camera_keep_identities() -> None:
    shifts = np.zeros((FRAMES, 2))
    shifts[20:, 0] = np.where(np.arange(FRAMES - 20) % 2, -60.0, 60.0)
    frames = crowd(shifts)
    assert follow(frames, camera=None)[0] > PEOPLE + 3
    number, found, _ = follow(frames)
    assert number == PEOPLE
    assert np.abs(found[21:, 0] - shifts[21:, 0]).mean() < 4.0


def test_a_shaking_camera_is_learned() -> None:
    shifts = np.random.default_rng(1).normal(0.0, 6.0, (FRAMES, 2))
    _, found, _ = follow(crowd(shifts))
    assert np.std(found[20:] - shifts[20:]) < 0.6 * np.std(shifts[20:])


def test_a_still_camera_stays_still() -> None:
    lengths = []
    for seed in range(5):
        number, found, _ = follow(crowd(np.zeros((FRAMES, 2)), seed))
        assert number == PEOPLE
        lengths.append(np.abs(found).mean())
    assert np.mean(lengths) < 0.15


def test_a_motion_that_is_given_moves_the_tracks() -> None:
    turn, scale, frames, motions = 0.02, 1.01, [], []
    whole = np.eye(3)
    one = np.eye(3)
    one[:2] = [
        [scale * np.cos(turn), -scale * np.sin(turn), 12.0],
        [scale * np.sin(turn), scale * np.cos(turn), -7.0],
    ]
    for boxes in crowd(np.zeros((FRAMES, 2))):
        whole = one @ whole
        center = np.column_stack([boxes[:, :2] + boxes[:, 2:] / 2.0, np.ones(len(boxes))]) @ whole[:2].T
        size = boxes[:, 2:] * np.sqrt(np.linalg.det(whole[:2, :2]))
        frames.append(np.column_stack([center - size / 2.0, size]))
        motions.append(one[:2])
    number, found, state = follow(frames, motions)
    assert number == PEOPLE
    assert np.allclose(found, [12.0, -7.0])
    # Known motion leaves people's own velocities, which are slow.
    still = follow(crowd(np.zeros((FRAMES, 2))))[2]
    own = np.hypot(*state.tracks.mean[:, [1, 3]].T) / state.tracks.mean[:, 5]
    assert np.allclose(np.sort(own), np.sort(np.hypot(*still.tracks.mean[:, [1, 3]].T) / HEIGHT), atol=0.1)


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        (np.eye(3), "motion must have shape"),
        (np.full((2, 3), np.nan), "motion"),
        (np.zeros((2, 3)), "motion must keep areas"),
        (np.full((2, 3), "a"), "motion"),
    ],
)
def test_a_motion_that_cannot_be_is_refused(motion: Any, says: str) -> None:
    tracker = BoxPMB()
    none = detections_from_boxes(np.zeros((0, 4)))
    with pytest.raises(ValueError, match=says):
        tracker.step(tracker.initial(none), none, None, motion)


def test_nobody_in_view_is_no_error() -> None:
    frames = crowd(np.zeros((12, 2)))
    number, found, _ = follow([*frames, np.zeros((0, 4)), np.zeros((0, 4)), *frames[-1:]])
    assert number == PEOPLE and np.isfinite(found).all()
    assert follow(frames, camera=CameraRules(least=100.0))[0] == PEOPLE


def picture(seed: int = 0) -> Array:
    coarse = np.random.default_rng(seed).integers(40, 220, (40, 60, 3), np.uint8)
    return cv2.resize(coarse, (900, 600), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("step", [(0, 0), (1, 0), (8, -3), (25, 10)])
def test_pictures_tell_the_motion_to_a_fraction_of_a_pixel(step: tuple[int, int]) -> None:
    ground, motion = picture(), PictureMotion()
    state, rng = motion.initial(), np.random.default_rng(1)
    errors = []
    for k in range(8):
        left, top = 200 + k * step[0], 200 + k * step[1]
        frame = ground[top : top + 300, left : left + 400].copy()
        # People cover a third of the picture and move by themselves.
        boxes = [[40.0 + 12 * k, 60.0, 120.0, 180.0], [330.0 - 12 * k, 90.0, 60.0, 200.0]]
        for x, y, w, h in np.array(boxes, int):
            frame[y : y + h, x : x + w] = rng.integers(0, 255, (h, w, 3), np.uint8)
        state, found = motion.step(state, frame, boxes)
        if k:
            assert found is not None
            middle = np.array([200.0, 150.0, 1.0])
            errors.append(found @ middle - middle[:2] + step)
    assert np.abs(errors).max() < 0.3
    if step == (0, 0):
        assert np.array_equal(errors, np.zeros((7, 2)))


def test_a_bright_person_does_not_put_out_a_faint_ground() -> None:
    ground, motion = picture() // 3, PictureMotion()
    state = motion.initial()
    for k in range(6):
        frame = ground[100:400, 100 + 6 * k : 500 + 6 * k].copy()
        frame[80:220, 150 - 9 * k : 200 - 9 * k] = 255
        # It is not detected.
        state, found = motion.step(state, frame, np.zeros((0, 4)))
        if k:
            assert found is not None
            assert np.abs(found @ [200.0, 150.0, 1.0] - [194.0, 150.0]).max() < 0.3


def test_pictures_without_texture_say_that_they_know_nothing() -> None:
    motion = PictureMotion()
    state = motion.initial()
    for _ in range(3):
        state, found = motion.step(state, np.full((120, 160, 3), 90, np.uint8), np.zeros((0, 4)))
        assert found is None
    # Another scene at once: no similarity explains it.
    state, _ = motion.step(state, picture(1)[:300, :400], np.zeros((0, 4)))
    state, found = motion.step(state, picture(2)[:300, :400], np.zeros((0, 4)))
    assert found is None


@pytest.mark.parametrize(
    "field", ["width", "corners", "weakest", "least_corners", "window", "agree", "tolerance", "quiet"]
)
def test_numbers_out_of_range_are_refused(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        PictureMotion(**{field: -1})
