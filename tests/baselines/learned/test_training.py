"""Real training with Stable-Baselines3: what is exported is the policy, and a killed run goes on."""

from __future__ import annotations

import json
import pickle
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from rich.console import Console

import servotrack

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import torch

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, digest, load_card
from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.baselines.agents.learned.jacobian import jacobian_encoding
from servotrack.baselines.agents.learned.marker_network import open_marker_network
from servotrack.baselines.agents.learned.network import OnnxNetwork
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.learned.set_prediction import SetWindow
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.training.checkpoint import CHECKPOINT, load_checkpoint
from servotrack.baselines.training.command import TrainingRequest, run_training
from servotrack.baselines.training.comparison import compare
from servotrack.baselines.training.dispatch import train
from servotrack.baselines.training.encoded_env import EncodedVecEnv
from servotrack.baselines.training.export import export, exportable_policy
from servotrack.baselines.training.progress import PeriodicEvaluation
from servotrack.baselines.training.reinforcement import create_model, policy_mode, restore
from servotrack.baselines.training.run import TASK, TrainingTask
from servotrack.baselines.training.sb3 import StableBaselinesVecEnv
from servotrack.baselines.training.settings import TrainingSettings, load_settings, schedule
from servotrack.baselines.training.student import StudentNetwork

ENV_ID = "UncalibServo-v0"
SHORT: dict[str, Any] = {"level": 2, "horizon": 80}
PPO = TrainingSettings(
    "ppo",
    "ppo",
    n_envs=8,
    n_timesteps=2048,
    encoding={"kind": "servo"},
    hyper_parameters={"n_steps": 16, "batch_size": 64},
)
RECURRENT = replace(PPO, algorithm="recurrent_ppo", policy="MlpLstmPolicy", encoding={"kind": "flat"})
OFF_POLICY = {"learning_starts": 64, "buffer_size": 1000, "train_freq": 8, "batch_size": 32}


def periodic_evaluation(folder: Path) -> PeriodicEvaluation:
    return PeriodicEvaluation(ENV_ID, SHORT, ResultsFolder(folder / "classical"), episodes=4)


