"""Following one of many: where a moving camera puts points at rest, who is who, and people seen from above."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.camera import image_jacobian, pack_camera, project_ground, project_points
from servotrack.estimators.follow import (
    CameraMotion,
    JacobianMotion,
    LiftedMotion,
    PeopleFromAbove,
    PersonFollower,
    StillCamera,
    patch_color,
)

LINKS = np.array([[2.0, 1.7]])
BEFORE, AFTER = np.array([[0.1, 1.4]]), np.array([[0.18, 1.33]])
FRESH, PERIOD = np.ones(1, np.bool_), np.full(1, 0.05)
RED, BLUE, GRAY = np.array([180.0, 40.0, 40.0]), np.array([40.0, 60.0, 170.0]), np.array([110.0, 110.0, 110.0])


def seen(camera: np.ndarray, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
    shape = len(points)
    return project_points(
        np.broadcast_to(camera, (shape, camera.shape[-1])),
        np.broadcast_to(LINKS, (shape, 2)),
        np.broadcast_to(joints, (shape, 2)),
        points,
    )[0][None]


POINTS = np.array([[1.2, 1.9], [0.5, 1.0], [2.5, 2.2]])


def test_a_camera_that_is_known_says_where_points_at_rest_go():
    camera = pack_camera([320.0], [4.0], [0.7], [[250.0, 230.0]], [[0.1, -0.15]], [0.05], [-0.1])
    moved = CameraMotion(camera, LINKS)(seen(camera, BEFORE, POINTS), BEFORE, AFTER)
    np.testing.assert_allclose(moved, seen(camera, AFTER, POINTS), atol=1e-6)


def test_the_lifted_arm_says_the_same_without_knowing_the_camera():
    camera = pack_camera([320.0], [4.0], [0.7])
    goal = np.array([project_ground(camera[0], 0.0, 0.0)[:2]])
    # B and D of the lifted filter: links as the camera sees them at joints of zero, u + iv, v downward.
    scale = 320.0 / 4.0 * np.exp(0.7j)
    moved = LiftedMotion(scale * LINKS[:, 0], scale * LINKS[:, 1], goal)(seen(camera, BEFORE, POINTS), BEFORE, AFTER)
    np.testing.assert_allclose(moved, seen(camera, AFTER, POINTS), atol=1e-9)


def test_a_jacobian_alone_is_exact_to_first_order_at_its_point():
    camera = pack_camera([320.0], [4.0], [0.7], tilt=[[0.1, 0.0]])
    jacobian = image_jacobian(camera, LINKS, BEFORE, POINTS[:1], np.zeros((1, 2)))
    errors = []
    for share in (1.0, 0.5):
        after = BEFORE + share * (AFTER - BEFORE)
        moved = JacobianMotion(jacobian)(seen(camera, BEFORE, POINTS[:1]), BEFORE, after)
        errors.append(np.abs(moved - seen(camera, after, POINTS[:1])).max())
    assert errors[1] < 0.3 * errors[0]
    np.testing.assert_array_equal(StillCamera()(moved, BEFORE, AFTER), moved)


def table(*people: tuple[float, float, np.ndarray], rows: int = 8) -> np.ndarray:
    out = np.zeros((1, rows, 8))
    for row, (u, v, color) in enumerate(people):
        out[0, row] = [1.0, u, v, 40.0, 40.0, *color]
    return out


def follow(follower: PersonFollower, frames: list[np.ndarray], color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the person is believed to be in every frame, and whether detected; the first row of the first frame."""
    state = follower.initial(frames[0], frames[0][:, 0, 1:3], color[None])
    places, visible = [], []
    for frame in frames:
        state, sighting = follower.step(state, frame, FRESH, PERIOD, StillCamera(), BEFORE, BEFORE)
        places.append(sighting.features[0])
        visible.append(sighting.visible[0])
    return np.array(places), np.array(visible)


def crossing(noise: np.random.Generator, merged: bool) -> tuple[list[np.ndarray], np.ndarray]:
    """Two who walk through each other at 80 px/s; while they are close they are one detection of mixed color."""
    frames, truth = [], []
    for k in range(80):
        a, b = np.array([140.0 + 4.0 * k, 240.0]), np.array([460.0 - 4.0 * k, 246.0])
        truth.append(a)
        if merged and abs(a[0] - b[0]) < 32.0:
            middle = 0.5 * (a + b) + noise.normal(0.0, 2.0, 2)
            frames.append(table((*middle, 0.5 * (RED + BLUE))))
            continue
        a, b = a + noise.normal(0.0, 2.0, 2), b + noise.normal(0.0, 2.0, 2)
        people = [(*a, RED + noise.normal(0.0, 8.0, 3)), (*b, BLUE + noise.normal(0.0, 8.0, 3))]
        frames.append(table(*(people if k == 0 or noise.random() < 0.5 else people[::-1])))
    return frames, np.array(truth)


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_identity_is_kept_through_a_crossing(seed, merged):
    frames, truth = crossing(np.random.default_rng(seed), merged)
    places, visible = follow(PersonFollower(), frames, RED + 10.0)
    assert np.abs(places - truth)[-20:].max() < 12.0
    assert visible.mean() > 0.75


