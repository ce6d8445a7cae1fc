"""Every registered agent: one contract, single and batched, with rows that do not know of each other."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.protocol import Agent
from servotrack.baselines.agents.random import RandomAgent
from servotrack.baselines.agents.registry import AGENTS, LAWS, agent_card, create_agent
from servotrack.baselines.agents.servo.catalog import ESTIMATORS
from servotrack.baselines.agents.servo.catalog import LAWS as LAW_CLASSES
from servotrack.baselines.agents.servo.informed_settings import FILTERS
from servotrack.baselines.evaluation.evaluate import make_single, make_vector
from servotrack.envs.servo.levels import ServoConfig
from servotrack.estimators.jacobian import ParticleJacobian

SERVO = "UncalibServo-v0"
SERVO_AGENTS = sorted(name for name, card in AGENTS.items() if card.laws)
NOISY = {"level": 5}


def roll(agent: Any, env: Any, seeds: Any, steps: int) -> list[np.ndarray]:
    """Actions of an agent over some steps."""
    observation, _ = env.reset(seed=seeds)
    state, starts, actions = None, np.ones(len(seeds) if isinstance(seeds, list) else (), dtype=bool), []
    for _ in range(steps):
        action, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
        actions.append(action)
        observation, *_ = env.step(action)
        starts = np.zeros_like(starts)
    return actions


@pytest.mark.parametrize(
    "name", sorted(name for name, card in AGENTS.items() if "servo" in card.worlds and card.trained_in is None)
)
def test_agent_acts_within_its_space_alone_and_in_a_batch(name: str) -> None:
    card = agent_card(name)
    single = make_single(SERVO, NOISY, privileged=card.privileged)
    agent = create_agent(card, single)
    assert isinstance(agent, Agent)
    alone = roll(agent, single, 100_003, 30)
    assert all(single.action_space.contains(action) for action in alone)

    batch = make_vector(SERVO, 3, NOISY, privileged=card.privileged)
    together = roll(create_agent(card, batch), batch, [100_003, 100_004, 100_005], 30)
    assert all(batch.action_space.contains(action) for action in together)
    assert np.allclose([actions[0] for actions in together], alone, atol=1e-5), "a row depends on its neighbors"


@pytest.mark.parametrize("name", SERVO_AGENTS)
def test_episode_start_resets_its_rows_and_no_others(name: str) -> None:
    card = agent_card(name)
    env = make_vector(SERVO, 2, NOISY, privileged=card.privileged)
    agent = create_agent(card, env)
    observation, _ = env.reset(seed=[100_010, 100_011])
    state: Any = None
    for _ in range(25):
        action, state = agent.predict(observation, state=state)
        observation, *_ = env.step(action)
    kept, _ = agent.predict(observation, state=state, episode_start=np.array([False, False]))
    half, _ = agent.predict(observation, state=state, episode_start=np.array([True, False]))
    fresh, _ = agent.predict(observation)
    assert np.array_equal(half[1], kept[1])
    assert np.array_equal(half[0], fresh[0])


def test_the_tables_of_names_agree() -> None:
    assert set(SERVO_AGENTS) == set(ESTIMATORS)
    assert set(LAWS) == set(LAW_CLASSES)


@pytest.mark.parametrize("law", LAWS)
def test_every_law_follows_the_target(law: str) -> None:
    card = agent_card(f"lifted-kf+{law}")
    env = make_vector(SERVO, 4, {"level": 1}, privileged=False)
    agent = create_agent(card, env)
    observation, _ = env.reset(seed=[100_020, 100_021, 100_022, 100_023])
    state, errors = None, []
    for _ in range(150):
        action, state = agent.predict(observation, state=state)
        observation, _, _, _, info = env.step(action)
        errors.append(info["tracking_error"])
    assert np.mean(errors[80:]) < 0.02 < np.mean(errors[0])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("kff", "no agent is called 'kff'; did you mean 'kf'?"),
        ("zebra", "known are random"),
        ("kf+pid", "no control law is called 'pid'; did you mean 'pi'?"),
        ("random+pi", "has no control law"),
        ("no_such_module:Agent", "cannot be imported"),
        ("servotrack.baselines.evaluation.seeds:TEST", "must be callable"),
    ],
)
def test_a_wrong_name_gets_a_suggestion(name: str, message: str) -> None:
    with pytest.raises(ValueError) as caught:
        agent_card(name)
    assert message in str(caught.value)


def test_a_servo_agent_names_the_environment_that_it_does_not_fit() -> None:
    with pytest.raises(ValueError, match="CartPole-v1 lacks them"):
        create_agent("kf", gym.make("CartPole-v1"))


def test_a_missing_observation_is_named() -> None:
    env = make_single(SERVO, {"level": 0})
    agent = create_agent("kf", env)
    observation, _ = env.reset(seed=100_000)
    del observation["frame_time"]
    with pytest.raises(ValueError, match="frame_time missing"):
        agent.predict(observation)


def test_a_bad_measurement_is_named() -> None:
    env = make_single(SERVO, {"level": 0})
    agent = create_agent("kf", env)
    observation, _ = env.reset(seed=100_000)
    observation["joint_angles"][1] = np.nan
    with pytest.raises(ValueError, match="joint_angles"):
        agent.predict(observation)


def test_an_agent_s_old_name_leads_to_the_new_one() -> None:
    with pytest.warns(DeprecationWarning, match="'informed-bound' is now called 'informed'"):
        assert agent_card("informed-bound") == agent_card("informed")
    with pytest.warns(DeprecationWarning):
        assert agent_card("informed-bound+pi").name == "informed+pi"


@pytest.mark.parametrize("target", ServoConfig.TARGETS)
def test_the_informed_agent_has_a_filter_for_every_law_of_a_target(target: str) -> None:
    env = make_single(SERVO, {"level": 3, "target": target}, privileged=True)
    agent = create_agent("informed", env)
    assert agent.controller.estimator == FILTERS[target]  # type: ignore[attr-defined]
    observation, _ = env.reset(seed=100_000)
    action, _ = agent.predict(observation)
    assert action.shape == (2,)


def test_only_those_who_ask_see_the_truth() -> None:
    seen = {name for name, card in AGENTS.items() if card.privileged}
    oracles = {"oracle", "informed", "association-oracle", "people-oracle", "box-oracle", "bearing-oracle"}
    # The others say in their names what they are told.
    oracles |= {"ibvs", "ibvs-desired", "ibvs-mean", "pbvs", "joint-oracle"}
    assert {name for name in seen if "-told-" not in name} == oracles
    assert all(AGENTS[name].information in ("privileged", "calibrated") for name in seen)
    observation, _ = make_single(SERVO, {}).reset(seed=100_000)
    assert not any(key.startswith("true_") for key in observation)


def test_a_card_says_what_was_told_in_the_world_at_hand() -> None:
    card = AGENTS["pmb"]
    assert card.as_record("clutter", "")["information"] == "calibrated"
    assert card.as_record("people", "")["information"] == "structure"


def test_random_actions_depend_on_seed_step_and_row_alone() -> None:
    small, large = (gym.make_vec(SERVO, num_envs=n, vectorization_mode="vector_entry_point") for n in (2, 5))
    first, second = (roll(RandomAgent(env, seed=7), env, list(range(n)), 10) for env, n in ((small, 2), (large, 5)))
    assert np.array_equal(np.array(first), np.array(second)[:, :2])
    assert not np.array_equal(first[0][0], first[0][1])
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first, roll(RandomAgent(small, seed=8), small, [0, 1], 10))


def test_random_agent_covers_discrete_spaces_and_refuses_unbounded_ones() -> None:
    env = gym.make("CartPole-v1")
    agent = RandomAgent(env)
    state, taken = None, set()
    for _ in range(50):
        action, state = agent.predict(np.zeros(4), state)
        assert env.action_space.contains(action)
        taken.add(int(action))
    assert taken == {0, 1}
    env.action_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    with pytest.raises(ValueError, match="bounded Box"):
        RandomAgent(env)


def test_stable_baselines_evaluates_the_agents_unmodified() -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.evaluation import evaluate_policy

    from servotrack.baselines.training.sb3 import StableBaselinesVecEnv

    single = gym.make(SERVO, level=1)
    rewards, lengths = evaluate_policy(
        create_agent("kf", single), single, n_eval_episodes=2, return_episode_rewards=True, warn=False
    )
    assert lengths == [260, 260]
    assert all(reward > 150.0 for reward in rewards)

    mode = gym.vector.AutoresetMode.SAME_STEP
    batch = StableBaselinesVecEnv(gym.make_vec(SERVO, num_envs=3, level=1, autoreset_mode=mode))
    batch.seed(100_000)
    rewards, _ = evaluate_policy(
        create_agent("kf", single), batch, n_eval_episodes=6, return_episode_rewards=True, warn=False
    )
    # The second episode of a row is as good as its first only if the agent began anew.
    assert len(rewards) == 6
    assert all(reward > 150.0 for reward in rewards)


def test_particles_of_an_agent_are_seeded() -> None:
    assert isinstance(ESTIMATORS["pf"](), ParticleJacobian)
    env = make_single(SERVO, {"level": 1})
    assert np.array_equal(
        roll(create_agent("pf", env), env, 100_000, 20), roll(create_agent("pf", env), env, 100_000, 20)
    )


def test_images_serve_as_well_as_features() -> None:
    env = make_vector("UncalibServoPixels-v0", 2, {"level": 3}, privileged=False)
    agent = create_agent("lifted-kf", env)
    observation, _ = env.reset(seed=[100_030, 100_031])
    state, errors = None, []
    for _ in range(100):
        action, state = agent.predict(observation, state=state)
        observation, _, _, _, info = env.step(action)
        errors.append(info["tracking_error"])
    assert np.max(errors[80:]) < 0.01 < np.min(errors[0])


def test_an_image_without_the_marker_or_seen_before_is_no_new_feature() -> None:
    env = make_single("UncalibServoPixels-v0", {"level": 0})
    agent = create_agent("kf", env)
    observation, _ = env.reset(seed=100_000)
    _, first = agent.predict(observation)
    later = {**observation, "time": observation["time"] + 0.05}
    _, repeated = agent.predict(later, state=first)
    black = {**later, "image": np.zeros_like(observation["image"]), "frame_time": later["time"]}
    _, lost = agent.predict(black, state=first)
    for state in (repeated, lost):
        assert np.array_equal(state.seen.features, first.seen.features)
        assert np.array_equal(state.seen.frame_time, observation["frame_time"])
