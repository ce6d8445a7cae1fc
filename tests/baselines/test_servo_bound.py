"""The bound of the servo's steady error: no agent without the truth passes it, and a clairvoyant one reaches it."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.evaluation.bench import default_agents
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.evaluation.statistics import paired_difference
from servotrack.baselines.leaderboard.servo_bound import (
    episode_bounds,
    has_bound,
    joints_above,
    reach_bounds,
    steady_bounds,
)
from servotrack.baselines.leaderboard.servo_targets import turn_chances, waypoint_knowledge
from servotrack.baselines.worlds import WORLDS
from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.levels import LEVEL_NAMES, reach_config, servo_config
from servotrack.envs.servo.targets import PERIOD

SERVO, REACH = "UncalibServo-v0", "UncalibServoReach-v0"
LEVELS = range(len(LEVEL_NAMES))
STRONG = ("lifted-kf-swinging", "latency-bank-lifted-kf", "latency-bank-agile-kf", "ppo", "hybrid", "informed")
TUNE = take("tune", 20, 90_000)


def bounds(env_id: str, kwargs: dict[str, Any], seeds: list[int]) -> Any:
    found = (episode_bounds if env_id == SERVO else reach_bounds)(kwargs, seeds)
    assert found is not None
    return np.array(found)


def assert_not_passed(env_id: str, level: int, agents: list[str], seeds: list[int]) -> None:
    least = bounds(env_id, {"level": level}, seeds)
    for agent in agents:
        trained_in = AGENTS[agent].trained_in
        if trained_in is not None and f"{env_id},level={level}" not in trained_in:
            continue
        cell = evaluate(env_id, agent, seeds, {"level": level}, timing=False)
        errors = np.array([row["steady"] for row in cell.select(seeds)])
        assert paired_difference(errors, least).high > 0.0, (agent, errors.mean(), least.mean())


@pytest.mark.parametrize("level", LEVELS)
def test_no_strong_agent_passes_the_bound(level: int) -> None:
    assert_not_passed(SERVO, level, [name for name in STRONG if "servo" in AGENTS[name].worlds], list(TUNE))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [SERVO, REACH])
@pytest.mark.parametrize("level", LEVELS)
def test_no_agent_passes_the_bound(env_id: str, level: int) -> None:
    agents = [name for name in default_agents(env_id) if not AGENTS[name].privileged or name == "informed"]
    assert_not_passed(env_id, level, agents, list(take("test", 1000)))


def clairvoyant_errors(seeds: list[int], **axes: Any) -> Any:
    """Steady errors of a controller that knows joints, path and motors, and only lacks the noise of its next period."""
    env = gym.make_vec(SERVO, num_envs=len(seeds), level=0, warmup=0, **axes)
    env.reset(seed=seeds)
    world = env.unwrapped.world  # type: ignore[attr-defined]
    substep, errors = PERIOD / world.config.substeps, []
    goals = joints_above(world.paths, world.links)
    for step in range(world.config.horizon):
        ahead = goals[:, step + 1 + 6] - world.joints - substep * world._samples["rates"]
        env.step(np.clip(ahead / (PERIOD - substep) / world.config.max_joint_rate, -1, 1).astype(np.float32))
        errors.append(world.tracking_error.copy())
    return np.array(errors)[61:].mean(axis=0)


def test_a_clairvoyant_controller_reaches_the_bound_of_noisy_motors() -> None:
    seeds = list(range(100_000, 100_064))
    noisy = {"actuation_noise": (0.04, 0.04)}
    errors, least = clairvoyant_errors(seeds, **noisy), steady_bounds(servo_config(0, warmup=0, **noisy), seeds)
    assert errors.mean() == pytest.approx(least.mean(), rel=0.01)


def test_without_noise_nothing_is_left_and_a_clairvoyant_controller_shows_it() -> None:
    assert steady_bounds(servo_config(0), [100_000]).max() < 1e-12
    assert clairvoyant_errors([100_000]).max() < 1e-5


def test_a_resting_target_is_known_as_a_mean_of_its_frames() -> None:
    # 457 px per meter, half a pixel of noise, and a frame at every step since the warm-up began.
    deviation = 0.5 / (160.0 / 0.35)
    frames = np.arange(8.0 + 61.0, 8.0 + 101.0)
    expected = deviation * math.sqrt(math.pi / 2) * np.mean(1.0 / np.sqrt(frames))
    least = steady_bounds(reach_config(1), [100_000])
    assert least[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ({"pixel_noise": 1.0}, {"pixel_noise": 2.0}),
        ({"latency": (1, 1)}, {"latency": (2, 2)}),
        ({"dropout": 0.0}, {"dropout": 0.5}),
        ({"outlier_rate": 0.0}, {"outlier_rate": 0.3}),
        ({"actuation_noise": (0.03, 0.03)}, {"actuation_noise": (0.05, 0.05)}),
        ({"encoder_noise": (0.0, 0.0)}, {"encoder_noise": (0.003, 0.003)}),
    ],
)
@pytest.mark.parametrize("level", [5, 6])
def test_the_bound_grows_with_what_is_unknown(level: int, low: dict[str, Any], high: dict[str, Any]) -> None:
    seeds = list(range(100_000, 100_008))
    axes = {"stamped": True} if level == 6 else {}
    less, more = (steady_bounds(servo_config(level, **axes, **change), seeds) for change in (low, high))
    assert more.mean() > less.mean()


def test_episodes_do_not_depend_on_those_beside_them() -> None:
    config = servo_config(6)
    together = steady_bounds(config, [100_000, 100_001, 100_002])
    alone = [steady_bounds(config, [seed])[0] for seed in (100_000, 100_001, 100_002)]
    np.testing.assert_allclose(together, alone, rtol=1e-10)


def test_turns_are_as_frequent_as_their_chances_say() -> None:
    config = servo_config(6, latency=(1, 1), stamped=True)
    episodes = [draw_episode(config, seed) for seed in range(300)]
    paths, links = (np.stack([getattr(episode, name) for episode in episodes]) for name in ("path", "links"))
    age = np.full(len(paths), 2 * PERIOD)
    knowledge = waypoint_knowledge(paths, links, age, np.zeros(len(paths)))
    chance = turn_chances(config, paths, links, knowledge)[:, 6:-2]
    turned = knowledge.turned[:, 6:-1] | knowledge.turned[:, 7:]
    for low, high, tolerance in ((0.0, 0.03, 0.002), (0.03, 0.1, 0.01), (0.1, 0.9, 0.05)):
        chosen = (chance >= low) & (chance < high)
        assert turned[chosen].mean() == pytest.approx(chance[chosen].mean(), abs=tolerance)


def test_worlds_without_a_bound_say_why() -> None:
    for axes in ({"noise_kind": "uniform"}, {"horizon": 60}, {"max_motor_torque": 5.0}):
        config = servo_config(1, **axes)  # type: ignore[arg-type]
        assert not has_bound(config)
        assert episode_bounds({"level": 1, **axes}, [100_000]) is None
        with pytest.raises(ValueError, match="the bound needs"):
            steady_bounds(config, [100_000])


def test_the_bound_is_that_of_the_servo_s_record() -> None:
    world = WORLDS["servo"]
    for env_id in (SERVO, REACH):
        bound = world.bound_of(env_id)
        assert bound is not None and bound.column == world.headline.column == "steady"
    assert world.bound_of("UncalibServoPixels-v0") is None
