"""Models that other libraries trained, read from their files: Stable-Baselines3, CleanRL, torch."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from servotrack.baselines.training.export import PolicyMode

ALGORITHMS: Mapping[str, str] = {
    "ppo": "stable_baselines3:PPO", "a2c": "stable_baselines3:A2C", "sac": "stable_baselines3:SAC",
    "td3": "stable_baselines3:TD3", "ddpg": "stable_baselines3:DDPG", "tqc": "sb3_contrib:TQC",
    "trpo": "sb3_contrib:TRPO", "recurrent_ppo": "sb3_contrib:RecurrentPPO",
}  # fmt: skip
"""Algorithms of Stable-Baselines3 and sb3-contrib with a Box of actions."""
CODE = (
    "{path} is a file that can run code when it is loaded ({kind}). If you trained it yourself, or trust its author as "
    "you trust a program, say so with --trust"
)


class TrainedModel(NamedTuple):
    """A trained model.

    Attributes:
        network: Maps batches of observations, and memory if it has one, to actions and the next memory.
        act: The same by the model's own library: an observation, a state and the start of an episode to the action and
            the next state, for the comparison with the exported file.
        memory: Size of the state that it carries from step to step, 0 for none.
        source: Library and algorithm.
        steps: Environment steps of its training, 0 if the file does not say.
        observation_space: Observation space of its training, None if the file does not say.
    """

    network: nn.Module
    act: Callable[[Any, Any, bool], tuple[Any, Any]]
    memory: int = 0
    source: str = ""
    steps: int = 0
    observation_space: Any = None


def load_model(path: str, algorithm: str | None, normalization: Path | None, trust: bool) -> TrainedModel:
    """Load a model.

    Args:
        path: A zip of Stable-Baselines3; a `.cleanrl_model`, the state dict of an actor of CleanRL; a TorchScript file
            (`.pt`, `.ts`); a program of `torch.export` (`.pt2`); or `module:callable`, which returns a torch module.
        algorithm: A name of `ALGORITHMS`, for a zip only.
        normalization: Statistics of observations: an `.npz` with `mean` and `var`, optionally `epsilon` (1e-8) and
            `clip` (10), or the pickle of Stable-Baselines3's `VecNormalize`.
        trust: True if the user trusts files that can run code.

    Raises:
        ValueError: A file of another kind, without `trust` one that can run code, or a missing or wrong option.
    """
    file, suffix = Path(path), Path(path).suffix
    if ":" not in path and not file.is_file():
        raise ValueError(f"MODEL must be a file or module:callable, got {path!r}")
    if (algorithm is not None) != (suffix == ".zip"):
        raise ValueError(f"--algo must be given with a .zip of Stable-Baselines3 and with nothing else, got {path!r}")
    scale = None if normalization is None else _normalization(normalization, trust)
    if suffix == ".zip":
        return _stable_baselines(file, str(algorithm), scale, trust)
    if suffix == ".cleanrl_model":
        network: nn.Module = _cleanrl_actor(file)
        return _plain(network, scale, "CleanRL")
    if suffix in (".pt", ".ts", ".pt2"):
        kind = "torch.export" if suffix == ".pt2" else "TorchScript"
        if not trust:
            raise ValueError(CODE.format(path=path, kind=kind))
        return _plain(_program(file) if suffix == ".pt2" else torch.jit.load(file, "cpu").eval(), scale, kind)
    if ":" in path:
        return _plain(_made(path), scale, "torch")
    raise ValueError(f"MODEL must be .zip, .cleanrl_model, .pt, .ts, .pt2 or module:callable, got {path!r}")


class Normalization(NamedTuple):
    """Statistics of observations, by key; the key is None for a single Box.

    Attributes:
        mean: Means.
        deviation: Standard deviations.
        clip: Bound of the absolute value of normalized entries.
    """

    mean: dict[str | None, Any]
    deviation: dict[str | None, Any]
    clip: float

    def applied(self, observation: Any) -> Any:
        """Normalize an observation of NumPy, in float64."""
        if None in self.mean:
            return self._entry(None, observation)
        return {key: self._entry(key, value) if key in self.mean else value for key, value in observation.items()}

    def _entry(self, key: str | None, value: Any) -> Any:
        return np.clip((value - self.mean[key]) / self.deviation[key], -self.clip, self.clip).astype(np.float32)


class Normalized(nn.Module):
    """Normalize observations in torch, as `Normalization.applied` does."""

    def __init__(self, scale: Normalization) -> None:
        super().__init__()
        self._scale = scale

    def forward(self, observation: Any) -> Any:
        """Normalize a batch: a tensor, or a dictionary of tensors."""
        if None in self._scale.mean:
            return self._entry(None, observation)
        return {key: self._entry(key, part) if key in self._scale.mean else part for key, part in observation.items()}

    def _entry(self, key: str | None, part: torch.Tensor) -> torch.Tensor:
        mean = np.asarray(self._scale.mean[key], np.float64)
        # The mean in two parts: of an entry that hardly varies, float32 alone would lose the difference.
        coarse = mean.astype(np.float32)
        fine = (mean - coarse).astype(np.float32)
        deviation = torch.as_tensor(self._scale.deviation[key], dtype=torch.float32)
        centered = (part - torch.as_tensor(coarse)) - torch.as_tensor(fine)
        return torch.clamp(centered / deviation, -self._scale.clip, self._scale.clip)


def _normalization(path: Path, trust: bool) -> Normalization:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as found:
            if not {"mean", "var"} <= set(found.files):
                raise ValueError(f"{path} must hold the arrays mean and var, got {', '.join(found.files)}")
            epsilon = float(found["epsilon"]) if "epsilon" in found.files else 1e-8
            clip = float(found["clip"]) if "clip" in found.files else 10.0
            return Normalization({None: found["mean"]}, {None: np.sqrt(found["var"] + epsilon)}, clip)
    if not trust:
        raise ValueError(CODE.format(path=path, kind="a pickle"))
    from stable_baselines3.common.save_util import load_from_pkl

    saved = load_from_pkl(path)
    stats = saved.obs_rms if isinstance(saved.obs_rms, dict) else {None: saved.obs_rms}
    deviation = {key: np.sqrt(found.var + saved.epsilon) for key, found in stats.items()}
    return Normalization({key: found.mean for key, found in stats.items()}, deviation, saved.clip_obs)


class _BehindNormalization(nn.Module):
    def __init__(self, network: nn.Module, scale: Normalization | None) -> None:
        super().__init__()
        self.network, self.normalized = network, None if scale is None else Normalized(scale)

    def forward(self, observation: Any, *memory: torch.Tensor) -> Any:
        seen = observation if self.normalized is None else self.normalized(observation)
        return self.network(seen, *memory)


class _ChannelsFirst(nn.Module):
    """Stable-Baselines3's policy mode behind its transposition of images."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.mode = PolicyMode(policy)
        space = policy.observation_space
        parts = space.spaces if hasattr(space, "spaces") else {None: space}
        self._shapes: dict[str | None, tuple[int, ...]] = {key: part.shape for key, part in parts.items()}

    def forward(self, observation: Any, *memory: torch.Tensor) -> Any:
        if isinstance(observation, dict):
            seen: Any = {key: _transposed(part, self._shapes[key]) for key, part in observation.items()}
        else:
            seen = _transposed(observation, self._shapes[None])
        return self.mode(seen, *memory)


