"""Encodings of observations for learned agents: one flat row of float32 per observation, with a memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.card_fields import check_encoding
from servotrack.baselines.agents.learned.contract import Encoding, PlainAnswers
from servotrack.baselines.agents.learned.marker_network import open_marker_network
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo, servo_measurement
from servotrack.baselines.agents.servo.pixel_servo import PIXEL_KEYS, MarkerFeatures, MarkerMemory
from servotrack.estimators.jacobian.laws import damped_inverse
from servotrack.estimators.types import FloatArray, Mask

JACOBIAN_UNIT = 300.0
"""Unit of an identified Jacobian in a row, px/rad and px/s."""
IDENTIFIED_DAMPING = 0.03
"""Singular value, relative to the largest, below which an identified Jacobian's inverse is damped."""


@dataclass(frozen=True)
class FlatEncoding(PlainAnswers):
    """All entries of a Box, or of a Dict of Boxes in alphabetical order of its keys, scaled to [-1, 1] by the bounds.

    Attributes:
        low: Lower bounds, in the order of the row.
        high: Upper bounds.
        keys: Keys of a Dict, sorted; empty for a Box. Entries of an observation are found by them, so the order of keys
            in an observation has no effect.
        scaled: False leaves the entries in their physical units.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    keys: tuple[str, ...] = ()
    scaled: bool = True

    @classmethod
    def of(cls, space: spaces.Space[Any], scaled: bool = True) -> FlatEncoding:
        """Create the encoding of a space.

        Args:
            space: Observation space of one environment.
            scaled: False leaves the entries in their physical units.

        Raises:
            ValueError: A space that is not a bounded Box or a Dict of bounded Boxes.
        """
        keys = tuple(sorted(space.spaces)) if isinstance(space, spaces.Dict) else ()
        boxes = [space.spaces[key] for key in keys] if isinstance(space, spaces.Dict) else [space]
        for box in boxes:
            if not isinstance(box, spaces.Box) or not box.is_bounded():
                raise ValueError(f"observation_space must be a bounded Box, or a Dict of such, got {space}")
        low, high = (np.concatenate([np.ravel(getattr(box, side)) for box in boxes]) for side in ("low", "high"))
        return cls(tuple(low.tolist()), tuple(high.tolist()), keys, scaled)

    @property
    def size(self) -> int:
        """Length of a row."""
        return len(self.low)

    def initial(self, observation: Any) -> tuple[()]:
        """Return an empty memory."""
        return ()

    def step(self, memory: tuple[()], observation: Any, action: FloatArray) -> tuple[tuple[()], FloatArray]:
        """Process one observation; see `Encoding.step`."""
        parts = [observation[key] for key in self.keys] if self.keys else [observation]
        row = np.concatenate([np.asarray(part, np.float64).reshape(len(part), -1) for part in parts], axis=1)
        if not self.scaled:
            return (), row.astype(np.float32)
        low, high = np.array(self.low), np.array(self.high)
        return (), (2.0 * (row - low) / np.where(high > low, high - low, 1.0) - 1.0).astype(np.float32)


@dataclass(frozen=True)
class FlatAnswers:
    """An encoding whose network answers with the flattened entries of an action that has several axes, such as a set.

    Attributes:
        encoding: Encoding of the rows.
        shape: Shape of an action.
    """

    encoding: Encoding
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.encoding.size

    def initial(self, observation: Any) -> Any:
        """Return the memory before an episode; see `Encoding.initial`."""
        return self.encoding.initial(observation)

    def step(self, memory: Any, observation: Any, action: FloatArray) -> tuple[Any, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        return self.encoding.step(memory, observation, action)

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the flat Box of the action space."""
        return spaces.flatten_space(action_space)

    def act(self, memory: Any, answer: FloatArray) -> tuple[Any, NDArray[Any]]:
        """Return the answer in the shape of actions."""
        memory, action = self.encoding.act(memory, answer)
        return memory, action.reshape(len(action), *self.shape)


class StackMemory(NamedTuple):
    """Memory of `Stacked`.

    Attributes:
        own: Memory of the stacked encoding.
        rows: Last rows, the newest last. Shape (N, frames, size).
        fresh: True before the first row. Shape (N,).
    """

    own: Any
    rows: FloatArray
    fresh: Mask