@pytest.mark.parametrize(
    "settings",
    [
        PPO,
        replace(PPO, normalize=True),
        RECURRENT,
        replace(PPO, algorithm="sac", hyper_parameters=OFF_POLICY),
        replace(PPO, algorithm="td3", hyper_parameters=OFF_POLICY, normalize=True),
        replace(PPO, algorithm="tqc", hyper_parameters=OFF_POLICY),
        replace(PPO, algorithm="a2c", hyper_parameters={"policy_kwargs": {"activation_fn": "nn.SiLU"}}),
    ],
    ids=lambda s: s.algorithm + "-normalized" * s.normalize,
)
def test_what_is_exported_acts_as_the_policy_does(
    settings: TrainingSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    task = TrainingTask(ENV_ID, SHORT, settings, 0, tmp_path, tensorboard=False)
    model: Any = create_model(task)
    model.learn(256)
    assert not list(tmp_path.glob("SB3-*")), "a folder that nobody asked for"
    policy = policy_mode(model)
    size = model.observation_space.shape[0]
    card_fields = {
        "name": "x",
        "summary": "",
        "env_id": ENV_ID,
        "env_kwargs": SHORT,
        "encoding": {},
        "network": "x.onnx",
    }
    content = export(exportable_policy(policy, size, policy.memory), tmp_path / "x.onnx")
    network = OnnxNetwork(tmp_path / "x.onnx", LearnedCard(**card_fields, sha256=digest(content), memory=policy.memory))
    rows = np.random.default_rng(0).normal(size=(5, size)).astype(np.float32)
    memory, state = np.zeros((5, policy.memory), np.float32), None
    normalizer = model.get_vec_normalize_env()
    starts = np.ones(5, bool)
    for _ in range(3):
        action, memory = network(rows, memory)
        seen = rows if normalizer is None else normalizer.normalize_obs(rows)
        expected, state = model.predict(seen, state, starts, deterministic=True)
        starts = np.zeros(5, bool)
        assert np.abs(np.clip(action, -1.0, 1.0) - expected).max() < 1e-5
        rows = rows[::-1].copy()


def test_a_killed_training_goes_on_where_it_was_saved(tmp_path: Path) -> None:
    class Killed(BaseException):
        pass

    task = TrainingTask(ENV_ID, SHORT, replace(PPO, normalize=True), 0, tmp_path / "run", tensorboard=False)
    seen: list[int] = []

    def kill(entry: Mapping[str, Any]) -> None:
        seen.append(int(entry["steps"]))
        if len(seen) == 5:
            raise Killed

    with pytest.raises(Killed):
        train(task, periodic_evaluation(tmp_path), on_entry=kill)
    saved = load_checkpoint(tmp_path / "run")
    assert saved is not None and saved["steps"] == seen[-1] < PPO.n_timesteps
    resumed: list[int] = []
    curve = train(task, periodic_evaluation(tmp_path), on_entry=lambda entry: resumed.append(int(entry["steps"])))
    assert resumed[:5] == seen and resumed[-1] >= PPO.n_timesteps and sorted(set(resumed)) == resumed
    assert curve.interruptions == 1
    # Nothing is left to do.
    assert train(task, periodic_evaluation(tmp_path)).entries == curve.entries


def test_a_resumed_model_is_the_one_that_was_saved(tmp_path: Path) -> None:
    task = TrainingTask(ENV_ID, SHORT, replace(PPO, normalize=True, n_timesteps=512), 0, tmp_path, tensorboard=False)
    train(task, periodic_evaluation(tmp_path))
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None
    models: list[Any] = [create_model(task), create_model(task)]
    for model in models:
        restore(model, checkpoint, tmp_path)
    for name, value in checkpoint["parameters"]["policy"].items():
        assert torch.equal(models[0].policy.state_dict()[name], value)
    rms = models[0].get_vec_normalize_env().obs_rms
    assert np.array_equal(rms.mean, checkpoint["observations"][0]) and rms.count > 512
    optimizers = [model.policy.optimizer.state_dict()["state"] for model in models]
    assert optimizers[0].keys() == optimizers[1].keys() and len(optimizers[0]) > 0


def test_same_seed_same_training(tmp_path: Path) -> None:
    curves = []
    for name in ("one", "two"):
        task = TrainingTask(ENV_ID, SHORT, replace(PPO, n_timesteps=512), 3, tmp_path / name, tensorboard=False)
        curves.append([{**entry, "seconds": 0} for entry in train(task, periodic_evaluation(tmp_path)).entries])
    assert curves[0] == curves[1]


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return (print, ("run",))

    task = TrainingTask(ENV_ID, SHORT, PPO, 0, tmp_path, tensorboard=False)
    (tmp_path / CHECKPOINT).write_bytes(pickle.dumps({"parameters": Evil(), "curve": ""}))
    with pytest.raises(ResultsError, match="not a checkpoint"):
        train(task, periodic_evaluation(tmp_path))
    (tmp_path / CHECKPOINT).write_bytes(b"PK\x03\x04 truncated")
    with pytest.raises(ResultsError, match="not a checkpoint"):
        train(task, periodic_evaluation(tmp_path))


@pytest.mark.parametrize("content", ['{"a": 1, "a": 2}', "[" * 10_000, "NaN", ""])
def test_a_damaged_task_file_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / TASK).write_text(content)
    with pytest.raises(ResultsError, match=rf"{TASK} is corrupt"):
        train(TrainingTask(ENV_ID, SHORT, PPO, 0, tmp_path, tensorboard=False), periodic_evaluation(tmp_path))


def test_a_folder_of_another_training_is_refused(tmp_path: Path) -> None:
    train(
        TrainingTask(ENV_ID, SHORT, replace(PPO, n_timesteps=128), 0, tmp_path, tensorboard=False),
        periodic_evaluation(tmp_path),
    )
    with pytest.raises(ResultsError, match="other settings"):
        train(TrainingTask(ENV_ID, SHORT, PPO, 0, tmp_path, tensorboard=False), periodic_evaluation(tmp_path))


def test_the_best_of_several_runs_gets_a_card_that_tells_of_all(tmp_path: Path) -> None:
    settings = replace(PPO, n_timesteps=256)
    request = TrainingRequest(ENV_ID, SHORT, settings, (0, 1), tmp_path / "runs", name="mine", ship=tmp_path / "ship")
    path = run_training(request, Console(quiet=True))
    card = load_card(path)
    assert (card.name, card.steps, len(card.training["runs"])) == ("mine", 512, 2)
    scores = [run["score"] for run in card.training["runs"]]
    assert card.training["curve"][-1]["score"] == max(scores)
    rows, _ = run_episodes(ENV_ID, agent_card(str(path)), [100_000, 100_001], SHORT)
    assert len(rows) == 2

    (found,) = compare(request.environment, "ppo", "kf", ResultsFolder(tmp_path / "compare"), 3, "tune")
    assert (found.runs, found.episodes, found.against) == (2, 3, "kf")
    # Nobody learns to servo in 256 steps.
    assert found.difference.low > 0.0 and found.score is not None and found.score.high < 0.0
    assert min(found.of_runs) > found.of_other and "no claim about training" in found.markdown()
    with pytest.raises(ValueError, match="at least two runs of 'sac'"):
        compare(request.environment, "sac", "kf", ResultsFolder(tmp_path / "compare"), 3, "tune")


