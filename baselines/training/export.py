"""Export policies to ONNX files, with the normalization of observations included."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from servotrack.baselines.agents.learned.card import LearnedCard, digest
from servotrack.baselines.agents.learned.marker_network import keep_marker_network
from servotrack.baselines.agents.learned.network import ACTION, MEMORY, NEXT_MEMORY, OBSERVATION
from servotrack.baselines.reporting.files import atomic_path


class PolicyMode(nn.Module):
    """The mode of a policy as a function of rows and memory.

    Args:
        policy: Policy of an algorithm of Stable-Baselines3 or sb3-contrib with a Box of actions.
        mean: Mean of the rows, shape (size,); None disables normalization.
        deviation: Standard deviation of the rows, shape (size,).
        clip: Bound of the absolute value of normalized rows.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, policy: Any, mean: Any = None, deviation: Any = None, clip: float = 10.0) -> None:
        super().__init__()
        self.policy, self.clip = policy, clip
        self.recurrent = hasattr(policy, "lstm_actor")
        self.memory = 2 * policy.lstm_actor.num_layers * policy.lstm_actor.hidden_size if self.recurrent else 0
        self.normalized = mean is not None
        for name, value in (("mean", mean), ("deviation", deviation)):
            self.register_buffer(
                name, torch.as_tensor(np.asarray(0.0 if value is None else value), dtype=torch.float32)
            )

    def forward(self, observation: torch.Tensor, memory: torch.Tensor | None = None) -> Any:
        """Return actions (N, n), and the next memory (N, M) if the policy is recurrent."""
        if self.normalized:
            observation = torch.clamp((observation - self.mean) / self.deviation, -self.clip, self.clip)
        policy = self.policy
        if self.recurrent:
            latent, carried = self._remembered(
                policy.extract_features(observation, policy.pi_features_extractor), memory
            )
            return policy.action_net(policy.mlp_extractor.forward_actor(latent)), carried
        if hasattr(policy, "mlp_extractor"):
            features = policy.extract_features(observation, policy.pi_features_extractor)
            return policy.action_net(policy.mlp_extractor.forward_actor(features))
        actor = policy.actor
        features = actor.extract_features(observation, actor.features_extractor)
        # The mean of SAC has no tanh yet, that of TD3 has.
        squashed = (
            torch.tanh(actor.mu(actor.latent_pi(features))) if hasattr(actor, "latent_pi") else actor.mu(features)
        )
        low, high = (torch.as_tensor(bound) for bound in (policy.action_space.low, policy.action_space.high))
        return low + 0.5 * (squashed + 1.0) * (high - low)

    def _remembered(self, features: torch.Tensor, memory: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        assert memory is not None
        lstm = self.policy.lstm_actor
        states = memory.reshape(-1, 2, lstm.num_layers, lstm.hidden_size).permute(1, 2, 0, 3).contiguous()
        out, (hidden, cell) = lstm(features[None], (states[0], states[1]))
        return out[0], torch.stack([hidden, cell]).permute(2, 0, 1, 3).reshape(-1, self.memory)


class Exportable(NamedTuple):
    """A module and the layout of its ONNX file.

    Attributes:
        network: The module; its arguments are the inputs in order.
        inputs: Example of each input by name; the first axis is the batch.
        outputs: Names of the outputs.
        memory: Size of the state that it carries from step to step, 0 for none.
    """

    network: nn.Module
    inputs: Mapping[str, torch.Tensor]
    outputs: tuple[str, ...]
    memory: int = 0


def exportable_policy(network: nn.Module, size: int, memory: int = 0) -> Exportable:
    """Describe a policy that maps rows (N, size), and memory (N, M) if M > 0, to actions and the next memory."""
    if memory == 0:
        return Exportable(network, {OBSERVATION: torch.zeros(2, size)}, (ACTION,))
    inputs = {OBSERVATION: torch.zeros(2, size), MEMORY: torch.zeros(2, memory)}
    return Exportable(network, inputs, (ACTION, NEXT_MEMORY), memory)


def export(subject: Exportable, path: Path) -> bytes:
    """Write a network atomically and return the bytes of the file."""
    network, training = subject.network, subject.network.training
    network.eval()
    with atomic_path(path) as temporary, warnings.catch_warnings():
        # The newer dynamo exporter takes fifteen times as long for the same result.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(subject.inputs.values()),
            str(temporary),
            dynamo=False,
            input_names=list(subject.inputs),
            output_names=list(subject.outputs),
            dynamic_axes={name: {0: "n"} for name in (*subject.inputs, *subject.outputs)},
        )
        content = temporary.read_bytes()
    network.train(training)
    return content


def write_agent(subject: Exportable, card: LearnedCard, folder: Path) -> LearnedCard:
    """Write a network, then its card, so that a card never exists without its network.

    Returns:
        The card with the digest of the network.
    """
    content = export(subject, folder / card.network)
    card = replace(card, sha256=digest(content), memory=subject.memory)
    write_card(card, folder)
    return card


def write_card(card: LearnedCard, folder: Path) -> None:
    """Write the card next to its network, and the marker network that its encoding needs, unless the package has it."""
    if "eyes" in card.encoding:
        keep_marker_network(card.encoding["eyes"], folder)
    with atomic_path((folder / card.network).with_suffix(".json")) as temporary:
        temporary.write_text(card.as_json(), encoding="utf-8")
