"""Checkers for vector environments: correct environments pass, and every check finds its faults."""

from __future__ import annotations

from functools import partial
from typing import Any

import faulty_counter as world
import gymnasium as gym
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from servotrack.envs.testing import CHECKS, VectorEnvFaults, check_vector_env, check_vector_matches_single

FAULTS = {
    "batches the wrong number": "spaces",
    "declares another mode": "spaces",
    "changes the metadata of its class": "spaces",
    "rewards as a list": "returns",
    "observations out of bounds": "returns",
    "observations in single precision": "returns",
    "one seed for all": "seeding",
    "ignores a list of seeds": "seeding",
    "None in a list seeds anew": "seeding",
    "accepts any number of seeds": "seeding",
    "draws from a shared source": "determinism",
    "rewards the reset": "autoreset",
    "obeys the ignored action": "autoreset",
    "no final_obs": "autoreset",
    "final mask for all": "autoreset",
    "final_obs of the next episode": "autoreset",
    "never ends": "autoreset",
    "a mask resets all": "partial reset",
    "a mask disturbs the neighbors": "partial reset",
    "infos of all after a mask": "partial reset",
    "pops the mask": "reset options",
    "writes into the mask": "reset options",
    "accepts an empty mask": "reset options",
    "accepts any mask": "reset options",
    "returns its own state": "fresh arrays",
    "returns its own info mask": "fresh arrays",
    "writes into the actions": "fresh arrays",
    "infos without a mask": "infos",
    "infos where the mask is False": "infos",
    "infos without a leading axis": "infos",
    "infos gain a key after the reset": "infos",
    "infos change their type": "infos",
    "a frame too few": "rendering",
    "frames of floats": "rendering",
    "rendering draws random numbers": "rendering",
    "frames change without a step": "rendering",
    "steps before the reset": "order",
}
DIFFERENCES = ("differs in the last bit", "rewards in single precision", "infos lack a key", "one seed for all")


def faults_of(check: Any, *args: Any, **kwargs: Any) -> dict[str, str]:
    with pytest.raises(VectorEnvFaults) as caught:
        check(*args, **kwargs)
    return caught.value.faults


def test_a_correct_environment_passes() -> None:
    check_vector_env(world.CounterVectorEnv)
    check_vector_matches_single(world.CounterVectorEnv, world.Counter)


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_found_by_its_check(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world.CounterVectorEnv, "metadata", {"render_modes": ["rgb_array"]})
    faults = faults_of(check_vector_env, partial(world.CounterVectorEnv, fault=fault), steps=16)
    assert FAULTS[fault] in faults, faults


def test_every_check_has_a_fault_that_it_finds() -> None:
    assert set(FAULTS.values()) == set(CHECKS)


@pytest.mark.parametrize("fault", DIFFERENCES)
def test_differences_from_the_single_environment_are_found(fault: str) -> None:
    faults = faults_of(check_vector_matches_single, partial(world.CounterVectorEnv, fault=fault), world.Counter)
    assert faults.keys() == {"NEXT_STEP", "SAME_STEP", "DISABLED"}


def test_the_message_names_place_and_values() -> None:
    make = partial(world.CounterVectorEnv, fault="differs in the last bit")
    faults = faults_of(check_vector_matches_single, make, world.Counter)
    assert "sub-environment 0, event 1 (a step): observation[0] is" in faults["NEXT_STEP"]


def test_an_exception_of_the_environment_is_a_fault() -> None:
    def make(num_envs: int, autoreset_mode: AutoresetMode) -> Any:
        raise ZeroDivisionError("nothing to share")

    faults = faults_of(check_vector_env, make)
    assert faults.keys() == CHECKS.keys()
    assert faults["spaces"] == "the environment raised ZeroDivisionError: nothing to share"


def test_gymnasiums_own_vectorizer_passes_but_for_the_mask_that_it_pops() -> None:
    def make(num_envs: int, autoreset_mode: AutoresetMode) -> Any:
        return SyncVectorEnv([lambda: gym.make("CartPole-v1")] * num_envs, autoreset_mode=autoreset_mode)

    check_vector_env(make, skip=["reset options"])
    check_vector_matches_single(make, lambda: gym.make("CartPole-v1"))
    assert "became {}" in faults_of(check_vector_env, make)["reset options"]


def test_gymnasiums_vector_cart_pole_is_seen_to_disagree() -> None:
    def make(num_envs: int, autoreset_mode: AutoresetMode) -> Any:
        return gym.make_vec("CartPole-v1", num_envs, vectorization_mode="vector_entry_point")

    modes = [AutoresetMode.NEXT_STEP]
    assert faults_of(check_vector_env, make, autoreset_modes=modes).keys() == {
        "seeding",
        "partial reset",
        "reset options",
    }
    single = faults_of(check_vector_matches_single, make, lambda: gym.make("CartPole-v1"), autoreset_modes=modes)
    assert "sub-environment 0, event 0 (a reset): observation" in single["NEXT_STEP"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"num_envs": 1}, "num_envs"),
        ({"steps": 1}, "steps"),
        ({"autoreset_modes": ()}, "autoreset_modes"),
        ({"skip": ["seeds"]}, "seeds"),
    ],
)
def test_senseless_arguments_are_named(arguments: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        check_vector_env(world.CounterVectorEnv, **arguments)


def test_a_callable_needs_a_single_environment_beside_it() -> None:
    with pytest.raises(ValueError, match="make_single"):
        check_vector_matches_single(world.CounterVectorEnv)