def test_what_an_episode_ended_with_is_encoded_too() -> None:
    venv = gym.make_vec(ENV_ID, num_envs=3, level=2, horizon=5, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    encoding = create_encoding({"kind": "servo"}, venv)
    env = EncodedVecEnv(StableBaselinesVecEnv(venv), encoding)
    env.seed(100)
    first = env.reset()
    for _ in range(5):
        rows, _, done, infos = env.step(np.full((3, 2), 0.3, np.float32))
    assert done.all()
    for row, info in zip(rows, infos, strict=True):
        assert info["terminal_observation"].shape == (encoding.size,)
        assert not np.array_equal(row, info["terminal_observation"])
    # A new episode remembers nothing: all frames are the first, so differences between them are zero.
    assert (rows[:, 10:16] == 0.0).all() and (first[:, 10:16] == 0.0).all()


def test_the_shipped_hyper_parameters_can_be_read() -> None:
    folder = Path(servotrack.baselines.__file__).parent / "training" / "hyper_parameters"  # type: ignore[attr-defined]
    files = sorted(folder.glob("*.yml"))
    assert files
    for file in files:
        for name in yaml.safe_load(file.read_text()):
            recipe, _, level = name.partition(" level=")
            settings = load_settings(file.stem, recipe, int(level) if level else None)
            assert settings.n_timesteps > 0 and json.dumps(settings.as_record())
            kind = settings.encoding["kind"]
            if kind in ("jacobian", "set"):
                {"jacobian": jacobian_encoding, "set": SetWindow.of}[kind](settings.encoding)
            elif not {"marker", "eyes"} & {*settings.encoding, kind}:
                create_encoding(settings.encoding, gym.make(file.stem))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ppo: {n_envs: 0}", "n_envs"),
        ("ppo: {n_timesteps: many}", "n_timesteps"),
        ("ppo: {frame_stack: 4}", "frame_stack"),
        ("ppo: {policy_kwargs: \"dict(a=__import__('os').system('true'))\"}", "literals"),
        ("sac: {}", "only for sac"),
        ("[]", "must map"),
        ("ppo: [", "not valid YAML"),
        ("ppo: !!python/object/apply:os.system ['true']", "not valid YAML"),
    ],
)
def test_bad_hyper_parameters_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yml").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_settings(ENV_ID, "ppo", path=tmp_path / "mine.yml")


def test_hyper_parameters_that_the_algorithm_does_not_take_are_named(tmp_path: Path) -> None:
    settings = replace(PPO, hyper_parameters={"n_step": 16})
    with pytest.raises(ValueError, match="n_step"):
        create_model(TrainingTask(ENV_ID, SHORT, settings, 0, tmp_path, tensorboard=False))
    with pytest.raises(ValueError, match="algorithm must be one of"):
        replace(PPO, algorithm="reinforce")


def test_schedules_of_rl_zoo_are_read() -> None:
    falling = schedule("lin_0.001")
    assert falling(1.0) == 0.001 and falling(0.25) == 0.00025 and schedule(0.5) == 0.5
    for bad in ("lin_fast", "cos_0.1", "lin_-1"):
        with pytest.raises(ValueError, match="lin_NUMBER"):
            schedule(bad)


@pytest.mark.parametrize("residual", [False, True])
def test_a_student_learns_and_goes_on_after_a_kill(residual: bool, tmp_path: Path) -> None:
    class Killed(BaseException):
        pass

    def kill(entry: Mapping[str, Any]) -> None:
        if len(entries) == 2:
            raise Killed
        entries.append(dict(entry))

    encoding = {"kind": "servo", "lags": [1], **({"residual": "kf"} if residual else {})}
    settings = TrainingSettings(
        "student", "student", n_envs=16, n_timesteps=8000, encoding=encoding, measurements=6,
        hyper_parameters={"hidden": 16, "batch_size": 8},
    )  # fmt: skip
    task = TrainingTask(ENV_ID, SHORT, settings, 0, tmp_path / "run")
    entries: list[dict[str, Any]] = []
    with pytest.raises(Killed):
        train(task, periodic_evaluation(tmp_path), on_entry=kill)
    curve = train(task, periodic_evaluation(tmp_path))
    assert curve.entries[:2] == entries and curve.steps >= 8000 and curve.interruptions == 1
    card = load_card(tmp_path / "run" / "agent.json")
    assert card.memory == 16
    rows, _ = run_episodes(ENV_ID, agent_card(str(tmp_path / "run" / "agent.json")), [100_000], SHORT)
    if residual:
        # Even little training leaves a servo that works: it begins as the classical one.
        classical, _ = run_episodes(ENV_ID, agent_card("kf"), [100_000], SHORT)
        assert rows[0]["steady"] < 3.0 * classical[0]["steady"]


