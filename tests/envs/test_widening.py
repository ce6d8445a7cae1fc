"""Ranges beyond those of a level."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from servotrack.envs.follow.config import follow_config
from servotrack.envs.servo.levels import reach_config, servo_config
from servotrack.envs.servo.widening import widened_axes


def test_ranges_grow_by_a_quarter_at_both_ends() -> None:
    axes = widened_axes(servo_config(6))
    assert axes["links"] == pytest.approx((0.275, 0.725))
    assert axes["tilt"] == pytest.approx(1.25 * servo_config(6).tilt)
    assert axes["latency"] == (0, 3)
    assert axes["dropout"] == pytest.approx(0.125)
    # The mounting already covers all angles, an encoder cannot have less than no noise, constants stay constant.
    assert "mounting" not in axes
    assert axes["encoder_noise"][0] == 0.0
    assert "latency" not in widened_axes(servo_config(5))
    assert "max_joint_rate" not in axes


def test_a_level_without_random_quantities_stays() -> None:
    assert widened_axes(servo_config(0)) == {}


@pytest.mark.parametrize("config", [servo_config(6), reach_config(3), follow_config(6)])
def test_no_widening_changes_nothing(config) -> None:  # type: ignore[no-untyped-def]
    assert widened_axes(config, 0.0) == {}


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_outside_its_range_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match="share must lie in"):
        widened_axes(servo_config(3), share)


@pytest.mark.parametrize(
    ("env_id", "config"),
    [
        ("UncalibServo-v0", servo_config(6)),
        ("UncalibServoReach-v0", reach_config(3)),
        ("PedestrianServo-v0", follow_config(4)),
    ],
)
def test_wider_worlds_have_solvable_episodes(env_id: str, config) -> None:  # type: ignore[no-untyped-def]
    env = gym.make_vec(env_id, num_envs=20, vectorization_mode="vector_entry_point", **widened_axes(config))
    try:
        observation, _ = env.reset(seed=list(range(20)))
        assert np.isfinite(observation["joint_angles"]).all()
    finally:
        env.close()
