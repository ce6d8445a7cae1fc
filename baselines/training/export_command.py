"""Export of models that other libraries trained to an ONNX file and its card, compared with the model itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from servotrack.baselines.agents.learned.agent import create_learned_agent
from servotrack.baselines.agents.learned.card import LearnedCard
from servotrack.baselines.agents.protocol import Information
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.reporting.files import temporary_folder_in
from servotrack.baselines.training.export import Exportable, exportable_policy, write_agent, write_card
from servotrack.baselines.training.observation_view import ActionView, ObservationView, encoding_kind, wrapped
from servotrack.baselines.training.trained_models import TrainedModel, load_model
from servotrack.baselines.worlds import describe_environment, plain
from servotrack.estimators.types import Array

COMPARED_STEPS = 200
"""Steps in which the exported file is compared with the model."""


@dataclass(frozen=True)
class ExportRequest:
    """Arguments of an export.

    Attributes:
        env_id: Gymnasium id that the model was trained in.
        env_kwargs: Arguments of that environment.
        model: File of the model, or `module:callable`; see `load_model`.
        algorithm: Algorithm of Stable-Baselines3 or sb3-contrib, for its files only.
        wrappers: Wrappers of the training, the innermost first.
        normalization: File with statistics of observations, None for none.
        name: Name of the agent.
        summary: Description in one line.
        information: Information that the agent receives about the system.
        steps: Environment steps of the training, None to take them from the model's file.
        output: Folder of the two files.
        tolerance: Largest accepted difference of an action from the model's, as a fraction of half the action's range.
            A larger value accepts more rounding.
        trust: True to load files that can run code.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    model: str
    algorithm: str | None
    wrappers: Sequence[str]
    normalization: Path | None
    name: str
    summary: str
    information: Information
    steps: int | None
    output: Path
    tolerance: float
    trust: bool


class _Deployed(nn.Module):
    """A model between rows of an encoding and flat actions of the environment."""

    def __init__(self, view: ObservationView, network: nn.Module, actions: ActionView) -> None:
        super().__init__()
        self.view, self.network, self.actions = view, network, actions

    def forward(self, rows: torch.Tensor, *memory: torch.Tensor) -> Any:
        answer = self.network(self.view(rows), *memory)
        if memory:
            return self.actions(answer[0]), answer[1]
        return self.actions(answer)