def test_a_student_acts_step_by_step_as_in_a_whole_sequence() -> None:
    network = StudentNetwork(12, 8, residual=True)
    rows = torch.randn(3, 5, 12)
    whole, _ = network.actions(rows)
    memory = torch.zeros(3, 8)
    for k in range(5):
        correction, memory = network(rows[:, k], memory)
        assert torch.allclose(correction + rows[:, k, -2:], whole[:, k], atol=1e-6)


def test_a_student_is_refused_where_no_teacher_is(tmp_path: Path) -> None:
    settings = TrainingSettings("student", "student", n_envs=2, n_timesteps=10, encoding={"kind": "servo"})
    evaluation = periodic_evaluation(tmp_path)
    with pytest.raises(ValueError, match="student supports only servo"):
        train(
            TrainingTask("PedestrianServo-v0", {"observation": "identity"}, settings, 0, tmp_path / "run"), evaluation
        )


def test_eyes_learn_and_see_what_they_have_learned(tmp_path: Path) -> None:
    settings = TrainingSettings(
        "eyes", "eyes", n_envs=32, n_timesteps=9_600, measurements=1,
        encoding={"kind": "marker", "image_size": 48, "servo": "kf"}, hyper_parameters={"channels": 12},
    )  # fmt: skip
    world: dict[str, Any] = {"level": 2, "horizon": 80, "image_size": 48}
    task = TrainingTask("UncalibServoPixels-v0", world, settings, 0, tmp_path / "eyes")
    evaluation = PeriodicEvaluation("UncalibServoPixels-v0", world, ResultsFolder(tmp_path / "classical"), episodes=2)
    curve = train(task, evaluation)
    path = tmp_path / "eyes" / "agent.json"
    eyes = open_marker_network(path.stem, path.parent)
    env = gym.make_vec("UncalibServoPixels-v0", num_envs=16, pixel_noise=0.0, **world)
    observation, _ = env.reset(seed=list(range(100_000, 100_016)))
    place, seen = eyes.detect(observation["image"])
    truth = env.unwrapped.world.features / 10.0  # type: ignore[attr-defined]
    middle = np.median(np.hypot(*(24.0 - truth).T))
    assert seen.mean() > 0.8 and np.median(np.hypot(*(place - truth).T)) < 0.25 * middle
    # Behind the eyes: a classical servo, or a policy that reads their features.
    assert len(run_episodes("UncalibServoPixels-v0", agent_card(str(path)), [100_000], world)[0]) == 1
    through = create_encoding({"kind": "servo", "eyes": path.stem}, env, path.parent)
    memory = through.initial(observation)
    memory, rows = through.step(memory, observation, np.zeros((16, 2), np.float32))
    plain = ServoEncoding()
    features = {
        **observation,
        "features": 10.0 * place,
        "goal": 10.0 * observation["goal"],
        "visible": seen[:, None] * 1.0,
    }
    _, expected = plain.step(plain.initial(features), features, np.zeros((16, 2), np.float32))
    assert np.allclose(rows[seen], expected[seen], atol=1e-5)
    assert curve.steps >= 9_600
    with pytest.raises(ValueError, match="images must be uint8"):
        eyes.detect(np.zeros((96, 96, 3), np.uint8))
    with pytest.raises(AgentFileError, match="detects markers in images"):
        create_agent(agent_card(str(path)), gym.make("UncalibServo-v0"))
    with pytest.raises(ValueError, match="eyes needs"):
        create_encoding({"kind": "servo", "eyes": path.stem}, gym.make("UncalibServo-v0"))


def test_runs_and_their_continuations_take_other_episodes_of_the_train_range() -> None:
    taken: list[int] = []
    for seed, steps in ((0, 0), (1, 0), (0, 1024)):
        model: Any = create_model(TrainingTask(ENV_ID, SHORT, PPO, seed, Path(), tensorboard=False), steps)
        first = model.get_env().unwrapped._seeds
        assert all(number in seeds.TRAIN for number in first)
        taken += first
    assert len(set(taken)) == len(taken) == 3 * PPO.n_envs
