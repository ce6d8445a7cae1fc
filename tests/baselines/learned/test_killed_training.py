"""A training that is killed, however often and wherever, ends with the network of one that is not."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import torch

from servotrack.baselines.agents.learned.card import digest
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.training.checkpoint import CHECKPOINT, load_checkpoint, write_checkpoint
from servotrack.baselines.training.dispatch import train
from servotrack.baselines.training.progress import PeriodicEvaluation
from servotrack.baselines.training.run import TrainingTask
from servotrack.baselines.training.settings import TrainingSettings

SERVO = ("UncalibServo-v0", {"level": 2, "horizon": 80})
PPO = TrainingSettings(
    "ppo", "ppo", n_envs=4, n_timesteps=960, measurements=6, encoding={"kind": "servo"},
    hyper_parameters={"n_steps": 16, "batch_size": 32, "n_epochs": 2, "learning_rate": "lin_1e-3"},
)  # fmt: skip
OFF_POLICY = {"learning_starts": 64, "buffer_size": 400, "train_freq": 8, "batch_size": 32}
STUDENT = TrainingSettings(
    "student", "student", n_envs=4, n_timesteps=1600, measurements=4, encoding={"kind": "servo", "lags": [1]},
    hyper_parameters={"hidden": 8, "batch_size": 2},
)  # fmt: skip
SERVO_RUNS = {
    "ppo": PPO,
    "ppo normalized": replace(PPO, normalize=True),
    "ppo with gSDE": replace(PPO, hyper_parameters={**PPO.hyper_parameters, "use_sde": True}),
    "curriculum": replace(PPO, curriculum=((0,), (1, 2))),
    "recurrent_ppo": replace(PPO, algorithm="recurrent_ppo", policy="MlpLstmPolicy", n_timesteps=512),
    "a2c": replace(PPO, algorithm="a2c", hyper_parameters={"n_steps": 8}),
    "sac": replace(PPO, algorithm="sac", n_timesteps=640, hyper_parameters=OFF_POLICY),
    "td3": replace(PPO, algorithm="td3", n_timesteps=640, hyper_parameters=OFF_POLICY, normalize=True),
    "tqc": replace(PPO, algorithm="tqc", n_timesteps=512, hyper_parameters=OFF_POLICY),
    "student": STUDENT,
    "hybrid": replace(STUDENT, encoding={**STUDENT.encoding, "residual": "kf"}),
    "jacobian": replace(STUDENT, algorithm="jacobian", encoding={"kind": "jacobian", "law": "pi", "lags": [1]}),
}
RUNS: dict[str, tuple[str, dict[str, Any], TrainingSettings]] = {
    **{name: (*SERVO, settings) for name, settings in SERVO_RUNS.items()},
    "set": (
        "ClutterTracking-v0",
        {"level": 0, "horizon": 12},
        TrainingSettings(
            "set", "set", n_envs=2, n_timesteps=192, measurements=4, encoding={"kind": "set"},
            hyper_parameters={"hidden": 8},
        ),
    ),
    "eyes": (
        "UncalibServoPixels-v0",
        {"level": 2, "horizon": 80, "image_size": 48},
        TrainingSettings(
            "eyes", "eyes", n_envs=4, n_timesteps=120, measurements=4,
            encoding={"kind": "marker", "image_size": 48, "servo": "kf"},
            hyper_parameters={"channels": 4, "batch_size": 8},
        ),
    ),
}  # fmt: skip
QUICK = ("ppo normalized", "student")
QUICK_KILLS, KILLS = 3, 20


class Killed(BaseException):
    """Stands for a signal: nothing that runs after it may change the files."""


def digest_after(name: str, folder: Path, kills: int) -> tuple[str, int]:
    """Train, killed up to `kills` times between two steps or after an evaluation.

    Returns:
        Digest of the ONNX file, and the kills that hit the run before its end.
    """
    chance = random.Random(kills)
    env_id, env_kwargs, settings = RUNS[name]
    task = TrainingTask(env_id, env_kwargs, settings, 3, folder / "run", tensorboard=False)
    evaluation = PeriodicEvaluation(env_id, env_kwargs, ResultsFolder(folder.parent / f"classical {name}"), episodes=2)

    def kill_after(moments: int) -> None:
        left = [moments]

        def moment(_: Any) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise Killed

        train(task, evaluation, on_steps=moment, on_entry=moment)

    done = 0
    for _ in range(kills):
        # A new process would begin with other states than the killed one left behind.
        np.random.seed(chance.randrange(2**31))  # noqa: NPY002
        random.seed(chance.random())
        torch.manual_seed(chance.randrange(2**31))
        try:
            kill_after(chance.randrange(1, 10))
        except Killed:
            done += 1
    train(task, evaluation)
    return digest((folder / "run" / "agent.onnx").read_bytes()), done


def check(name: str, kills: int, tmp_path: Path) -> None:
    whole, _ = digest_after(name, tmp_path / "whole", 0)
    killed, done = digest_after(name, tmp_path / "killed", kills)
    assert killed == whole
    assert done >= min(kills - 1, 3), "the run was over before the kills"


@pytest.mark.parametrize("name", QUICK)
def test_killed_and_resumed_training_gives_the_same_network(name: str, tmp_path: Path) -> None:
    check(name, QUICK_KILLS, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_twenty_kills_change_no_network(name: str, tmp_path: Path) -> None:
    check(name, KILLS, tmp_path)


def test_segments_end_where_episodes_do(tmp_path: Path) -> None:
    # Episodes of 80 steps: after 136 steps an evaluation is due, but the next rollout that begins one is after 160.
    settings = replace(
        PPO, n_timesteps=4 * 400, measurements=3, hyper_parameters={**PPO.hyper_parameters, "n_steps": 8}
    )
    task = TrainingTask(*SERVO, settings, 0, tmp_path / "run", tensorboard=False)
    curve = train(task, PeriodicEvaluation(*SERVO, ResultsFolder(tmp_path / "classical"), episodes=2))
    assert [entry["steps"] // 4 for entry in curve.entries] == [160, 320, 400]


def test_checkpoint_returns_what_was_saved(tmp_path: Path) -> None:
    network = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(network.parameters())
    network(torch.randn(5, 3)).sum().backward()
    optimizer.step()
    saved: Mapping[str, Any] = {
        "parameters": {"network": network.state_dict(), "optimizer": optimizer.state_dict()},
        "steps": 7,
        "curve": "{}",
        "random": {"pair": (1, 2.5), "large": 2**100, "none": None},
        "array": np.arange(4, dtype=np.uint32),
    }
    write_checkpoint(tmp_path, saved)
    found = load_checkpoint(tmp_path)
    assert found is not None and found["random"] == saved["random"]
    assert found["array"].dtype == np.uint32 and found["array"].tolist() == [0, 1, 2, 3]
    assert torch.equal(found["parameters"]["network"]["weight"], network.weight)
    other = torch.optim.Adam(torch.nn.Linear(3, 2).parameters())
    other.load_state_dict(found["parameters"]["optimizer"])
    assert torch.equal(other.state_dict()["state"][0]["exp_avg"], optimizer.state_dict()["state"][0]["exp_avg"])
    with pytest.raises(TypeError, match="a checkpoint holds tensors, arrays, numbers and text, got set"):
        write_checkpoint(tmp_path, {"odd": {1}})
    assert load_checkpoint(tmp_path) is not None and [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]


def test_checkpoint_of_an_earlier_version_is_named(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    with pytest.raises(ResultsError, match=r"checkpoint.pt is of an earlier version; move its folder away"):
        load_checkpoint(tmp_path)
