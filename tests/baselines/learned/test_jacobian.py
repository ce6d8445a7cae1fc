"""A Jacobian estimator that learned: its coordinates, that it stands in for the oracle, and that it is trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.learned.card import load_card
from servotrack.baselines.agents.learned.jacobian import (
    ENTRIES,
    JACOBIAN_SCALE,
    LearnedJacobian,
    create_learned_servo,
    image_rotation,
    jacobian_encoding,
)
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.agents.servo.jacobian_servo import servo_measurement
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.estimators.jacobian import Excitation, ServoController
from servotrack.estimators.types import FloatArray

SHORT: dict[str, Any] = {"level": 3, "horizon": 80}


def environment(count: int) -> Any:
    return gym.make_vec("UncalibServo-v0", num_envs=count, vectorization_mode="vector_entry_point", **SHORT)


def silent(rows: FloatArray, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.zeros((len(rows), ENTRIES), np.float32), memory


def test_coordinates_are_those_of_the_encoding() -> None:
    env = environment(4)
    observation, _ = env.reset(seed=[100_000 + i for i in range(4)])
    estimator = LearnedJacobian(silent, 0, ServoEncoding())
    state = estimator.initial(servo_measurement(observation))
    rng = np.random.default_rng(0)
    for _ in range(12):
        state, _ = estimator.step(state, servo_measurement(observation))
        observation, *_ = env.step(rng.uniform(-0.3, 0.3, (4, 2)).astype(np.float32))
    state, _ = estimator.step(state, servo_measurement(observation))
    # At level 3 a frame is of the present, so that the row's error is turned by the same angle.
    assert np.array_equal(observation["frame_time"], observation["time"])
    error = np.asarray(observation["features"]) - observation["goal"]
    turned = image_rotation(state.encoding, np.asarray(observation["joint_angles"], np.float64)) @ error[..., None]
    assert np.allclose(turned[..., 0], state.rows[:, :2], atol=1e-5)


def test_a_network_that_knows_the_jacobian_servos_as_the_oracle_does() -> None:
    env = environment(5)
    world = env.unwrapped.world

    def knowing(rows: FloatArray, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
        # The estimator turns with the memory that it has just made; its row tells by how much.
        matrix = image_rotation(asked[0].encoding, world.joint_angles) @ world.privileged()["true_jacobian"]
        return (matrix / JACOBIAN_SCALE).reshape(-1, ENTRIES).astype(np.float32), memory

    class Spy(ServoEncoding):
        def step(self, memory: Any, observation: Any, action: Any) -> Any:
            after, rows = super().step(memory, observation, action)
            asked[0] = asked[0]._replace(encoding=after)
            return after, rows

    estimator = LearnedJacobian(knowing, 0, Spy())
    observation, _ = env.reset(seed=[100_000 + i for i in range(5)])
    asked = [estimator.initial(servo_measurement(observation))]
    law = create_agent("oracle+pi", env).controller.law  # type: ignore[attr-defined]
    learned = ServoController(estimator, law=law, excitation=Excitation(steps=0), max_joint_rate=2.0)
    state = learned.initial(servo_measurement(observation))
    for _ in range(60):
        measurement = servo_measurement(observation)
        truth = world.privileged()["true_jacobian"]
        state, rate = learned.step(state, measurement)
        _, estimate = estimator.step(state.estimator, measurement)
        assert np.allclose(estimate.jacobian, truth, rtol=1e-4, atol=1e-2)
        observation, *_ = env.step(np.clip(rate / 2.0, -1.0, 1.0).astype(np.float32))
    assert np.median(world.tracking_error) < 0.02


def test_one_arm_or_many() -> None:
    env = environment(3)
    rng = np.random.default_rng(1)

    def wild(rows: FloatArray, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.tanh(rows[:, :ENTRIES] + memory[:, :1]), 0.5 * memory + rows[:, :2].mean(axis=1, keepdims=True)

    servo = create_learned_servo(LearnedJacobian(wild, 1, ServoEncoding()), env, "pi")
    observation, _ = env.reset(seed=[100_000, 100_001, 100_002])
    together, alone = None, [None] * 3
    for _ in range(15):
        action, together = servo.predict(observation, together)
        for i in range(3):
            single = {key: value[i] for key, value in observation.items()}
            one, alone[i] = servo.predict(single, alone[i])
            assert one.shape == (2,) and np.allclose(one, action[i], atol=1e-6)
        observation, *_ = env.step(action + rng.normal(0.0, 0.1, action.shape).astype(np.float32))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "jacobian", "law": "bang-bang"}, "law must be one of"),
        ({"kind": "jacobian", "frames": 3}, "encoding.frames is not a known field"),
        ({"kind": "jacobian", "lags": [0]}, r"encoding.lags\[0\] must be a whole number in 1 to"),
    ],
)
def test_encodings_that_nobody_can_use_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        jacobian_encoding(settings)


def test_an_estimator_is_taught_and_goes_on_after_a_kill(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.training.dispatch import train
    from servotrack.baselines.training.progress import PeriodicEvaluation
    from servotrack.baselines.training.run import TrainingTask
    from servotrack.baselines.training.settings import TrainingSettings

    class Killed(BaseException):
        pass

    def kill(entry: Mapping[str, Any]) -> None:
        if len(entries) == 2:
            raise Killed
        entries.append(dict(entry))

    settings = TrainingSettings(
        "jacobian", "jacobian", n_envs=32, n_timesteps=20_000, encoding={"kind": "jacobian", "lags": [1]},
        measurements=4, hyper_parameters={"hidden": 32, "batch_size": 8, "n_epochs": 4, "learning_rate": 3e-3},
    )  # fmt: skip
    task = TrainingTask("UncalibServo-v0", SHORT, settings, 0, tmp_path / "run", tensorboard=False)
    yard = PeriodicEvaluation("UncalibServo-v0", SHORT, ResultsFolder(tmp_path / "classical"), episodes=10)
    entries: list[dict[str, Any]] = []
    with pytest.raises(Killed):
        train(task, yard, on_entry=kill)
    curve = train(task, yard)
    assert curve.entries[:2] == entries and curve.steps >= 20_000 and curve.interruptions == 1
    # Four iterations are enough to servo; whoever knows no Jacobian does not move at all.
    assert curve.entries[-1]["score"] > 0.7
    path = tmp_path / "run" / "agent.json"
    assert load_card(path).memory == 32
    assert len(run_episodes("UncalibServo-v0", agent_card(str(path)), [100_000], SHORT)[0]) == 1
    with pytest.raises(ValueError, match="jacobian supports only servo"):
        other = TrainingTask("PedestrianServo-v0", {"observation": "identity"}, settings, 0, tmp_path / "other")
        train(other, yard)
