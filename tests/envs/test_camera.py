"""The camera on the arm: the paper's formula, the analytic Jacobian against differences, gauge and inverse."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.camera import ground_point, image_jacobian, pack_camera, project_ground, project_points
from servotrack.estimators.types import Array

ROWS = 200


def random_scene(seed: int, tilt: float = 0.2, distortion: float = 0.2) -> tuple[dict[str, Array], Array, Array, Array]:
    """Camera parameters, links, joint angles and ground points near the tool."""
    rng = np.random.default_rng(seed)
    camera = {
        "focal": rng.uniform(120, 240, ROWS),
        "depth": rng.uniform(0.25, 0.6, ROWS),
        "mounting": rng.uniform(-np.pi, np.pi, ROWS),
        "center": rng.uniform(200, 280, (ROWS, 2)),
        "tilt": rng.uniform(-tilt, tilt, (ROWS, 2)),
        "aspect": rng.uniform(-0.1, 0.1, ROWS) * (tilt > 0),
        "distortion": rng.uniform(-distortion, distortion / 2, ROWS),
    }
    links = rng.uniform(0.35, 0.65, (ROWS, 2))
    joints = rng.uniform([-1.5, 0.1], [1.5, 3.0], (ROWS, 2))
    return camera, links, joints, tool_of(links, joints) + rng.uniform(-0.15, 0.15, (ROWS, 2))


def tool_of(links: Array, joints: Array) -> Array:
    theta1, phi = joints[:, 0], joints.sum(axis=1)
    return np.stack(
        [
            links[:, 0] * np.cos(theta1) + links[:, 1] * np.cos(phi),
            links[:, 0] * np.sin(theta1) + links[:, 1] * np.sin(phi),
        ],
        axis=1,
    )


def test_without_tilt_and_lens_it_is_the_papers_formula() -> None:
    camera, links, joints, points = random_scene(1, tilt=0.0, distortion=0.0)
    pixels, seen = project_points(pack_camera(**camera), links, joints, points)
    phi = joints.sum(axis=1) + camera["mounting"]
    offset = points - tool_of(links, joints)
    turned = np.stack(
        [
            np.cos(phi) * offset[:, 0] + np.sin(phi) * offset[:, 1],
            -np.sin(phi) * offset[:, 0] + np.cos(phi) * offset[:, 1],
        ],
        axis=1,
    )
    expected = camera["center"] + (camera["focal"] / camera["depth"])[:, None] * np.array([1.0, -1.0]) * turned
    assert seen.all()
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-9)


def test_the_papers_scale_is_457_pixels_per_meter() -> None:
    camera = pack_camera(160.0, 0.35)
    pixels, _ = project_points(camera, [0.5, 0.5], [0.0, np.pi / 2], [[0.5, 0.5], [0.5, 0.6]])
    np.testing.assert_allclose(pixels[0], [240.0, 240.0], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*(pixels[1] - pixels[0])), 0.1 * 160 / 0.35, rtol=1e-12)


def test_the_analytic_jacobian_is_that_of_differences() -> None:
    parameters, links, joints, points = random_scene(2)
    camera = pack_camera(**parameters)
    velocities = np.random.default_rng(3).uniform(-0.3, 0.3, (ROWS, 2))
    analytic = image_jacobian(camera, links, joints, points, velocities)
    step = 1e-6

    def pixels(joint1: float, joint2: float, time: float) -> Array:
        return project_points(camera, links, joints + np.array([joint1, joint2]), points + velocities * time)[0]

    for column, offset in enumerate(np.eye(3) * step):
        differences = (pixels(*offset) - pixels(*-offset)) / (2 * step)
        np.testing.assert_allclose(analytic[:, :, column], differences, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("level", [0, 3])
def test_the_jacobian_predicts_what_the_moving_world_shows(level: int) -> None:
    config = servo_config(level, pixel_noise=0.0, warmup=0, horizon=40)
    world = ServoWorld(config, 32)
    world.reset(range(32), range(32))
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.5, 0.5, (32, 2))
    worst = 0.0
    for _ in range(30):
        before = world.joints.copy(), world.features.copy(), world.privileged()["true_jacobian"], world.visible.copy()
        world.step(actions)
        both = (world.visible > 0) & (before[3] > 0)
        middle = 0.5 * (before[2] + world.privileged()["true_jacobian"])
        motion = np.column_stack([world.joints - before[0], np.full(32, 0.05)])
        gap = np.einsum("nij,nj->ni", middle, motion) - (world.features - before[1])
        worst = max(worst, float(np.abs(gap[both]).max()))
    # The trapezoidal rule's error over one period, against moves of up to some 40 px.
    assert worst < 0.5


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_pixels_do_not_tell_the_scale(scale: float) -> None:
    parameters, links, joints, points = random_scene(4)
    here, _ = project_points(pack_camera(**parameters), links, joints, points)
    larger = parameters | {"depth": parameters["depth"] * scale}
    there, _ = project_points(pack_camera(**larger), links * scale, joints, points * scale)
    np.testing.assert_allclose(there, here, rtol=1e-12)


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_without_tilt_a_longer_focal_length_is_a_smaller_world(scale: float) -> None:
    parameters, links, joints, points = random_scene(5, tilt=0.0)
    here, _ = project_points(pack_camera(**parameters), links, joints, points)
    shorter = parameters | {"focal": parameters["focal"] / scale}
    there, _ = project_points(pack_camera(**shorter), links * scale, joints, points * scale)
    np.testing.assert_allclose(there, here, rtol=1e-12)


def test_the_inverse_finds_the_ground_point() -> None:
    parameters, *_ = random_scene(6)
    camera = pack_camera(**parameters)
    offsets = np.random.default_rng(7).uniform(-0.2, 0.2, (ROWS, 2))
    found, seen = 0, 0
    for row in range(ROWS):
        u, v, visible = project_ground(camera[row], *offsets[row])
        if visible and 0 <= u < 480 and 0 <= v < 480:
            seen += 1
            found += np.allclose(ground_point(camera[row], u, v), offsets[row], rtol=0, atol=1e-6)
    assert seen > ROWS / 2
    assert found == seen


def test_nothing_is_seen_behind_the_camera_or_beyond_the_fold() -> None:
    tilted = pack_camera(160.0, 0.35, tilt=(0.6, 0.0))
    # Far along the direction in which the axis leans away, the ray to the ground points backward.
    assert not all(project_ground(tilted, 0.0, y)[2] for y in (-5.0, 5.0))
    barrel = pack_camera(160.0, 0.35, distortion=-0.3)
    assert project_ground(barrel, 0.1, 0.0)[2]
    assert not project_ground(barrel, 2.0, 0.0)[2]


def test_cameras_of_episodes_agree_with_their_ranges() -> None:
    config = servo_config(3)
    cameras = np.array([draw_episode(config, seed).camera for seed in range(150)])
    assert 120 <= cameras[:, 0].min() < 135 and 225 < cameras[:, 0].max() <= 240
    assert 0.25 <= cameras[:, 4].min() < 0.29 and 0.56 < cameras[:, 4].max() <= 0.60
    angles = np.arctan2(cameras[:, 6], cameras[:, 5])
    assert angles.min() < -2.5 and angles.max() > 2.5
    assert np.abs(cameras[:, 2:4] - 240).max() <= 40
    assert cameras[:, 16].min() >= -0.25 and cameras[:, 16].max() <= 0.1