@dataclass(frozen=True)
class Stacked:
    """Concatenates the last rows of another encoding, the newest last; at the start the first row is repeated.

    Attributes:
        encoding: Encoding of a single row.
        frames: Number of rows, at least 2.
    """

    encoding: Encoding
    frames: int

    def __post_init__(self) -> None:
        """Check the number of frames."""
        if self.frames < 2:
            raise ValueError(f"frames must be at least 2 to be stacked, got {self.frames!r}")

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.frames * self.encoding.size

    def initial(self, observation: Any) -> StackMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        count = len(next(iter(observation.values())) if isinstance(observation, Mapping) else observation)
        rows = np.zeros((count, self.frames, self.encoding.size), np.float32)
        return StackMemory(self.encoding.initial(observation), rows, np.ones(count, np.bool_))

    def step(self, memory: StackMemory, observation: Any, action: FloatArray) -> tuple[StackMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        own, row = self.encoding.step(memory.own, observation, action)
        rows = np.concatenate([memory.rows[:, 1:], row[:, None]], axis=1)
        if memory.fresh.any():
            rows = np.where(memory.fresh[:, None, None], row[:, None], rows)
        return StackMemory(own, rows, np.zeros_like(memory.fresh)), rows.reshape(len(rows), -1)

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the network's answers; see `Encoding.answer_space`."""
        return self.encoding.answer_space(action_space)

    def act(self, memory: StackMemory, answer: FloatArray) -> tuple[StackMemory, NDArray[Any]]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        own, action = self.encoding.act(memory.own, answer)
        return memory._replace(own=own), action


class ResidualMemory(NamedTuple):
    """Memory of `Residual`.

    Attributes:
        own: Memory of the encoding.
        servo: State of the classical servo.
        action: Action of the classical servo. Shape (N, actions).
    """

    own: Any
    servo: Any
    action: FloatArray


@dataclass(frozen=True)
class Residual(PlainAnswers):
    """Appends a classical servo's action to another encoding's rows; the network's answer is a correction of it.

    Attributes:
        encoding: Encoding of the rows.
        servo: The classical agent.
    """

    encoding: Encoding
    servo: JacobianServo

    @property
    def size(self) -> int:
        """Length of a row: the encoding's and the action's, 2 for a planar arm."""
        return self.encoding.size + 2

    def initial(self, observation: Any) -> ResidualMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        measurement: Any = servo_measurement(observation)
        action = np.zeros(measurement.joint_angles.shape, np.float32)
        return ResidualMemory(self.encoding.initial(observation), self.servo.controller.initial(measurement), action)

    def step(self, memory: ResidualMemory, observation: Any, action: FloatArray) -> tuple[ResidualMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        own, row = self.encoding.step(memory.own, observation, action)
        classical, servo = self.servo.predict(observation, memory.servo)
        return ResidualMemory(own, servo, classical), np.concatenate([row, classical], axis=1)

    def act(self, memory: ResidualMemory, answer: FloatArray) -> tuple[ResidualMemory, FloatArray]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        return memory, memory.action + answer


class IdentifiedMemory(NamedTuple):
    """Memory of `Identified`.

    Attributes:
        own: Memory of the encoding.
        estimator: State of the Jacobian estimator.
    """

    own: Any
    estimator: Any


@dataclass(frozen=True)
class Identified(PlainAnswers):
    """Appends what a classical servo's estimator has identified to another encoding's rows.

    These are the error at present (2, hundreds of px), the total image Jacobian (6, in `JACOBIAN_UNIT`), and the action
    that would remove the error in one period (2, clipped to [-2, 2]). The estimator runs online; nothing of it is
    trained. Law, probing and supervisor of the servo are not used: exploration is up to the network.

    Attributes:
        encoding: Encoding of the rows.
        servo: The classical agent.
    """

    encoding: Encoding
    servo: JacobianServo

    @property
    def size(self) -> int:
        """Length of a row: the encoding's, and 10 numbers of a planar arm."""
        return self.encoding.size + 10

    def initial(self, observation: Any) -> IdentifiedMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        measurement: Any = servo_measurement(observation)
        return IdentifiedMemory(
            self.encoding.initial(observation), self.servo.controller.estimator.initial(measurement)
        )

    def step(
        self, memory: IdentifiedMemory, observation: Any, action: FloatArray
    ) -> tuple[IdentifiedMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        own, row = self.encoding.step(memory.own, observation, action)
        controller, measurement = self.servo.controller, servo_measurement(observation)
        state, estimate = controller.estimator.step(memory.estimator, measurement)  # type: ignore[arg-type]
        assert controller.law is not None, "servos of the catalog have a law of their own"
        period, jacobian = controller.law.period, estimate.jacobian
        inverse = damped_inverse(jacobian[..., :-1], IDENTIFIED_DAMPING)
        motion = -np.einsum("...ij,...j->...i", inverse, estimate.predict_error(np.zeros(inverse.shape[:-1]), period))
        found = [
            estimate.error / 100.0,
            jacobian.reshape(len(row), -1) / JACOBIAN_UNIT,
            np.clip(motion / (controller.max_joint_rate * period), -2.0, 2.0),
        ]
        return IdentifiedMemory(own, state), np.concatenate([row, *found], axis=1).astype(np.float32)


class MarkerEncodingMemory(NamedTuple):
    """Memory of `MarkerEncoding`.

    Attributes:
        seen: Newest detection of the marker.
        own: Memory of the encoding of features.
    """

    seen: MarkerMemory
    own: Any


@dataclass(frozen=True)
class MarkerEncoding:
    """Encoding of image observations: a marker detector, then an encoding of features.

    Attributes:
        features: Converts images to features.
        encoding: Encoding of the features.
    """

    features: MarkerFeatures
    encoding: Encoding

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.encoding.size

    def initial(self, observation: Any) -> MarkerEncodingMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        seen = self.features.initial(observation)
        # `step` processes the first image; before it the marker counts as not visible.
        blind = {**observation, "features": seen.features, "visible": np.zeros_like(seen.frame_time)}
        return MarkerEncodingMemory(seen, self.encoding.initial(blind))

    def step(
        self, memory: MarkerEncodingMemory, observation: Any, action: FloatArray
    ) -> tuple[MarkerEncodingMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        seen, features = self.features.step(memory.seen, observation)
        own, rows = self.encoding.step(memory.own, features, action)
        return MarkerEncodingMemory(seen, own), rows

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the network's answers; see `Encoding.answer_space`."""
        return self.encoding.answer_space(action_space)

    def act(self, memory: MarkerEncodingMemory, answer: FloatArray) -> tuple[MarkerEncodingMemory, NDArray[Any]]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        own, action = self.encoding.act(memory.own, answer)
        return memory._replace(own=own), action


def create_encoding(settings: Mapping[str, Any], env: Any, folder: Path | None = None) -> Encoding:
    """Create the encoding that a card or a file of hyper-parameters describes.

    Args:
        settings: `kind` ("servo", "steering", "flat" or "raw"); `frames`, number of rows to stack, 1 for none;
            `residual`, name of a classical servo whose action the network corrects; `identifier`, name of a classical
            servo whose estimate is appended to the rows; `eyes`, name of a marker network for image observations;
            `follower`, name of an agent that identifies the person to follow; and the arguments of the kind. They may
            come from a file: names are those of fixed tables, never `module:callable` or a path.
        env: A Gymnasium environment or vector environment.
        folder: Folder of the card, which is searched for marker networks before the package's own.

    Raises:
        ValueError: An unknown kind, field or name, a value out of bounds, or a space that the kind does not support.
        AgentFileError: A missing or invalid marker network.
    """
    check_encoding(settings)
    space = getattr(env, "single_observation_space", env.observation_space)
    if "follower" in settings:
        # Imported here because it loads the set filters and OpenCV.
        from servotrack.baselines.agents.learned.follow_corrector import behind_follower

        behind = {key: value for key, value in settings.items() if key != "follower"}
        return behind_follower(settings["follower"], env, lambda seen: _of_features(behind, env, seen))
    if "eyes" not in settings:
        return _of_features(settings, env, space)
    if not set(PIXEL_KEYS) <= set(getattr(space, "spaces", ())):
        raise ValueError(f"encoding with eyes needs the observations {', '.join(PIXEL_KEYS)}, got {space}")
    parts = {key: part for key, part in space.spaces.items() if key != "image"}
    seen = spaces.Dict({**parts, "features": parts["goal"], "visible": spaces.Box(0.0, 1.0, (1,))})
    encoding = _of_features({key: value for key, value in settings.items() if key != "eyes"}, env, seen)
    return MarkerEncoding(MarkerFeatures(open_marker_network(settings["eyes"], folder)), encoding)


def _of_features(settings: Mapping[str, Any], env: Any, space: spaces.Space[Any]) -> Encoding:
    given = dict(settings)
    kind, frames, residual = given.pop("kind", "flat"), given.pop("frames", 1), given.pop("residual", None)
    identifier = given.pop("identifier", None)
    if kind == "servo":
        encoding: Encoding = ServoEncoding(**given)
        ServoEncoding.check(space)
    elif kind == "steering":
        from servotrack.baselines.agents.learned.filter_steering import create_steering

        encoding = create_steering(env)
    elif kind in ("flat", "raw"):
        encoding = FlatEncoding.of(space, scaled=kind == "flat")
        actions = getattr(env, "single_action_space", env.action_space)
        if len(actions.shape) > 1:
            encoding = FlatAnswers(encoding, actions.shape)
    else:
        raise ValueError(f"encoding must be of kind servo, steering, flat or raw, got {kind!r}")
    if frames != 1:
        encoding = Stacked(encoding, frames)
    if identifier is not None:
        encoding = Identified(encoding, _servo_named(identifier, "identifier", env))
    return encoding if residual is None else Residual(encoding, _servo_named(residual, "residual", env))


def _servo_named(name: str, field: str, env: Any) -> JacobianServo:
    servo = create_agent(name, env)
    if not isinstance(servo, JacobianServo):
        raise ValueError(f"{field} must name a classical servo of features, got {name!r}")
    return servo
