"""Export of models that other libraries trained: the file acts as the model does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines import create_agent
from servotrack.baselines.agents.learned.card import load_card
from servotrack.envs import FlatSets, GoalObservation

torch = pytest.importorskip("torch")
sb3 = pytest.importorskip("stable_baselines3")

from servotrack.baselines.training.export_command import ExportRequest, export_model  # noqa: E402

Wrap = Callable[[Any], Any]
FLATTEN = gym.wrappers.FlattenObservation
SERVO = {"level": 3, "horizon": 30}


def plain(env: Any) -> Any:
    return env


def request(env_id: str, kwargs: dict[str, Any], model: str, folder: Path, **changes: Any) -> ExportRequest:
    fields: dict[str, Any] = {
        "algorithm": None, "wrappers": (), "normalization": None, "name": "mine", "summary": "", "steps": None,
        "information": "prior", "output": folder, "tolerance": 1e-5, "trust": True, **changes,
    }  # fmt: skip
    return ExportRequest(env_id, kwargs, model, **fields)


def trained(algorithm: str, policy: str, env: Any, path: Path, **arguments: Any) -> Any:
    """Make a model whose actions are neither tiny nor saturated everywhere."""
    torch.manual_seed(0)
    library = pytest.importorskip("sb3_contrib") if algorithm in ("TQC", "RecurrentPPO") else sb3
    model = getattr(library, algorithm)(policy, env, device="cpu", seed=1, **arguments)
    with torch.no_grad():
        for name, weight in model.policy.named_parameters():
            if name.endswith("action_net.weight"):
                weight.mul_(50.0)
    model.save(path)
    return model


CASES: dict[str, tuple[str, str, str, dict[str, Any], Wrap, tuple[str, ...]]] = {
    "raw dictionary": ("PPO", "MultiInputPolicy", "UncalibServo-v0", SERVO, plain, ()),
    "scaled dictionary": ("SAC", "MultiInputPolicy", "UncalibServo-v0", SERVO, FlatSets, ("FlatSets",)),
    "scaled vector": (
        "TD3", "MlpPolicy", "UncalibServoReach-v0", SERVO, lambda env: FLATTEN(FlatSets(env)),
        ("FlatSets", "FlattenObservation"),
    ),
    "raw vector": ("A2C", "MlpPolicy", "UncalibServo-v0", SERVO, FLATTEN, ("FlattenObservation",)),
    "quantiles": ("TQC", "MultiInputPolicy", "UncalibServo3D-v0", {"horizon": 10}, FlatSets, ("FlatSets",)),
    "recurrent": ("RecurrentPPO", "MultiInputLstmPolicy", "UncalibServo-v0", SERVO, FlatSets, ("FlatSets",)),
    "goals": ("SAC", "MultiInputPolicy", "UncalibServoReach-v0", SERVO, GoalObservation, ("GoalObservation",)),
    "small image": ("PPO", "MultiInputPolicy", "PedestrianServo-v0", {"horizon": 5}, FlatSets, ("FlatSets",)),
    "image": ("PPO", "MultiInputPolicy", "UncalibServoPixels-v0", {"horizon": 5}, plain, ()),
    "sets": ("PPO", "MlpPolicy", "ClutterTracking-v0", {"horizon": 5}, FlatSets, ("FlatSets",)),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_models_of_stable_baselines_act_as_before(case: str, tmp_path: Path) -> None:
    algorithm, policy, env_id, kwargs, wrap, wrappers = CASES[case]
    env = wrap(gym.make(env_id, **kwargs))
    model = trained(algorithm, policy, env, tmp_path / "model.zip")
    name = "recurrent_ppo" if algorithm == "RecurrentPPO" else algorithm.lower()
    zip_file = str(tmp_path / "model.zip")
    path, difference = export_model(request(env_id, kwargs, zip_file, tmp_path, algorithm=name, wrappers=wrappers))
    assert difference <= 1e-5
    # Once more without the exporter's own comparison: two environments, one per agent, stay together.
    own = gym.make(env_id, **kwargs)
    agent, state, carried, start = create_agent(str(path), own), None, None, True
    observation, seen = own.reset(seed=3)[0], env.reset(seed=3)[0]
    moved = 0.0
    for _ in range(5):
        action, carried = model.predict(seen, state=carried, episode_start=np.array([start]), deterministic=True)
        exported, state = agent.predict(observation, state)
        observation, *_, own_info = own.step(exported)
        seen, *_, info = env.step(action)
        start, moved = False, max(moved, float(np.ptp(exported)))
    assert moved > 1e-3
    scores = [own_info[key] - info[key] for key in ("tracking_error", "ospa") if key in info]
    assert scores and np.allclose(scores, 0.0, atol=1e-3)


def test_statistics_of_vec_normalize_are_included(tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    env = VecNormalize(DummyVecEnv([lambda: gym.make("UncalibServo-v0", **SERVO)]))
    torch.manual_seed(0)
    model = sb3.PPO("MultiInputPolicy", env, n_steps=64, batch_size=32, n_epochs=1, device="cpu").learn(128)
    model.save(tmp_path / "model.zip")
    env.save(tmp_path / "scale.pkl")
    asked = request("UncalibServo-v0", SERVO, str(tmp_path / "model.zip"), tmp_path, algorithm="ppo")
    normalized = {**vars(asked), "normalization": tmp_path / "scale.pkl", "name": "scaled"}
    path, difference = export_model(ExportRequest(**normalized))
    assert difference <= 1e-5 and load_card(path).steps == 128
    single = gym.make("UncalibServo-v0", **SERVO)
    observation, _ = single.reset(seed=1)
    scaled, plain = (create_agent(str(file), single).predict(observation)[0] for file in (path, export_model(asked)[0]))
    expected, _ = model.predict(env.normalize_obs(observation), deterministic=True)
    np.testing.assert_allclose(scaled, expected, atol=1e-5)
    assert np.abs(scaled - plain).max() > 1e-3


def _linears(names: list[str], sizes: list[int]) -> dict[str, Any]:
    torch.manual_seed(2)
    state = {}
    for name, before, after in zip(names, sizes[:-1], sizes[1:], strict=True):
        state[f"{name}.weight"], state[f"{name}.bias"] = 0.3 * torch.randn(after, before), 0.1 * torch.randn(after)
    return state


@pytest.mark.parametrize("script", ["ppo", "ddpg"])
def test_actors_of_cleanrl_act_as_before(script: str, tmp_path: Path) -> None:
    env = FLATTEN(gym.make("UncalibServo-v0", **SERVO))
    size = env.observation_space.shape[0]
    if script == "ppo":
        state = _linears(["actor_mean.0", "actor_mean.2", "actor_mean.4"], [size, 64, 64, 2])
        state |= {"actor_logstd": torch.zeros(1, 2), "critic.0.weight": torch.zeros(64, size)}
    else:
        state = _linears(["fc1", "fc2", "fc_mu"], [size, 64, 64, 2])
        state |= {"action_scale": torch.ones(1, 2), "action_bias": torch.zeros(1, 2)}
    torch.save(state if script == "ppo" else (state, {}), tmp_path / "actor.cleanrl_model")
    mean, var = 0.5 * (env.observation_space.low + env.observation_space.high), env.observation_space.high**2 + 1.0
    np.savez(tmp_path / "scale.npz", mean=mean, var=var)
    path, difference = export_model(
        request(
            "UncalibServo-v0",
            SERVO,
            str(tmp_path / "actor.cleanrl_model"),
            tmp_path,
            wrappers=("FlattenObservation",),
            normalization=tmp_path / "scale.npz",
            trust=False,
        )
    )
    assert difference <= 1e-5
    raw, _ = env.reset(seed=1)
    hidden = np.clip((raw - mean) / np.sqrt(var + 1e-8), -10, 10)
    for name in ("actor_mean.0", "actor_mean.2") if script == "ppo" else ("fc1", "fc2"):
        hidden = state[f"{name}.weight"].numpy() @ hidden + state[f"{name}.bias"].numpy()
        hidden = np.tanh(hidden) if script == "ppo" else np.maximum(hidden, 0.0)
    last = "actor_mean.4" if script == "ppo" else "fc_mu"
    expected = state[f"{last}.weight"].numpy() @ hidden + state[f"{last}.bias"].numpy()
    expected = np.clip(expected if script == "ppo" else np.tanh(expected), -1.0, 1.0)
    action, _ = create_agent(str(path), env.unwrapped).predict(env.unwrapped.reset(seed=1)[0])
    np.testing.assert_allclose(action, expected, atol=1e-5)


MINE = """
import torch
def make():
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(SIZE, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2))
"""


@pytest.mark.parametrize("form", ["callable", "script", "program"])
def test_plain_torch_models_act_as_before(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = FLATTEN(gym.make("UncalibServo-v0")).observation_space.shape[0]
    (tmp_path / f"mine_{form}.py").write_text(MINE.replace("SIZE", str(size)))
    monkeypatch.syspath_prepend(tmp_path)
    module: Any = __import__(f"mine_{form}").make().eval()
    model = f"mine_{form}:make"
    if form == "script":
        model = str(tmp_path / "mine.pt")
        torch.jit.save(torch.jit.script(module), model)
    elif form == "program":
        model = str(tmp_path / "mine.pt2")
        dimension = {0: torch.export.Dim("n")}
        torch.export.save(torch.export.export(module, (torch.zeros(2, size),), dynamic_shapes=(dimension,)), model)
    wrappers = ("FlatSets", "FlattenObservation")
    path, difference = export_model(request("UncalibServo-v0", SERVO, model, tmp_path, wrappers=wrappers))
    env = FLATTEN(FlatSets(gym.make("UncalibServo-v0", **SERVO)))
    seen, _ = env.reset(seed=4)
    with torch.no_grad():
        expected = module(torch.as_tensor(seen)[None])[0].numpy()
    action, _ = create_agent(str(path), env.unwrapped).predict(env.unwrapped.reset(seed=4)[0])
    np.testing.assert_allclose(action, np.clip(expected, -1.0, 1.0), atol=1e-5)
    assert difference <= 1e-5 and np.abs(action).max() > 1e-3


@pytest.mark.parametrize("name", ["model.zip", "model.pt", "model.pt2"])
def test_files_that_can_run_code_are_loaded_on_request_only(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"nothing is read from it")
    algorithm = "ppo" if name.endswith("zip") else None
    with pytest.raises(ValueError, match=r"can run code when it is loaded .* --trust"):
        export_model(
            request("UncalibServo-v0", SERVO, str(tmp_path / name), tmp_path, algorithm=algorithm, trust=False)
        )


def test_a_cleanrl_file_with_code_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "touched",))

    torch.save({"actor_mean.0.weight": Evil()}, tmp_path / "evil.cleanrl_model")
    with pytest.raises(ValueError, match="holds more than tensors"):
        export_model(request("UncalibServo-v0", SERVO, str(tmp_path / "evil.cleanrl_model"), tmp_path))
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "none.zip", "algorithm": "ppo"}, "MODEL must be a file or module:callable"),
        ({"algorithm": None}, "--algo must be given with a .zip"),
        ({"algorithm": "dqn"}, "--algo must be one of ppo, a2c"),
        ({"wrappers": ("FrameStack",)}, "--wrapper must be one of FlatSets"),
        ({"wrappers": ("FlattenObservation", "FlatSets")}, "--wrapper takes FlatSets or GoalObservation, then"),
        ({"wrappers": ("FlatSets",)}, "give the wrappers of its training by --wrapper"),
    ],
)
def test_wrong_arguments_are_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    trained("PPO", "MultiInputPolicy", gym.make("UncalibServo-v0", **SERVO), tmp_path / "model.zip")
    fields = {"algorithm": "ppo", **changes}
    model = fields.pop("model", str(tmp_path / "model.zip"))
    with pytest.raises(ValueError, match=message):
        export_model(request("UncalibServo-v0", SERVO, model, tmp_path, **fields))
    assert not list(tmp_path.glob("*.onnx"))


def test_an_export_that_fails_leaves_the_earlier_one(tmp_path: Path) -> None:
    trained("PPO", "MultiInputPolicy", gym.make("UncalibServo-v0", **SERVO), tmp_path / "model.zip")
    asked = request("UncalibServo-v0", SERVO, str(tmp_path / "model.zip"), tmp_path / "out", algorithm="ppo")
    export_model(asked)
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    with pytest.raises(ValueError, match="--tolerance is"):
        export_model(dataclasses.replace(asked, tolerance=-1.0))
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_the_command_exports_a_file_that_evaluate_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from servotrack.__main__ import app

    monkeypatch.chdir(tmp_path)
    kwargs = {"level": 0, "horizon": 70}
    trained("PPO", "MultiInputPolicy", FlatSets(gym.make("UncalibServo-v0", **kwargs)), tmp_path / "model.zip")
    place = ["UncalibServo-v0", "--level", "0", "--set", "horizon=70"]
    options = ["--algo", "ppo", "--wrapper", "FlatSets", "--name", "mine", "--trust", "--output", "out"]
    assert app(["export", place[0], "model.zip", *place[1:], *options], standalone_mode=False) in (None, 0)
    card = load_card(Path("out/UncalibServo-v0-level0-mine.json"))
    assert card.encoding == {"kind": "flat"} and card.training["compared"]["largest_difference"] <= 1e-5
    file = "out/UncalibServo-v0-level0-mine.onnx"
    assert app(["evaluate", place[0], file, *place[1:], "--episodes", "2"], standalone_mode=False) in (None, 0)
    assert "mine.onnx" in capsys.readouterr().out
