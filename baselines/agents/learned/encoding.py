"""The encoding that a card describes, from the encodings of their own rooms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gymnasium import spaces

from servotrack.baselines.agents.learned.card_fields import check_encoding
from servotrack.baselines.agents.learned.contract import Encoding
from servotrack.baselines.agents.learned.flat_encoding import FlatAnswers, FlatEncoding, Stacked
from servotrack.baselines.agents.learned.marker_encoding import MarkerEncoding
from servotrack.baselines.agents.learned.marker_network import open_marker_network
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.learned.servo_parts import Identified, Residual
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo
from servotrack.baselines.agents.servo.pixel_servo import PIXEL_KEYS, MarkerFeatures


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