def _transposed(part: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    return part if tuple(part.shape[1:]) == shape else part.permute(0, 3, 1, 2)


def _stable_baselines(path: Path, algorithm: str, scale: Normalization | None, trust: bool) -> TrainedModel:
    if algorithm not in ALGORITHMS:
        raise ValueError(f"--algo must be one of {', '.join(ALGORITHMS)}, got {algorithm!r}")
    if not trust:
        raise ValueError(CODE.format(path=path, kind="a zip with pickles"))
    module, _, name = ALGORITHMS[algorithm].partition(":")
    # A replay buffer for hindsight needs an environment when it is loaded; the policy does not need the buffer.
    unused: dict[str, Any] = {"replay_buffer_class": None, "replay_buffer_kwargs": {}}
    model = getattr(importlib.import_module(module), name).load(path, device="cpu", custom_objects=unused)
    policy = model.policy
    policy.set_training_mode(False)

    def act(observation: Any, state: Any, start: bool) -> tuple[Any, Any]:
        seen = observation if scale is None else scale.applied(observation)
        return model.predict(seen, state=state, episode_start=np.array([start]), deterministic=True)

    behind = _ChannelsFirst(policy)
    return TrainedModel(
        _BehindNormalization(behind, scale), act, behind.mode.memory, f"{module} {name}", int(model.num_timesteps),
        model.observation_space,
    )  # fmt: skip


def _cleanrl_actor(path: Path) -> nn.Module:
    """Build the actor that a state dict of CleanRL's continuous scripts describes; loading it runs no code."""
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path} is no state dict, or holds more than tensors; save actor.state_dict()") from error
    state = state[0] if isinstance(state, (tuple, list)) else state
    layers = sorted(key[:-7] for key in state if key.startswith("actor_mean.") and key.endswith(".weight"))
    last = next((name for name in ("fc_mu", "fc_mean") if f"{name}.weight" in state), None)
    if layers:
        names = sorted(layers, key=lambda name: int(name.rpartition(".")[2]))
    elif last is not None:
        names = [*sorted(key[:-7] for key in state if _hidden(key)), last]
    else:
        raise ValueError(
            f"{path} must hold actor_mean.*, fc_mu.* or fc_mean.* as CleanRL's scripts for continuous actions do, got "
            f"{', '.join(list(state)[:5])}; give module:callable instead"
        )
    parts: list[nn.Module] = []
    for name in names:
        weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        parts += [linear, nn.Tanh() if layers else nn.ReLU()]
    parts = parts[:-1]
    if last is not None and not layers:
        parts += [nn.Tanh(), _Affine(state["action_scale"].reshape(-1), state["action_bias"].reshape(-1))]
    return nn.Sequential(nn.Flatten(), *parts)