@pytest.mark.parametrize("gone", [6, 20, 30])
def test_a_person_is_found_again_after_being_hidden(gone):
    noise = np.random.default_rng(gone)
    frames, truth = [], []
    for k in range(90):
        a = np.array([100.0 + 2.0 * k, 240.0])
        people = [(*(a + noise.normal(0.0, 2.0, 2)), RED), (300.0, 100.0 + 2.0 * k, GRAY)]
        frames.append(table(*(people[1:] if 40 <= k < 40 + gone else people)))
        truth.append(a)
    places, visible = follow(PersonFollower(), frames, RED)
    assert not visible[40 : 40 + gone].any()
    assert visible[-10:].all()
    assert np.abs(places - np.array(truth))[-10:].max() < 12.0


def test_somebody_who_was_there_before_is_not_taken_for_the_person():
    frames = [table((200.0, 240.0, RED), (260.0, 240.0, RED + 8.0)) for _ in range(20)]
    frames += [table((260.0, 240.0, RED + 8.0)) for _ in range(60)]
    places, visible = follow(PersonFollower(), frames, RED)
    assert visible[:20].all()
    assert not visible[25:].any()
    assert np.abs(places[-1] - [200.0, 240.0]).max() < 30.0


def test_the_motion_of_the_camera_is_no_motion_of_people():
    camera = pack_camera([320.0], [4.0], [0.7])
    follower = PersonFollower()
    joints = [np.array([[0.1 + 0.01 * k, 1.4 - 0.008 * k]]) for k in range(40)]
    at = [seen(camera, j, POINTS)[0] for j in joints]
    frames = [table(*((*p, c) for p, c in zip(points, (RED, BLUE, GRAY), strict=True))) for points in at]
    state = follower.initial(frames[0], frames[0][:, 0, 1:3], RED[None])
    for k in range(1, 40):
        state, sighting = follower.step(
            state, frames[k], FRESH, PERIOD, CameraMotion(camera, LINKS), joints[k - 1], joints[k]
        )
        assert sighting.visible[0]
    assert np.hypot(*(at[-1][0] - at[0][0])) > 30.0
    assert np.hypot(*state.motion[0]) < 3.0


def test_runs_do_not_touch_each_other_and_old_frames_change_nothing():
    frames, _ = crossing(np.random.default_rng(1), True)
    follower = PersonFollower()
    alone = follow(follower, frames, RED)[0]
    other = np.roll(frames, 5, axis=0)
    both = [np.concatenate([a, b]) for a, b in zip(frames, other, strict=True)]
    place = both[0][:, 0, 1:3]
    state = follower.initial(both[0], place, np.stack([RED, BLUE]))
    joints = np.repeat(BEFORE, 2, axis=0)
    for k, frame in enumerate(both):
        fresh = np.array([True, k % 2 == 0])
        new, sighting = follower.step(state, frame, fresh, np.full(2, 0.05), StillCamera(), joints, joints)
        np.testing.assert_array_equal(sighting.features[0], alone[k])
        if k % 2:
            np.testing.assert_array_equal(new.place[1], state.place[1])
            assert not sighting.visible[1]
        state = new


def test_bad_detections_are_refused():
    follower = PersonFollower()
    frame = table((200.0, 240.0, RED))
    state = follower.initial(frame, frame[:, 0, 1:3], RED[None])
    frame[0, 0, 2] = np.nan
    with pytest.raises(ValueError, match="detections must be finite"):
        follower.step(state, frame, FRESH, PERIOD, StillCamera(), BEFORE, BEFORE)


@pytest.mark.parametrize("bad", [np.zeros((1, 4, 5)), np.zeros((4, 8))])
def test_detections_of_another_shape_are_refused(bad):
    follower = PersonFollower()
    frame = table((200.0, 240.0, RED))
    state = follower.initial(frame, frame[:, 0, 1:3], RED[None])
    with pytest.raises(ValueError, match=r"detections must have shape \(runs, rows, 8\)"):
        follower.step(state, bad, FRESH, PERIOD, StillCamera(), BEFORE, BEFORE)


