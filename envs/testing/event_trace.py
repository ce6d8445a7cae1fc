"""What happens to each sub-environment of a vector environment, told the same way in every autoreset mode.

A sub-environment's *story* is the list of its events: resets and steps, each with all that came back. The three modes
deliver the same events at different calls and in different places: NEXT_STEP spends a call of its own on a reset,
SAME_STEP hides an episode's last observation and info in `infos["final_obs"]` and `infos["final_info"]`, DISABLED
leaves the reset to the caller. Told as stories they agree to the bit, with each other and with a single environment's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from servotrack.envs.testing.bits import first_difference

FINAL_KEYS = ("final_obs", "final_info")


class Event(NamedTuple):
    """One reset or step of one sub-environment; a reset has no reward and ends nothing."""

    kind: str
    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


EventTrace = list[Event]


class ActionPlan(NamedTuple):
    """What is done to the sub-environments.

    Attributes:
        seed: Of the first reset; the i-th sub-environment gets seed + i.
        actions: For each the actions of its steps, in order. An action that is ignored is not taken from here.
        ignored: For each the actions to hand over where they must be ignored.
        interrupt_after: Steps after which every second sub-environment is reset by mask although its episode goes on;
            None for never.
    """

    seed: int
    actions: tuple[tuple[Any, ...], ...]
    ignored: tuple[Any, ...]
    interrupt_after: int | None = None

    @property
    def steps(self) -> int:
        """Steps of every sub-environment."""
        return len(self.actions[0])

    def interrupts(self, row: int, steps_taken: int, over: bool) -> bool:
        """Whether a sub-environment is to be reset now although its episode goes on."""
        return row % 2 == 1 and steps_taken == self.interrupt_after and not over


def write_plan(
    space: gym.Space[Any], rows: int, seed: int, steps: int, interrupt_after: int | None = None
) -> ActionPlan:
    """A script of random actions, the same for the same arguments.

    Args:
        space: Action space of one sub-environment.
        rows: Number of sub-environments.
        seed: Of the first reset.
        steps: Steps of every sub-environment.
        interrupt_after: As in `ActionPlan`.
    """
    source = deepcopy(space)
    source.seed(seed)

    def some(count: int) -> tuple[Any, ...]:
        return tuple(source.sample() for _ in range(count))

    actions = tuple(some(steps) for _ in range(rows))
    return ActionPlan(seed, actions, some(rows), interrupt_after)


def batch_actions(env: gym.vector.VectorEnv[Any, Any, Any], rows: Iterable[Any]) -> Any:
    """One batch of a vector environment's actions from one action for each sub-environment."""
    batch: Any = create_empty_array(env.single_action_space, n=env.num_envs, fn=np.zeros)
    return concatenate(env.single_action_space, list(rows), batch)