class _Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the last observation and action between an environment and the wrappers of a training."""

    observation: Any = None
    action: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.observation, info = self.env.reset(seed=seed, options=options)
        return self.observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        space: Any = self.env.action_space
        self.action = np.clip(np.asarray(action, np.float64), space.low, space.high)
        self.observation, reward, terminated, truncated, info = self.env.step(self.action.astype(space.dtype))
        return self.observation, reward, terminated, truncated, info


def export_model(request: ExportRequest) -> tuple[Path, float]:
    """Export a model, and compare the file with it on episodes of `tune` seeds.

    Args:
        request: Arguments.

    Returns:
        Path of the card, and the largest difference of an action, as a fraction of half the action's range.

    Raises:
        ValueError: A model that does not fit the environment in its wrappers, or whose exported actions differ.
        AgentFileError: A network that agents' files may not hold, such as one above 20 MB.
    """
    model = load_model(request.model, request.algorithm, request.normalization, request.trust)
    env = gym.make(request.env_id, **request.env_kwargs)
    try:
        tapped = _Recorder(env)
        seen = wrapped(tapped, request.wrappers)
        _check_spaces(model.observation_space, seen.observation_space, request.wrappers)
        view, actions = ObservationView(env, request.wrappers), ActionView(env, request.wrappers)
        deployed: nn.Module = _Deployed(view, model.network, actions)
        if any(isinstance(part, torch.jit.ScriptModule) for part in deployed.modules()):
            # The exporter cannot follow a script inside a module, but a script that contains it.
            deployed = torch.jit.trace(deployed, torch.zeros(2, view.size), check_trace=False)
        subject = exportable_policy(deployed, view.size, model.memory)
        level = request.env_kwargs.get("level")
        parts = [request.env_id.rpartition(":")[2], *([] if level is None else [f"level{level}"]), request.name]
        card = LearnedCard(
            name=request.name,
            summary=request.summary
            or f"{model.source} trained in {describe_environment(request.env_id, dict(request.env_kwargs))}",
            env_id=request.env_id.rpartition(":")[2],
            env_kwargs=plain(request.env_kwargs),
            encoding={"kind": encoding_kind(request.wrappers)},
            network=f"{'-'.join(parts)}.onnx",
            sha256="",
            information=request.information,
            steps=model.steps if request.steps is None else request.steps,
            training={"library": model.source, "wrappers": list(request.wrappers), "provenance": provenance()},
        )
        with temporary_folder_in(request.output) as folder:
            # An agent of this name that was exported earlier stays until the new one has been compared.
            difference = _written_and_compared(request, model, subject, card, folder, (seen, tapped))
            for suffix in (".onnx", ".json"):
                name = Path(card.network).with_suffix(suffix)
                (folder / name).replace(request.output / name)
        return (request.output / card.network).with_suffix(".json"), difference
    finally:
        env.close()


def _written_and_compared(
    request: ExportRequest,
    model: TrainedModel,
    subject: Exportable,
    card: LearnedCard,
    folder: Path,
    envs: tuple[Any, _Recorder],
) -> float:
    """Write network and card into a folder; returns the largest difference of an action from the model's."""
    try:
        card = write_agent(subject, card, folder)
    except (RuntimeError, TypeError, KeyError, torch.onnx.errors.OnnxExporterError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(
            f"{request.model} cannot be applied to the observations of {request.env_id} in "
            f"{', '.join(request.wrappers) or 'no wrapper'} ({reason}); give the wrappers of its training by --wrapper"
        ) from error
    difference = _largest_difference(model, *envs, (folder / card.network).with_suffix(".json"))
    if not difference <= request.tolerance:
        raise ValueError(
            f"actions of the exported network differ from those of {request.model} by {difference:.1e} of half "
            f"their range, --tolerance is {request.tolerance:.1e}; check --wrapper and --normalization. "
            "A difference near 1e-5 is rounding, which entries that hardly vary amplify"
        )
    compared = {"steps": COMPARED_STEPS, "largest_difference": difference}
    write_card(replace(card, training={**card.training, "compared": compared}), folder)
    return difference


def _check_spaces(trained: Any, given: spaces.Space[Any], wrappers: Sequence[str]) -> None:
    """Raise ValueError if a model was trained with other keys, shapes or bounds; images may have channels first."""
    if trained is None:
        return
    parts = [space.spaces if isinstance(space, spaces.Dict) else {"": space} for space in (trained, given)]
    if set(parts[0]) == set(parts[1]) and all(_same(parts[0][key], parts[1][key]) for key in parts[0]):
        return
    raise ValueError(
        f"the model was trained with observations in {trained}, but the environment in "
        f"{', '.join(wrappers) or 'no wrapper'} gives {given}; give the wrappers of its training by --wrapper"
    )


def _same(trained: Any, given: Any) -> bool:
    if len(given.shape) == 3 and trained.shape != given.shape:
        return trained.shape == (given.shape[2], *given.shape[:2])
    return (
        trained.shape == given.shape and np.allclose(trained.low, given.low) and np.allclose(trained.high, given.high)
    )


def _largest_difference(model: TrainedModel, env: Any, recorder: _Recorder, path: Path) -> float:
    """Return the largest difference between the actions of a model and of its file, in halves of the action's range."""
    space: Any = recorder.action_space
    half: Array = 0.5 * (space.high.astype(np.float64) - space.low)
    agent: Any = create_learned_agent(recorder.env, str(path))
    seeds = iter(take("tune", COMPARED_STEPS))
    differences, over = np.zeros(COMPARED_STEPS), True
    observation = state = carried = None
    for step in range(COMPARED_STEPS):
        if start := over:
            observation, _ = env.reset(seed=int(next(seeds)))
            state = carried = None
        action, carried = model.act(observation, carried, start)
        exported, state = agent.predict(recorder.observation, state)
        observation, _, terminated, truncated, _ = env.step(action)
        differences[step] = np.max(np.abs(exported - recorder.action) / half)
        over = terminated or truncated
    return float(differences.max())