def floor(side: int = 128) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.clip(rng.normal(120.0, 9.0, (side, side, 1)) + rng.normal(0.0, 3.0, (side, side, 3)), 0, 255)


def with_people(image: np.ndarray, *people: tuple[float, float, np.ndarray], radius: float = 5.3) -> np.ndarray:
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    for u, v, color in people:
        image[np.hypot(columns - u, rows - v) < radius] = color
    return image.astype(np.uint8)


def test_people_are_found_on_a_floor():
    people = [(30.0, 40.0, RED), (90.0, 30.0, BLUE), (60.0, 100.0, np.array([20.0, 20.0, 24.0]))]
    found = PeopleFromAbove().detect(with_people(floor(), *people), 40.0)
    rows = found[found[:, 0] > 0]
    assert len(rows) == 3
    for u, v, color in people:
        nearest = rows[np.hypot(*(rows[:, 1:3] - 3.75 * np.array([u, v])).T).argmin()]
        np.testing.assert_allclose(nearest[1:3], 3.75 * np.array([u, v]), atol=4.0)
        np.testing.assert_allclose(nearest[5:], color, atol=25.0)
        np.testing.assert_allclose(nearest[3:5], 40.0, atol=12.0)


def test_two_who_touch_are_told_apart():
    found = PeopleFromAbove().detect(with_people(floor(), (60.0, 60.0, RED), (69.0, 60.0, BLUE)), 40.0)
    rows = found[found[:, 0] > 0]
    assert len(rows) == 2
    np.testing.assert_allclose(sorted(rows[:, 1]), [3.75 * 60.0, 3.75 * 69.0], atol=8.0)


def test_a_person_in_white_with_dark_hair_is_one_person_of_both_colors():
    image = with_people(floor(), (60.0, 50.0, 1.5 * floor()[0, 0]))
    image = with_people(image, (60.0, 50.0, np.array([30.0, 26.0, 24.0])), radius=2.2)
    found = PeopleFromAbove().detect(image, 40.0)
    rows = found[found[:, 0] > 0]
    assert len(rows) == 1
    np.testing.assert_allclose(rows[0, 1:3], [3.75 * 60.0, 3.75 * 50.0], atol=4.0)
    shade = image[45:56, 55:66][np.hypot(*(np.mgrid[:11, :11] - 4.5)) < 4.8].mean(axis=0)
    np.testing.assert_allclose(rows[0, 5:], shade, atol=12.0)


def test_pieces_nearer_than_two_bodies_are_one_person():
    image = with_people(floor(), (56.0, 50.0, RED), (64.0, 50.0, RED), radius=2.5)
    assert PeopleFromAbove(gap=0.01, smallest=0.1).detect(image, 40.0)[:, 0].sum() == 1
    assert PeopleFromAbove(gap=0.01, apart=0.5, smallest=0.1).detect(image, 40.0)[:, 0].sum() == 2


@pytest.mark.parametrize("image", [floor().astype(np.uint8), np.zeros((64, 64, 3), np.uint8)])
def test_nobody_is_found_where_nobody_is(image):
    assert PeopleFromAbove().detect(image, 40.0)[:, 0].sum() == 0


@pytest.mark.parametrize(
    ("images", "widths", "message"),
    [
        (np.zeros((64, 64)), 40.0, "images must be uint8 of shape"),
        (np.zeros((64, 64, 3)), 40.0, "images must be uint8 of shape .* got float64"),
        (np.zeros((64, 60, 3), np.uint8), 40.0, "images must be uint8 of shape"),
        (np.zeros((2, 64, 64, 3), np.uint8), 40.0, "widths must be finite and > 0 px, one for each image"),
        (np.zeros((64, 64, 3), np.uint8), np.nan, "widths must be finite"),
    ],
)
def test_bad_images_are_refused(images, widths, message):
    with pytest.raises(ValueError, match=message):
        PeopleFromAbove().detect(images, widths)


@pytest.mark.parametrize("keywords", [{"dark": 1.5}, {"chroma": 0.0}, {"bright": 0.9}, {"capacity": 0}, {"rounds": 0}])
def test_bad_parameters_are_refused(keywords):
    (name,) = keywords
    with pytest.raises(ValueError, match=name):
        PeopleFromAbove(**keywords)


def test_the_color_of_a_picture_is_that_of_its_middle():
    patch = with_people(floor(32), (16.0, 16.0, RED), radius=10.0)
    np.testing.assert_allclose(patch_color(patch), RED, atol=1.0)
    assert patch_color(np.stack([patch, patch])).shape == (2, 3)
