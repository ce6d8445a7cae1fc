"""Checkers for any Gymnasium vector environment, to be called from a test.

`gymnasium.utils.env_checker.check_env` checks single environments only. These check vector environments:

    from servotrack.envs.testing import check_vector_env, check_vector_matches_single

    def test_my_vector_env():
        check_vector_env("MyEnv-v0", max_episode_steps=20)
        check_vector_matches_single("MyEnv-v0", max_episode_steps=20)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from servotrack.envs.testing import behavior, form
from servotrack.envs.testing.event_trace import single_trace, trace_difference, vector_traces
from servotrack.envs.testing.subject import MakeVectorEnv, Subject

__all__ = ["ALL_MODES", "CHECKS", "MakeVectorEnv", "VectorEnvFaults", "check_vector_env", "check_vector_matches_single"]

ALL_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
"""All autoreset modes of Gymnasium."""

CHECKS: dict[str, Callable[[Subject], None]] = {
    "spaces": form.check_spaces,
    "returns": form.check_returns,
    "seeding": behavior.check_seeding,
    "determinism": behavior.check_determinism,
    "autoreset": behavior.check_autoreset,
    "partial reset": behavior.check_partial_reset,
    "reset options": behavior.check_reset_options,
    "fresh arrays": behavior.check_fresh_arrays,
    "infos": form.check_infos,
    "rendering": form.check_rendering,
    "order": form.check_order,
}
"""The checks of `check_vector_env` by name, in the order in which they run."""


class VectorEnvFaults(AssertionError):
    """The faults of a vector environment.

    Attributes:
        faults: Message of each failed check by the check's name: the fault and its remedy.
    """

    def __init__(self, faults: dict[str, str]) -> None:
        super().__init__("\n".join(f"[{name}] {message}" for name, message in faults.items()))
        self.faults = faults


def check_vector_env(
    make: str | MakeVectorEnv,
    *,
    num_envs: int = 3,
    steps: int = 60,
    seed: int = 0,
    autoreset_modes: Sequence[AutoresetMode] = ALL_MODES,
    skip: Sequence[str] = (),
    **kwargs: Any,
) -> None:
    """Check that a vector environment follows the rules of Gymnasium's vector API.

    | check | rule |
    |---|---|
    | `spaces` | spaces are batches of the single ones, `metadata["autoreset_mode"]` is the requested mode |
    | `returns` | observations are in their space; rewards are floats and flags bools, all (num_envs,) |
    | `seeding` | an int s means [s, s + 1, ...]; None in a list keeps a generator; a list of wrong length is rejected |
    | `determinism` | same seeds and actions give bit-identical results, also after autoresets |
    | `autoreset` | the modes follow their rules and give the same episodes; NEXT_STEP ignores the resetting action |
    | `partial reset` | `options["reset_mask"]` changes only the masked sub-environments |
    | `reset options` | the caller's options are not mutated; an invalid mask is rejected |
    | `fresh arrays` | returned arrays do not change later, and writing into them has no effect on the environment |
    | `infos` | every entry has a mask, and is zero (or None) where the mask is False |
    | `rendering` | with `render_mode="rgb_array"`: one uint8 frame per sub-environment, no effect on the episode |
    | `order` | a step before the first reset is rejected |

    Args:
        make: An environment id, passed to `gymnasium.make_vec` with its `vector_entry_point`; or a callable that takes
            `num_envs` and `autoreset_mode` as keywords and returns a new vector environment.
        num_envs: Number of sub-environments, at least 2.
        steps: Number of steps of every sub-environment in a check. At least one episode must end within them.
        seed: First seed.
        autoreset_modes: Modes that the environment supports.
        skip: Names of checks to skip.
        **kwargs: Further arguments of `gymnasium.make_vec` or of the callable.

    Raises:
        VectorEnvFaults: An AssertionError that lists all failed checks with their faults and remedies.
        ValueError: `num_envs`, `steps`, `autoreset_modes` or `skip` is invalid.
    """
    unknown = sorted(set(skip) - CHECKS.keys())
    if unknown:
        raise ValueError(f"skip contains unknown checks {unknown}; known are {', '.join(CHECKS)}")
    subject = _subject(make, num_envs, steps, seed, autoreset_modes, kwargs)
    faults: dict[str, str] = {}
    for name, check in CHECKS.items():
        if name not in skip:
            message = _fault(lambda check=check: check(subject))  # type: ignore[misc]
            if message is not None:
                faults[name] = message
    if faults:
        raise VectorEnvFaults(faults)


def check_vector_matches_single(
    make: str | MakeVectorEnv,
    make_single: Callable[[], gym.Env[Any, Any]] | None = None,
    *,
    num_envs: int = 3,
    steps: int = 60,
    seed: int = 0,
    autoreset_modes: Sequence[AutoresetMode] = ALL_MODES,
    interrupt_after: int | None = 5,
    **kwargs: Any,
) -> None:
    """Check that N sub-environments and N single environments give bit-identical results.

    Observations, rewards, terminations, truncations and infos are compared over several episodes, in every autoreset
    mode. A reset by mask in the middle of an episode desynchronizes every second sub-environment from the others.

    Args:
        make: Environment id or callable that creates the vector environment, see `check_vector_env`.
        make_single: Creates the single environment; default for an id: `gymnasium.make`.
        num_envs: Number of sub-environments, at least 2.
        steps: Number of steps of every sub-environment. At least one episode must end within them.
        seed: First seed.
        autoreset_modes: Modes that the environment supports.
        interrupt_after: Number of steps after which every second sub-environment is reset by mask. None for
            environments without `reset_mask`.
        **kwargs: Further arguments of `gymnasium.make_vec` and `gymnasium.make`, or of the callable `make`.

    Raises:
        VectorEnvFaults: An AssertionError with the sub-environment and event of the first difference in each mode.
        ValueError: `num_envs`, `steps` or `autoreset_modes` is invalid, or `make_single` is missing.
    """
    subject = _subject(make, num_envs, steps, seed, autoreset_modes, kwargs)
    if make_single is None:
        if not isinstance(make, str):
            raise ValueError(
                "make_single is missing: a callable `make` needs a callable for the single environment too"
            )
        env_id = make

        def make_single() -> gym.Env[Any, Any]:
            return gym.make(env_id, **kwargs)

    faults: dict[str, str] = {}
    for mode in subject.modes:
        message = _fault(lambda mode=mode: _compare(subject, make_single, mode, interrupt_after))  # type: ignore[misc]
        if message is not None:
            faults[mode.name] = message
    if faults:
        raise VectorEnvFaults(faults)


def _compare(
    subject: Subject, make_single: Callable[[], gym.Env[Any, Any]], mode: AutoresetMode, interrupt_after: int | None
) -> None:
    with subject.opened(mode) as env:
        plan = subject.plan(env, interrupt_after)
        ours = vector_traces(env, plan, mode)
    theirs = []
    for row in range(subject.num_envs):
        single = make_single()
        theirs.append(single_trace(single, plan, row))
        single.close()
    found = trace_difference(ours, theirs)
    assert found is None, (
        f"the vector environment (here) and single environments (there) differ: {found}; share one implementation"
    )
    assert any(event.terminated or event.truncated for trace in theirs for event in trace), (
        f"no episode ended within {subject.steps} steps; raise `steps`, or make the episodes shorter"
    )


def _fault(check: Callable[[], None]) -> str | None:
    """Message of a failed check, or None. An exception raised by the environment is a fault too."""
    try:
        check()
    except AssertionError as fault:
        return str(fault) or "the environment raised an AssertionError without a message"
    except Exception as error:
        return f"the environment raised {type(error).__name__}: {error}"
    return None


def _subject(
    make: str | MakeVectorEnv,
    num_envs: int,
    steps: int,
    seed: int,
    modes: Sequence[AutoresetMode],
    kwargs: dict[str, Any],
) -> Subject:
    if num_envs < 2:
        raise ValueError(
            f"num_envs must be at least 2, because checks compare neighboring sub-environments, got {num_envs}"
        )
    if steps < 4:
        raise ValueError(f"steps must be at least 4, got {steps}")
    if not modes:
        raise ValueError("autoreset_modes must name at least one mode, got none")

    def make_by_id(*, num_envs: int, autoreset_mode: AutoresetMode) -> gym.vector.VectorEnv[Any, Any, Any]:
        assert isinstance(make, str)
        return gym.make_vec(
            make, num_envs, vectorization_mode="vector_entry_point", autoreset_mode=autoreset_mode, **kwargs
        )

    def make_by_call(*, num_envs: int, autoreset_mode: AutoresetMode) -> gym.vector.VectorEnv[Any, Any, Any]:
        assert not isinstance(make, str)
        return make(num_envs=num_envs, autoreset_mode=autoreset_mode, **kwargs)

    maker = make_by_id if isinstance(make, str) else make_by_call
    return Subject(maker, num_envs, steps, seed, tuple(AutoresetMode(mode) for mode in modes))
