"""Checks of a vector environment's behavior: seeding, determinism, autoreset, partial resets, array ownership."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import iterate

from servotrack.envs.testing.event_trace import FINAL_KEYS, batch_actions, trace_difference, vector_traces
from servotrack.envs.testing.subject import Subject, VectorEnv, assert_rejected, assert_same


def check_seeding(subject: Subject) -> None:
    """Check that an int s seeds sub-environment i with s + i, a list sets one seed each, and None keeps a generator."""
    mode = subject.modes[0]
    with subject.opened(mode) as one, subject.opened(mode) as other:
        by_list = _record(subject, one, mode, subject.seeds)
        assert_same(
            by_list,
            _record(subject, other, mode, subject.seed),
            f"reset(seed={subject.seed}) must be the same as reset(seed={subject.seeds})",
        )
        assert_same(
            by_list,
            _record(subject, one, mode, subject.seeds),
            "a reset with the same seeds must give the same episodes again",
        )
        one.reset(seed=subject.seeds)
        other.reset(seed=subject.seeds)
        kept = _record(subject, one, mode, [subject.seed, *[None] * (subject.num_envs - 1)])
        unseeded = _record(subject, other, mode, None)
        rows = slice(1, None)
        assert_same(
            _rows(one, kept, rows),
            _rows(other, unseeded, rows),
            "None in a list of seeds must not change that sub-environment's generator",
        )
        assert_same(
            _rows(one, kept, slice(0, 1)),
            _rows(one, by_list, slice(0, 1)),
            "a seed next to None in a list must take effect",
        )
        too_many = [subject.seed] * (subject.num_envs + 1)
        assert_rejected(
            f"reset(seed=...) with {len(too_many)} seeds for {subject.num_envs} sub-environments",
            one.reset,
            seed=too_many,
        )


def check_determinism(subject: Subject) -> None:
    """Check that two environments with the same seeds and actions are bit-identical."""
    for mode in subject.modes:
        found = trace_difference(subject.traces(mode), subject.traces(mode))
        assert found is None, (
            f"{mode.name}: two runs with the same seeds and actions differ, {found}; draw from np_random only, and "
            "keep no state from one episode or environment to the next"
        )


def check_autoreset(subject: Subject) -> None:
    """Check that each autoreset mode follows its rules, and that all give the same traces."""
    traces_of = {mode: subject.traces(mode) for mode in subject.modes}
    for mode, traces in traces_of.items():
        assert any(event.terminated or event.truncated for trace in traces for event in trace), (
            f"{mode.name}: no episode ended within {subject.steps} steps, so there was no autoreset to check; raise "
            "`steps`, or make the episodes shorter"
        )
    first = subject.modes[0]
    for mode in subject.modes[1:]:
        found = trace_difference(traces_of[first], traces_of[mode])
        assert found is None, f"{first.name} (here) and {mode.name} (there) give different episodes: {found}"
    if AutoresetMode.NEXT_STEP in traces_of:
        with subject.opened(AutoresetMode.NEXT_STEP) as env:
            plan = subject.plan(env)
            # The reversed order gives every sub-environment another action to ignore.
            other = plan._replace(ignored=tuple(reversed([actions[-1] for actions in plan.actions])))
            found = trace_difference(
                traces_of[AutoresetMode.NEXT_STEP], vector_traces(env, other, AutoresetMode.NEXT_STEP, tamper=False)
            )
        assert found is None, (
            f"NEXT_STEP: the action of the step that resets must be ignored, but it has an effect: {found}"
        )


def check_partial_reset(subject: Subject) -> None:
    """Check that `options["reset_mask"]` resets the masked sub-environments and does not change the others."""
    mask = np.arange(subject.num_envs) % 2 == 0
    for mode in subject.modes:
        with subject.opened(mode) as env, subject.opened(mode) as twin:
            for each in (env, twin):
                before, _ = each.reset(seed=subject.seed)
                for _, result in subject.play(each, mode, steps=2):
                    before = result[0]
            before = deepcopy(before)
            observations, infos = env.reset(options={"reset_mask": mask.copy()})
            assert_same(
                _each(env, observations)[1::2],
                _each(env, before)[1::2],
                f"{mode.name}: a reset by mask {mask.tolist()} must return the others' last observations",
            )
            for key, value in infos.items():
                if key.startswith("_") and key[1:] not in FINAL_KEYS:
                    assert not np.any(np.asarray(value)[~mask]), (
                        f"{mode.name}: after a reset by mask {mask.tolist()} infos['{key}'] must be False elsewhere, "
                        f"got {value}"
                    )
            ours = [deepcopy(result) for _, result in subject.play(env, mode)]
            theirs = [deepcopy(result) for _, result in subject.play(twin, mode)]
            count = min(len(ours), len(theirs))
            assert_same(
                _rows(env, ours[:count], slice(1, None, 2)),
                _rows(twin, theirs[:count], slice(1, None, 2)),
                f"{mode.name}: a reset by mask {mask.tolist()} must not change later results of other rows",
            )


def check_reset_options(subject: Subject) -> None:
    """Check that the options are not mutated and that invalid masks are rejected."""
    with subject.opened(subject.modes[0]) as env:
        env.reset(seed=subject.seed, options={})
        mask = np.arange(subject.num_envs) == 0
        options = {"reset_mask": mask}
        env.reset(options=options)
        assert options.keys() == {"reset_mask"} and options["reset_mask"] is mask, (
            f"reset() changes the caller's options: {{'reset_mask': ...}} became {options}; read the mask without pop"
        )
        assert np.array_equal(mask, np.arange(subject.num_envs) == 0), (
            "reset() writes into the caller's options['reset_mask']"
        )
        for wrong, what in (
            (np.ones(subject.num_envs + 1, np.bool_), "of another length"),
            (np.ones(subject.num_envs, np.int64), "of integers"),
            (np.zeros(subject.num_envs, np.bool_), "that is false everywhere"),
        ):
            assert_rejected(f"an options['reset_mask'] {what}", env.reset, options={"reset_mask": wrong})


def check_fresh_arrays(subject: Subject) -> None:
    """Check that returned arrays do not change later, and that writing into them has no effect."""
    for mode in subject.modes:
        with subject.opened(mode) as env:
            held: list[Any] = [env.reset(seed=subject.seed)]
            copies = deepcopy(held)
            for actions, result in subject.play(env, mode):
                held.append(result)
                copies.append(deepcopy(result))
                held.append(actions)
                copies.append(batch_actions(env, [own[len(held) // 2 - 1] for own in subject.plan(env).actions]))
            assert_same(
                held,
                copies,
                f"{mode.name}: values returned by reset and step changed later, or step changed its actions",
            )
        found = trace_difference(subject.traces(mode), subject.traces(mode, tamper=True))
        assert found is None, (
            f"{mode.name}: overwriting returned arrays (or actions, after the step) changes later results: {found}; "
            "return copies and store copies"
        )


def _record(subject: Subject, env: VectorEnv, mode: AutoresetMode, seed: Any) -> list[Any]:
    """Copies of the results of a reset and the steps after it."""
    observations, infos = env.reset(seed=seed)
    start = deepcopy((observations, infos))
    return [start, *(deepcopy(result) for _, result in subject.play(env, mode))]


def _each(env: VectorEnv, observations: Any) -> list[Any]:
    return list(iterate(env.observation_space, observations))


def _rows(env: VectorEnv, records: Sequence[Any], rows: slice) -> list[Any]:
    """Observations, rewards and flags of some sub-environments."""
    return [(_each(env, record[0])[rows], [part[rows] for part in record[1:-1]]) for record in records]
