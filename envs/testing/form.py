"""Checks of the values that a vector environment returns: spaces, types, shapes, masks, frames."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.vector.utils import batch_space, create_empty_array

from servotrack.envs.testing.event_trace import FINAL_KEYS, batch_actions
from servotrack.envs.testing.subject import Subject, VectorEnv, assert_rejected, assert_same
from servotrack.estimators.testing.bits import first_difference


def check_spaces(subject: Subject) -> None:
    """Check that spaces, their batches and the metadata agree with the arguments."""
    for mode in subject.modes:
        with subject.opened(mode) as env:
            shared = deepcopy(dict(type(env.unwrapped).metadata))
            assert env.num_envs == subject.num_envs, (
                f"num_envs must be {subject.num_envs}, as requested, got {env.num_envs}"
            )
            for name in ("observation_space", "action_space"):
                single = getattr(env, f"single_{name}")
                assert getattr(env, name) == batch_space(single, env.num_envs), (
                    f"{name} must be gymnasium.vector.utils.batch_space(single_{name}, {env.num_envs}), "
                    f"got {getattr(env, name)}"
                )
            declared = env.metadata.get("autoreset_mode")
            assert declared == mode, (
                f"metadata['autoreset_mode'] must be the requested mode, {mode}, got {declared!r}: add an argument "
                "autoreset_mode to the environment, or pass the modes that it supports as autoreset_modes"
            )
            with subject.opened(mode):
                pass
            assert type(env.unwrapped).metadata == shared, (
                "the constructor changes the metadata of its class; copy them first"
            )


def check_returns(subject: Subject) -> None:
    """Check types, shapes and data types of the values that reset and step return."""
    for mode in subject.modes:
        with subject.opened(mode) as env:
            observations, infos = env.reset(seed=subject.seed)
            _check_observations(env, observations, "reset()")
            assert isinstance(infos, dict), f"reset() must return a dictionary of infos, got {type(infos).__name__}"
            for _, (observations, rewards, terminated, truncated, infos) in subject.play(env, mode):
                _check_observations(env, observations, "step()")
                _check_array("rewards", rewards, env.num_envs, np.floating)
                _check_array("terminations", terminated, env.num_envs, np.bool_)
                _check_array("truncations", truncated, env.num_envs, np.bool_)
                assert isinstance(infos, dict), f"step() must return a dictionary of infos, got {type(infos).__name__}"


def check_infos(subject: Subject) -> None:
    """Check that reset and step have the same infos, each with one value and one mask entry per sub-environment."""
    for mode in subject.modes:
        with subject.opened(mode) as env:
            infos = env.reset(seed=subject.seed)[1]
            _check_infos(infos, env.num_envs, "infos")
            form = _info_form(infos)
            for _, result in subject.play(env, mode):
                _check_infos(result[4], env.num_envs, "infos")
                _check_info_form(result[4], form, "infos")
                if result[4].get("final_info"):
                    _check_info_form(result[4]["final_info"], form, "infos['final_info']")


def check_rendering(subject: Subject) -> None:
    """Check that render returns one new uint8 frame per sub-environment and has no effect on the episode."""
    mode = subject.modes[0]
    with subject.opened(mode) as env, subject.opened(mode) as twin:
        if env.render_mode != "rgb_array":
            return
        env.reset(seed=subject.seed)
        twin.reset(seed=subject.seed)
        for (_, ours), (_, theirs) in zip(subject.play(env, mode), subject.play(twin, mode), strict=False):
            assert_same(ours, theirs, "rendering must not change the episode")
            frames = env.render()
            assert isinstance(frames, (tuple, list)) and len(frames) == env.num_envs, (
                f"render() must return a tuple of {env.num_envs} frames, got {type(frames).__name__}"
            )
            for frame in frames:
                assert isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.shape[2:] == (3,), (
                    f"render() must return uint8 arrays of shape (height, width, 3), got "
                    f"{getattr(frame, 'dtype', type(frame))}"
                    f"{getattr(frame, 'shape', '')}"
                )
            kept = deepcopy(frames)
            assert_same(env.render(), kept, "two calls of render() without a step in between must give the same frames")


def check_order(subject: Subject) -> None:
    """Check that a step before the first reset is rejected."""
    with subject.opened(subject.modes[0]) as env:
        actions = batch_actions(env, [own[0] for own in subject.plan(env).actions])
        assert_rejected("step() before the first reset()", env.step, actions)


def _check_observations(env: VectorEnv, observations: Any, source: str) -> None:
    space = env.observation_space
    assert observations in space, (
        f"{source} must return observations in observation_space: same keys, shapes, data types and within the bounds; "
        f"got {observations}, not in {space}"
    )
    # `in` also accepts values that could be cast to the space's data types.
    expected: Any = create_empty_array(env.single_observation_space, n=env.num_envs, fn=np.zeros)
    found = first_difference(_data_types(observations), _data_types(expected), "observations")
    assert found is None, f"{source} must return observations of the space's data types, but {found}"


def _data_types(value: Any) -> Any:
    """Replace every array of a nested value by its data type."""
    if isinstance(value, Mapping):
        return {key: _data_types(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(_data_types(item) for item in value)
    return str(np.asarray(value).dtype)


def _check_array(name: str, value: Any, num_envs: int, dtype: type[np.generic]) -> None:
    assert isinstance(value, np.ndarray) and value.shape == (num_envs,) and np.issubdtype(value.dtype, dtype), (
        f"step() must return {name} as an array of {dtype.__name__} with shape ({num_envs},), got "
        f"{f'{value.dtype}{value.shape}' if isinstance(value, np.ndarray) else type(value).__name__}"
    )


def _info_form(infos: dict[str, Any]) -> dict[str, Any]:
    """Data type and shape of every entry, nested ones included, without masks and `FINAL_KEYS`."""
    return {
        key: _info_form(value) if isinstance(value, dict) else f"{np.asarray(value).dtype}{np.shape(value)}"
        for key, value in infos.items()
        if not key.startswith("_") and key not in FINAL_KEYS
    }


def _check_info_form(infos: dict[str, Any], form: dict[str, Any], where: str) -> None:
    found = first_difference(_info_form(infos), form, where)
    assert found is None, (
        "step() must return infos with the keys, data types and shapes of those of reset(), nested ones included, "
        f"because recorders of data sets store them as columns, but {found}; fill in zeros until a value is known"
    )


def _check_infos(infos: dict[str, Any], num_envs: int, where: str) -> None:
    for key, value in infos.items():
        if key.startswith("_"):
            assert key[1:] in infos, f"{where}['{key}'] is a mask without an entry: {where}['{key[1:]}'] is missing"
            continue
        mask = infos.get(f"_{key}")
        assert isinstance(mask, np.ndarray) and mask.shape == (num_envs,) and mask.dtype == np.bool_, (
            f"{where}['{key}'] needs a mask {where}['_{key}'], a boolean array of shape ({num_envs},), got {mask!r}"
        )
        if isinstance(value, dict):
            _check_infos(value, num_envs, f"{where}['{key}']")
        else:
            assert isinstance(value, np.ndarray) and len(value) == num_envs, (
                f"{where}['{key}'] must be an array with a leading axis of {num_envs}, got {value!r}"
            )
            empty = value[~mask]
            assert not any(np.any(entry) for entry in empty), (
                f"{where}['{key}'] must be zeros (or None) where its mask is False, got {value} with mask {mask}"
            )
