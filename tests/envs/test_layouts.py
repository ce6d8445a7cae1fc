"""Every drawn layout can be solved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW, LEAD, PERIOD, START, solvable
from servotrack.estimators.camera import project_points


@pytest.mark.parametrize("level", range(1, 7))
def test_every_layout_can_be_solved(level: int) -> None:
    config = servo_config(level)
    for seed in range(40):
        episode = draw_episode(config, seed)
        path = episode.path[LEAD + config.warmup :, :2]
        reach = np.hypot(*path.T)
        l1, l2 = episode.links
        assert abs(l1 - l2) < reach.min() and reach.max() < l1 + l2
        # The elbow-up inverse kinematics, from the law of cosines at base and elbow.
        theta2 = np.pi - np.arccos((l1**2 + l2**2 - reach**2) / (2 * l1 * l2))
        theta1 = np.arctan2(path[:, 1], path[:, 0]) - np.arccos((l1**2 + reach**2 - l2**2) / (2 * l1 * reach))
        joints = np.stack([theta1, theta2], axis=1)
        assert (joints > JOINT_LOW + 0.049).all() and (joints < JOINT_HIGH - 0.049).all()
        assert np.abs(np.diff(joints, axis=0)).max() <= 0.8 * 2.0 * PERIOD + 1e-9
        from_link_1 = np.arctan2(path[:, 1], path[:, 0]) - theta1
        assert np.abs(np.sin(from_link_1)).min() >= 0.1 - 1e-9
        pixel, seen = project_points(episode.camera, episode.links, START, path[0])
        assert seen and (pixel >= 0).all() and (pixel < 480).all()
        assert (episode.goal >= 0).all() and (episode.goal < 480).all()


def test_the_goal_is_in_the_image_or_the_draw_is_rejected() -> None:
    config = servo_config(1, focal=600.0, tilt=0.6, horizon=20)
    goals = np.array([draw_episode(config, seed).goal for seed in range(30)])
    assert (goals >= 0).all() and (goals < 480).all()


@pytest.mark.parametrize("axes", [{"max_joint_rate": 0.1}, {"focal": 2000.0, "depth": 0.05}])
def test_ranges_that_contradict_each_other_are_named(axes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"no solvable layout among 2000 draws: .*max_joint_rate=.*focal=.*depth="):
        draw_episode(servo_config(1, **axes), 0)


def path_of(*joints: tuple[float, float]) -> np.ndarray:
    """Positions of the tool of an arm with links of 0.5 m at given joint angles."""
    theta1, theta2 = np.array(joints).T
    return 0.5 * np.stack([np.cos(theta1) + np.cos(theta1 + theta2), np.sin(theta1) + np.sin(theta1 + theta2)], axis=1)


@pytest.mark.parametrize(
    ("joints", "expected"),
    [
        ([(0.0, 1.5)], True),
        ([(1.5, 1.5)], True),
        ([(1.54, 1.5)], False),
        ([(-1.54, 1.5)], False),
        ([(0.0, 0.25)], True),
        ([(0.0, 0.15)], False),
        ([(0.0, 3.0)], True),
        ([(0.0, 3.12)], False),
        ([(0.0, 1.5), (0.079, 1.5), (0.0, 1.5)], True),
        ([(0.0, 1.5), (0.081, 1.5)], False),
        ([(0.0, 1.5), (0.0, 1.581)], False),
    ],
)
def test_solvable_keeps_its_margins(joints: list[tuple[float, float]], expected: bool) -> None:
    """0.05 rad from the stops, a sine of 0.1 off the singularity, 0.8 of 2 rad/s in a period of 50 ms."""
    assert solvable(path_of(*joints), 0.5, 0.5, 2.0) == expected


def test_points_out_of_reach_are_not_solvable() -> None:
    assert not solvable(np.array([[1.01, 0.0]]), 0.5, 0.5, 2.0)
    assert not solvable(np.array([[0.05, 0.0]]), 0.6, 0.5, 2.0)
