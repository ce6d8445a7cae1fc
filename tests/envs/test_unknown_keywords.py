"""Unknown keywords of every id: recognized by libraries, with the nearest known keyword for people."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS

MAKERS: list[Callable[..., Any]] = [gym.make, gym.make_vec]


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_an_unknown_keyword_has_pythons_own_wording(env_id: str, make: Callable[..., Any]) -> None:
    """TorchRL's `GymEnv` passes `frameskip` and retries without it only if the TypeError has these words."""
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'"):
        make(env_id, frameskip=1)


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_the_nearest_keyword_is_suggested(env_id: str, make: Callable[..., Any]) -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'horizn'; did you mean 'horizon'"):
        make(env_id, horizn=5)
