"""The MuJoCo example: its camera is what the estimators assume, and they follow the target on it."""

from __future__ import annotations

import importlib.util
import sys
from contextlib import closing
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from servotrack.estimators.jacobian import KalmanJacobian, LiftedKalman, ServoController

# Not importorskip: the example has to be the first to import MuJoCo, so that it can choose how to render.
pytestmark = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="needs the extra mujoco")

EXAMPLE = Path(__file__).parents[2] / "examples" / "mujoco_arm.py"
SETTLED = slice(60, None)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mujoco_arm", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = sys.modules["mujoco_arm"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_two_link_camera_is_the_planar_one(example: ModuleType) -> None:
    arm = example.PlanarArm(2, rendered=False)
    arm.move(np.array([0.7, -0.4]))
    measurement = arm.measure()
    first, both = measurement.joint_angles[0], measurement.joint_angles.sum()
    tool = 0.5 * np.array([np.cos(first) + np.cos(both), np.sin(first) + np.sin(both)])
    turn = np.array([[np.cos(both), np.sin(both)], [-np.sin(both), np.cos(both)]])
    offset = turn @ (example.paper_target(float(measurement.time)) - tool)
    expected = 240.0 + example.FOCAL / example.HEIGHT * np.array([offset[0], -offset[1]])
    np.testing.assert_allclose(measurement.features, expected, atol=1e-6)


@pytest.mark.parametrize("joints", [2, 3])
def test_rendered_features_agree_with_projected_ones(example: ModuleType, joints: int) -> None:
    if not example.can_render():
        pytest.skip("no OpenGL here: install libegl1 or libosmesa6")
    projected = example.PlanarArm(joints, rendered=False)
    with closing(example.PlanarArm(joints)) as seen:
        for _ in range(5):
            np.testing.assert_allclose(seen.measure().features, projected.measure().features, atol=0.1)
            for arm in (seen, projected):
                arm.move(np.full(joints, 0.3))


@pytest.mark.parametrize(("joints", "estimator"), [(2, KalmanJacobian), (3, KalmanJacobian), (2, LiftedKalman)])
def test_estimators_follow_the_target_unchanged(example: ModuleType, joints: int, estimator: type) -> None:
    arm = example.PlanarArm(joints, rendered=False, pixel_noise=0.5)
    errors = example.tracking_errors(arm, ServoController(estimator()))
    assert errors[SETTLED].mean() < 0.010


def test_every_estimator_of_the_example_takes_its_measurements(example: ModuleType) -> None:
    for name, estimator in example.ESTIMATORS.items():
        for joints in (2,) if name in example.TWO_LINKS_ONLY else (2, 3):
            arm = example.PlanarArm(joints, rendered=False)
            errors = example.tracking_errors(arm, ServoController(estimator()), steps=20)
            assert np.isfinite(errors).all()


def test_a_target_out_of_view_is_not_visible(example: ModuleType) -> None:
    arm = example.PlanarArm(2, rendered=False)
    before = arm.measure()
    arm.data.qpos[0] = np.pi
    after = arm.measure()
    assert before.visible and not after.visible
    np.testing.assert_array_equal(after.features, before.features)


@pytest.mark.parametrize("arguments", [{"joints": 4}, {"pixel_noise": -1.0}, {"pixel_noise": np.nan}])
def test_bad_arguments_are_named(example: ModuleType, arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(arguments))):
        example.PlanarArm(**{"rendered": False, **arguments})