def info_row(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """The info of one sub-environment: the entries whose mask is true for it, without what SAME_STEP adds."""
    own: dict[str, Any] = {}
    for key, value in infos.items():
        if key.startswith("_") or key in FINAL_KEYS:
            continue
        assert f"_{key}" in infos, (
            f"infos['{key}'] has no mask infos['_{key}'] that says whose it is; add one, (num_envs,) bool"
        )
        if infos[f"_{key}"][row]:
            own[key] = info_row(value, row) if isinstance(value, dict) else deepcopy(value[row])
    return own


def vector_traces(
    env: gym.vector.VectorEnv[Any, Any, Any], script: ActionPlan, mode: AutoresetMode, tamper: bool = False
) -> list[EventTrace]:
    """Play a script in a vector environment.

    Args:
        env: In `mode`; it is reset first.
        script: What to do.
        mode: The autoreset mode whose rules hold.
        tamper: Overwrite everything that the environment returned, and the actions, once they are recorded.

    Returns:
        One story for each sub-environment, each with `script.steps` steps and ending with one.

    Raises:
        AssertionError: The environment breaks a rule of its mode.
    """
    stories: list[EventTrace] = [[] for _ in range(env.num_envs)]
    taken = [0] * env.num_envs
    over = [False] * env.num_envs

    def told() -> bool:
        return all(count >= script.steps for count in taken)

    def record_resets(rows: Sequence[int], observations: Any, infos: dict[str, Any]) -> None:
        each = list(iterate(env.observation_space, observations))
        for row in rows:
            _append(stories[row], Event("reset", each[row], 0.0, False, False, info_row(infos, row)))
            over[row] = False

    returned = env.reset(seed=script.seed)
    record_resets(range(env.num_envs), *returned)
    while True:
        if tamper:
            overwrite(returned)
        if told():
            return [_cut(story, script.steps) for story in stories]
        waiting = [row for row in range(env.num_envs) if over[row] and mode == AutoresetMode.NEXT_STEP]
        actions = batch_actions(
            env,
            [
                script.ignored[row] if row in waiting or taken[row] >= script.steps else script.actions[row][taken[row]]
                for row in range(env.num_envs)
            ],
        )
        result = env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        for row in waiting:
            assert rewards[row] == 0 and not terminated[row] and not truncated[row], (
                f"NEXT_STEP: the step after an episode's end only resets, but sub-environment {row} returned reward "
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
            _append(stories[row], Event("step", observation, *flags, info))
            over[row] = row in ended
        if mode == AutoresetMode.SAME_STEP:
            record_resets(ended, observations, infos)
        if tamper:
            overwrite((result, actions))
        returned = ({}, {})
        due = [
            row
            for row in stepped
            if (mode == AutoresetMode.DISABLED and over[row]) or script.interrupts(row, taken[row], row in ended)
        ]
        if due and not told():
            mask = np.zeros(env.num_envs, np.bool_)
            mask[due] = True
            returned = env.reset(options={"reset_mask": mask})
            record_resets(due, *returned)


def single_trace(env: gym.Env[Any, Any], script: ActionPlan, row: int) -> EventTrace:
    """Play one sub-environment's part of a script in a single environment.

    Args:
        env: The single environment; it is reset first.
        script: What to do.
        row: Whose part.
    """
    observation, info = env.reset(seed=script.seed + row)
    story: EventTrace = []
    _append(story, Event("reset", observation, 0.0, False, False, info))
    for taken, action in enumerate(script.actions[row], start=1):
        observation, reward, terminated, truncated, info = env.step(action)
        _append(story, Event("step", observation, float(reward), bool(terminated), bool(truncated), info))
        over = bool(terminated or truncated)
        if (over or script.interrupts(row, taken, over)) and taken < script.steps:
            observation, info = env.reset()
            _append(story, Event("reset", observation, 0.0, False, False, info))
    return story


def story_difference(ours: Sequence[EventTrace], theirs: Sequence[EventTrace]) -> str | None:
    """A sentence about the first event that two sets of stories tell differently, or None."""
    for row, (our_story, their_story) in enumerate(zip(ours, theirs, strict=True)):
        for number, (mine, other) in enumerate(zip(our_story, their_story, strict=False)):
            for field in Event._fields:
                found = first_difference(getattr(mine, field), getattr(other, field), field)
                if found:
                    return f"sub-environment {row}, event {number} (a {mine.kind}): {found}"
        if len(our_story) != len(their_story):
            return f"sub-environment {row} has {len(our_story)} events here and {len(their_story)} there"
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


def _append(story: EventTrace, event: Event) -> None:
    story.append(deepcopy(event))


def _cut(story: EventTrace, steps: int) -> EventTrace:
    """The story up to its `steps`-th step, which some sub-environments pass while others still make theirs."""
    last = [number for number, event in enumerate(story) if event.kind == "step"][steps - 1]
    return story[: last + 1]


def _check_final(num_envs: int, infos: dict[str, Any], ended: Sequence[int], mode: AutoresetMode) -> None:
    """Whether `final_obs` and `final_info` are there for exactly the sub-environments that ended in SAME_STEP."""
    expected = np.isin(np.arange(num_envs), ended)
    for key in FINAL_KEYS:
        if not expected.any() and key not in infos:
            continue
        mask = np.asarray(infos.get(f"_{key}", np.zeros(num_envs, np.bool_)))
        assert key in infos and np.array_equal(mask, expected), (
            f"{mode.name}: infos['{key}'] and its mask infos['_{key}'] must be there for exactly the sub-environments "
            f"whose episode just ended in SAME_STEP, {expected.tolist()}, but the mask is {mask.tolist()}"
        )
