"""Event traces of the sub-environments of a vector environment, in one form for every autoreset mode.

The trace of a sub-environment is the list of its events: resets and steps, each with all returned values. The three
modes deliver the same events at different calls and in different places: NEXT_STEP uses a separate call for a reset,
SAME_STEP returns an episode's last observation and info in `infos["final_obs"]` and `infos["final_info"]`, DISABLED
leaves the reset to the caller. The traces of all modes and of single environments are bit-identical.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from servotrack.estimators.testing.bits import first_difference

FINAL_KEYS = ("final_obs", "final_info")
"""Keys of infos that hold the last observation and info of an episode in SAME_STEP."""


class Event(NamedTuple):
    """One reset or step of one sub-environment. A reset has reward 0 and both flags False."""

    kind: str
    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


EventTrace = list[Event]


class ActionPlan(NamedTuple):
    """Seeds, actions and resets of a test run.

    Attributes:
        seed: Seed of the first reset; sub-environment i gets seed + i.
        actions: Actions of each sub-environment in order, without ignored ones.
        ignored: One action for each sub-environment, passed at calls where actions must be ignored.
        interrupt_after: Number of steps after which every second sub-environment is reset by mask in the middle of its
            episode; None for never.
    """

    seed: int
    actions: tuple[tuple[Any, ...], ...]
    ignored: tuple[Any, ...]
    interrupt_after: int | None = None

    @property
    def steps(self) -> int:
        """Number of steps of every sub-environment."""
        return len(self.actions[0])

    def interrupts(self, row: int, steps_taken: int, over: bool) -> bool:
        """Return True if a sub-environment must be reset now in the middle of its episode."""
        return row % 2 == 1 and steps_taken == self.interrupt_after and not over


def write_plan(
    space: gym.Space[Any], rows: int, seed: int, steps: int, interrupt_after: int | None = None
) -> ActionPlan:
    """Return a plan of random actions, a function of the arguments only.

    Args:
        space: Action space of one sub-environment.
        rows: Number of sub-environments.
        seed: Seed of the first reset, and of the actions.
        steps: Number of steps of every sub-environment.
        interrupt_after: Number of steps before a reset by mask, see `ActionPlan`.
    """
    source = deepcopy(space)
    source.seed(seed)

    def some(count: int) -> tuple[Any, ...]:
        return tuple(source.sample() for _ in range(count))

    actions = tuple(some(steps) for _ in range(rows))
    return ActionPlan(seed, actions, some(rows), interrupt_after)


def batch_actions(env: gym.vector.VectorEnv[Any, Any, Any], rows: Iterable[Any]) -> Any:
    """Join one action for each sub-environment into a batch for the vector environment."""
    batch: Any = create_empty_array(env.single_action_space, n=env.num_envs, fn=np.zeros)
    return concatenate(env.single_action_space, list(rows), batch)


def info_row(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """Info of one sub-environment: the entries whose mask is true for it, without `FINAL_KEYS`."""
    own: dict[str, Any] = {}
    for key, value in infos.items():
        if key.startswith("_") or key in FINAL_KEYS:
            continue
        assert f"_{key}" in infos, (
            f"infos['{key}'] has no mask infos['_{key}']; add one, a bool array of shape (num_envs,)"
        )
        if infos[f"_{key}"][row]:
            own[key] = info_row(value, row) if isinstance(value, dict) else deepcopy(value[row])
    return own


def vector_traces(
    env: gym.vector.VectorEnv[Any, Any, Any], plan: ActionPlan, mode: AutoresetMode, tamper: bool = False
) -> list[EventTrace]:
    """Run a plan in a vector environment.

    Args:
        env: Vector environment in `mode`; it is reset first.
        plan: Seeds, actions and resets.
        mode: Autoreset mode of the environment.
        tamper: Overwrite all returned arrays, and the actions, after they are recorded.

    Returns:
        One trace for each sub-environment, each with `plan.steps` steps and ending with a step.

    Raises:
        AssertionError: The environment violates a rule of its mode.
    """
    traces: list[EventTrace] = [[] for _ in range(env.num_envs)]
    taken = [0] * env.num_envs
    over = [False] * env.num_envs

    def finished() -> bool:
        return all(count >= plan.steps for count in taken)

    def record_resets(rows: Sequence[int], observations: Any, infos: dict[str, Any]) -> None:
        each = list(iterate(env.observation_space, observations))
        for row in rows:
            _append(traces[row], Event("reset", each[row], 0.0, False, False, info_row(infos, row)))
            over[row] = False

    returned = env.reset(seed=plan.seed)
    record_resets(range(env.num_envs), *returned)
    while True:
        if tamper:
            overwrite(returned)
        if finished():
            return [_cut(trace, plan.steps) for trace in traces]
        waiting = [row for row in range(env.num_envs) if over[row] and mode == AutoresetMode.NEXT_STEP]
        actions = batch_actions(
            env,
            [
                plan.ignored[row] if row in waiting or taken[row] >= plan.steps else plan.actions[row][taken[row]]
                for row in range(env.num_envs)
            ],
        )
        result = env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        for row in waiting:
            assert rewards[row] == 0 and not terminated[row] and not truncated[row], (
                f"NEXT_STEP: the step after an episode's end must only reset, sub-environment {row} returned reward "
                f"{rewards[row]}, terminated {terminated[row]}, truncated {truncated[row]}; return 0, False, False"
            )
        record_resets(waiting, observations, infos)
        each = list(iterate(env.observation_space, observations))
        stepped = [row for row in range(env.num_envs) if row not in waiting]
        ended = [row for row in stepped if terminated[row] or truncated[row]]
        _check_final(env.num_envs, infos, ended if mode == AutoresetMode.SAME_STEP else [], mode)
        for row in stepped:
            taken[row] += 1
            hidden = row in ended and mode == AutoresetMode.SAME_STEP
            observation = infos["final_obs"][row] if hidden else each[row]
            info = info_row(infos["final_info"] if hidden else infos, row)
            flags = float(rewards[row]), bool(terminated[row]), bool(truncated[row])
            _append(traces[row], Event("step", observation, *flags, info))
            over[row] = row in ended
        if mode == AutoresetMode.SAME_STEP:
            record_resets(ended, observations, infos)
        if tamper:
            overwrite((result, actions))
        returned = ({}, {})
        due = [
            row
            for row in stepped
            if (mode == AutoresetMode.DISABLED and over[row]) or plan.interrupts(row, taken[row], row in ended)
        ]
        if due and not finished():
            mask = np.zeros(env.num_envs, np.bool_)
            mask[due] = True
            returned = env.reset(options={"reset_mask": mask})
            record_resets(due, *returned)


def single_trace(env: gym.Env[Any, Any], plan: ActionPlan, row: int) -> EventTrace:
    """Run one sub-environment's part of a plan in a single environment.

    Args:
        env: Single environment; it is reset first.
        plan: Seeds, actions and resets.
        row: Index of the sub-environment.
    """
    observation, info = env.reset(seed=plan.seed + row)
    trace: EventTrace = []
    _append(trace, Event("reset", observation, 0.0, False, False, info))
    for taken, action in enumerate(plan.actions[row], start=1):
        observation, reward, terminated, truncated, info = env.step(action)
        _append(trace, Event("step", observation, float(reward), bool(terminated), bool(truncated), info))
        over = bool(terminated or truncated)
        if (over or plan.interrupts(row, taken, over)) and taken < plan.steps:
            observation, info = env.reset()
            _append(trace, Event("reset", observation, 0.0, False, False, info))
    return trace


def trace_difference(ours: Sequence[EventTrace], theirs: Sequence[EventTrace]) -> str | None:
    """Describe the first difference between two sets of traces in a sentence, or return None."""
    for row, (our_trace, their_trace) in enumerate(zip(ours, theirs, strict=True)):
        for number, (mine, other) in enumerate(zip(our_trace, their_trace, strict=False)):
            for field in Event._fields:
                found = first_difference(getattr(mine, field), getattr(other, field), field)
                if found:
                    return f"sub-environment {row}, event {number} (a {mine.kind}): {found}"
        if len(our_trace) != len(their_trace):
            return f"sub-environment {row} has {len(our_trace)} events here and {len(their_trace)} there"
    return None


def overwrite(value: Any) -> None:
    """Fill every array in a nested value with ones, in place."""
    if isinstance(value, dict):
        for item in value.values():
            overwrite(item)
    elif isinstance(value, (tuple, list)):
        for item in value:
            overwrite(item)
    elif isinstance(value, np.ndarray):
        if value.dtype == object:
            overwrite(value.tolist())
        elif value.flags.writeable:
            value[...] = np.ones((), value.dtype)


def _append(trace: EventTrace, event: Event) -> None:
    trace.append(deepcopy(event))


def _cut(trace: EventTrace, steps: int) -> EventTrace:
    """Trace up to its `steps`-th step: some sub-environments take more steps while others finish theirs."""
    last = [number for number, event in enumerate(trace) if event.kind == "step"][steps - 1]
    return trace[: last + 1]


def _check_final(num_envs: int, infos: dict[str, Any], ended: Sequence[int], mode: AutoresetMode) -> None:
    """Raise AssertionError unless exactly the episodes that ended in SAME_STEP have `final_obs` and `final_info`."""
    expected = np.isin(np.arange(num_envs), ended)
    for key in FINAL_KEYS:
        if not expected.any() and key not in infos:
            continue
        mask = np.asarray(infos.get(f"_{key}", np.zeros(num_envs, np.bool_)))
        assert key in infos and np.array_equal(mask, expected), (
            f"{mode.name}: infos['{key}'] and its mask infos['_{key}'] must exist for exactly the sub-environments "
            f"whose episode just ended in SAME_STEP, {expected.tolist()}, but the mask is {mask.tolist()}"
        )