def _hidden(key: str) -> bool:
    name = key.partition(".")[0]
    return key.endswith(".weight") and name.startswith("fc") and name[2:].isdigit()


class _Affine(nn.Module):
    scale: torch.Tensor
    bias: torch.Tensor

    def __init__(self, scale: torch.Tensor, bias: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("scale", scale)
        self.register_buffer("bias", bias)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return values * self.scale + self.bias


def _program(path: Path) -> nn.Module:
    program: Any = torch.export.load(path).module()
    # Its form is fixed: torch refuses to switch it between training and evaluation.
    program.train = lambda mode=True: program
    return program


def _made(path: str) -> nn.Module:
    module, _, name = path.partition(":")
    try:
        made = getattr(importlib.import_module(module), name)()
    except (ImportError, AttributeError) as error:
        raise ValueError(f"MODEL {path!r} cannot be imported ({error}); give module:callable") from error
    if not isinstance(made, nn.Module):
        raise ValueError(f"MODEL {path!r} must return a torch.nn.Module, got {type(made).__name__}")
    return made.eval()


def _plain(network: nn.Module, scale: Normalization | None, source: str) -> TrainedModel:
    def act(observation: Any, state: Any, start: bool) -> tuple[Any, Any]:
        seen = observation if scale is None else scale.applied(observation)
        with torch.no_grad():
            if isinstance(seen, dict):
                batch: Any = {key: torch.as_tensor(value, dtype=torch.float32)[None] for key, value in seen.items()}
            else:
                batch = torch.as_tensor(seen, dtype=torch.float32)[None]
            return network(batch)[0].numpy(), None

    return TrainedModel(_BehindNormalization(network, scale), act, 0, source)
