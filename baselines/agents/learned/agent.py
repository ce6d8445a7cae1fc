"""Learned agents behind `predict`: an encoding and a network, run without torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, load_card
from servotrack.baselines.agents.learned.contract import Encoding
from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.baselines.agents.learned.marker_network import MARKER, MarkerNetwork
from servotrack.baselines.agents.learned.network import OnnxNetwork
from servotrack.baselines.agents.learned.shipped import shipped_file
from servotrack.baselines.agents.memory import remembered
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo
from servotrack.baselines.agents.servo.pixel_servo import PixelServo
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.jacobian.alignment import check_clock
from servotrack.estimators.types import Array, FloatArray, Mask

if TYPE_CHECKING:
    from servotrack.baselines.agents.learned.set_prediction import SetPredictor


class LearnedState(NamedTuple):
    """Memory of a `LearnedAgent`, with a leading axis of N.

    Attributes:
        encoding: Memory of the encoding.
        network: Memory of the network. Shape (N, M).
        action: Last action. Shape (N, *action).
        time: Time of the last observation, -inf before the first and without a clock. Shape (N,), s.
    """

    encoding: Any
    network: FloatArray
    action: NDArray[Any]
    time: Array


class LearnedAgent:
    """A network that reads encoded observations.

    Args:
        network: Maps rows (N, size) and memory (N, M) to answers and the next memory.
        encoding: Encoding of observations to rows.
        observation_space: Observation space of one environment.
        action_space: Action space of one environment, a Box.

    Raises:
        AgentFileError: Network, encoding and spaces do not match.
    """

    def __init__(
        self,
        network: OnnxNetwork,
        encoding: Encoding,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
    ) -> None:
        if network.size != encoding.size:
            raise AgentFileError(
                f"{network.path} reads rows of {network.size} numbers, but its encoding gives {encoding.size} here"
            )
        answers = encoding.answer_space(action_space)
        if not isinstance(action_space, spaces.Box) or answers.shape != (network.actions,):
            raise AgentFileError(f"{network.path} gives {network.actions} numbers, but the answer must be in {answers}")
        self.network, self._encoding = network, encoding
        self._low, self._high = action_space.low, action_space.high
        space: Any = observation_space
        parts = space.items() if isinstance(space, spaces.Dict) else [(None, space)]
        self._shapes: dict[str | None, tuple[int, ...]] = {key: part.shape or () for key, part in parts}
        # Other environments may mean something else by `time`.
        self._has_clock = all(self._shapes.get(key) == (1,) for key in ("time", "frame_time"))

    def predict(
        self,
        observation: Any,
        state: LearnedState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], LearnedState]:
        """Choose actions.

        Args:
            observation: Observation of the environment, single or with a leading axis.
            state: Result of the last call; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the action is always the policy's mode.

        Returns:
            Actions with the observation's leading axis, and the new state.

        Raises:
            ValueError: An entry of the observation that is missing, has another shape, or makes the row non-finite; or
                a clock that went backwards.
            AgentFileError: The network fails, or its answer is not finite.
        """
        lead = self._leading_axis(observation)
        single, count = not lead, lead[0] if lead else 1
        if single:
            observation = _with_leading_axis(observation)
        state = remembered(state, episode_start, (count,), lambda: self._initial(observation, count))
        time = self._clock(observation, state.time)
        memory, rows = self._encoding.step(state.encoding, observation, state.action)
        if not np.isfinite(rows).all():
            raise ValueError(_non_finite_entry(observation))
        answer, carried = self.network(rows, state.network)
        memory, action = self._encoding.act(memory, answer)
        action = np.clip(action, self._low, self._high)
        return action[0] if single else action, LearnedState(memory, carried, action, time)

    def _leading_axis(self, observation: Any) -> tuple[int, ...]:
        """Return () for a single observation, (N,) for N of them; all entries must have the shapes of the space."""
        lead: tuple[int, ...] | None = None
        for key, shape in self._shapes.items():
            if key is not None and (not isinstance(observation, Mapping) or key not in observation):
                raise ValueError(f"observation must have {', '.join(map(str, self._shapes))}; {key} missing")
            given = np.shape(observation if key is None else observation[key])
            found = given[: len(given) - len(shape)]
            if given != found + shape or len(found) > 1 or lead not in (None, found):
                raise ValueError(
                    f"{_named(key)} must have shape {shape}, or one axis more that all entries share, got {given}"
                )
            lead = found
        return lead or ()

    def _clock(self, observation: Any, before: Array) -> Array:
        """Return the time of a batch of observations after checking it; without a clock, the time before."""
        if not self._has_clock:
            return before
        time = np.asarray(observation["time"], np.float64)[:, 0]
        if not np.isfinite(time).all():
            raise ValueError(_non_finite_entry(observation))
        check_clock(time, before, "mark the first observation of an episode by episode_start")
        return time

    def _initial(self, observation: Any, count: int) -> LearnedState:
        return LearnedState(
            self._encoding.initial(observation),
            np.zeros((count, self.network.memory), np.float32),
            np.zeros((count, *self._low.shape), self._low.dtype),
            np.full(count, -np.inf),
        )


def _named(key: str | None) -> str:
    return "observation" if key is None else f"observation {key}"


def _non_finite_entry(observation: Any) -> str:
    """Return the error message that names the entry of an observation that is NaN or infinite."""
    for key, part in observation.items() if isinstance(observation, Mapping) else [(None, observation)]:
        if len(bad := np.argwhere(~np.isfinite(part))):
            at = tuple(bad[0].tolist())
            return f"{_named(key)} must be finite, got {part[at]} at index {at}; repeat the last good one instead"
    return "state must come from the last call, got one that is not finite; begin with None"


def _with_leading_axis(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {key: np.asarray(value)[None] for key, value in observation.items()}
    return np.asarray(observation)[None]


def create_learned_agent(
    env: Any, path: str | None = None, name: str | None = None
) -> LearnedAgent | PixelServo | JacobianServo | SetPredictor:
    """Create a learned agent for an environment.

    Args:
        env: A Gymnasium environment or vector environment.
        path: Path of a card or network.
        name: Name of one of the package's agents, instead of `path`; its network for this environment is chosen.

    Raises:
        AgentFileError: Invalid files, or an agent that was trained for another environment.
    """
    file = shipped_file(name, env) if path is None and name is not None else Path(str(path))
    card = load_card(file)
    try:
        return _created(file, card, env)
    except ValueError as error:
        raise AgentFileError(f"{file} does not fit this environment: {error}") from error


def _created(file: Path, card: LearnedCard, env: Any) -> LearnedAgent | PixelServo | JacobianServo | SetPredictor:
    """Create the agent of a card. Raises ValueError for an environment that it does not fit."""
    if card.encoding.get("kind") == MARKER:
        servo = create_agent(card.encoding["servo"], env)
        if not isinstance(servo, PixelServo):
            raise AgentFileError(f"{file} detects markers in images, which this environment does not observe")
        return PixelServo(servo.servo, MarkerNetwork(file.parent / card.network, card))
    if card.encoding.get("kind") == "jacobian":
        return _estimating(file, card, env)
    if card.encoding.get("kind") == "set":
        return _predicting_sets(file, card, env)
    spec = getattr(env, "spec", None)
    if spec is not None and card.encoding.get("kind") != "servo" and spec.id != card.env_id:
        raise AgentFileError(f"{file} was trained in {card.env_id}, it cannot act in {spec.id}")
    observations = getattr(env, "single_observation_space", env.observation_space)
    actions = getattr(env, "single_action_space", env.action_space)
    encoding = create_encoding(card.encoding, env, file.parent)
    return LearnedAgent(OnnxNetwork(file.parent / card.network, card), encoding, observations, actions)


def _estimating(file: Path, card: LearnedCard, env: Any) -> JacobianServo:
    """Create a classical servo whose Jacobian a network estimates."""
    from servotrack.baselines.agents.learned.jacobian import (
        ENTRIES,
        LearnedJacobian,
        create_learned_servo,
        jacobian_encoding,
    )

    network = OnnxNetwork(file.parent / card.network, card)
    encoding, law = jacobian_encoding(card.encoding)
    servo = create_learned_servo(LearnedJacobian(network, network.memory, encoding), env, law)
    if (network.size, network.actions) != (encoding.size, ENTRIES):
        raise AgentFileError(
            f"{network.path} maps {network.size} numbers to {network.actions}, but a Jacobian needs {encoding.size} to "
            f"{ENTRIES} here"
        )
    return servo


def _predicting_sets(file: Path, card: LearnedCard, env: Any) -> SetPredictor:
    """Create an observer whose network classifies every measurement."""
    # Imported here because it loads the set filters, which servos do not need.
    from servotrack.baselines.agents.learned.set_prediction import ANSWERS, SetPredictor, SetWindow
    from servotrack.envs.track.clutter.scene_model import SceneModel

    network, scene = OnnxNetwork(file.parent / card.network, card), public_attribute(env, "scene_model")
    if not isinstance(scene, SceneModel):
        raise AgentFileError(f"{file} needs an environment whose `unwrapped.scene_model` is a SceneModel")
    if scene.lag:
        raise AgentFileError(f"{file} answers at once; lag must be 0, got {scene.lag}")
    window = SetWindow.of(card.encoding)
    if (network.size, network.actions, network.memory) != (window.size, ANSWERS, 0):
        raise AgentFileError(
            f"{network.path} maps {network.size} numbers to {network.actions}, but its window needs {window.size} to "
            f"{ANSWERS}, and no memory"
        )
    space = getattr(env, "single_action_space", env.action_space)
    nothing = np.zeros((0, 0), np.float32)
    return SetPredictor(lambda rows: network(rows, nothing)[0], window, scene, space.shape[0], space.low, space.high)
