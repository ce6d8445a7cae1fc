"""Evaluation of an agent: one episode per seed. The agent gets observations only."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.baselines.agents.protocol import Agent, AgentCard
from servotrack.baselines.agents.random import RandomAgent
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation.episodes import EpisodeRecorder
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder, Row
from servotrack.baselines.worlds import describe_environment, kind_of_id, plain
from servotrack.estimators.types import Mask

CHUNK = 100
FOREIGN_CHUNK = 10
TIMED_STEPS = 150
UNTIMED_STEPS = 10


def evaluate(
    env_id: str,
    agent: str | AgentCard,
    seeds: Sequence[int],
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    folder: ResultsFolder | None = None,
    chunk: int | None = None,
    timing: bool = True,
    on_episodes: Callable[[int], None] | None = None,
    record: dict[str, Any] | None = None,
) -> CellResults:
    """One episode per seed; resumes what `folder` already holds and saves after every chunk.

    Args:
        env_id: Any Gymnasium id; those without a vector environment of their own run side by side as single ones.
        agent: A registered name, "name+law", "module:callable", or a card.
        seeds: Environment seeds, all different; see `servotrack.baselines.evaluation.seeds`.
        env_kwargs: Arguments of the environment.
        folder: Results folder to resume from and save to. None keeps everything in memory.
        chunk: Episodes that run side by side.
        timing: True to measure the compute time per step, in a separate pass, unbatched.
        on_episodes: Called with the number of episodes that were just finished (or found finished).
        record: Provenance to write down; None for that of this process.

    Returns:
        The cell with all rows it holds, those of other seeds included.

    Raises:
        ValueError: Repeated or no seeds, an unknown agent.
        ResultsError: `folder` cannot be used.
    """
    kwargs = dict(env_kwargs or {})
    seeds = [int(seed) for seed in seeds]
    if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise ValueError(f"seeds must be different whole numbers >= 0, at least one, got {seeds[:10]}")
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk must be at least 1, got {chunk}")
    card = agent if isinstance(agent, AgentCard) else agent_card(agent)
    kind = kind_of_id(env_id)
    cell = (folder.load(env_id, kwargs, card.name) if folder else None) or CellResults(
        env_id,
        plain(kwargs),
        card.name,
        card.as_record(kind, describe_environment(env_id, kwargs)),
        provenance=dict(record or provenance()),
        kind=kind,
    )
    done = set(cell.seeds)
    todo = [seed for seed in seeds if seed not in done]
    report = on_episodes or (lambda count: None)
    report(len(seeds) - len(todo))
    chunk = chunk or (CHUNK if _takes_seed_lists(env_id) else FOREIGN_CHUNK)
    for start in range(0, len(todo), chunk):
        batch = todo[start : start + chunk]
        rows, cell.max_steps = run_episodes(
            env_id, card, batch, kwargs, lambda engine: cell.provenance.update(engine=engine)
        )
        cell.rows.extend(rows)
        if folder:
            folder.save(cell)
        report(len(batch))
    if timing and not cell.step_seconds:
        cell.step_seconds = time_steps(env_id, card, kwargs, seeds[0])
        if folder:
            folder.save(cell)
    return cell


def make_vector(env_id: str, count: int, env_kwargs: Mapping[str, Any], *, privileged: bool) -> Any:
    """The vector environment that agents are evaluated in, for a privileged one with the truth added."""
    mode = "vector_entry_point" if _takes_seed_lists(env_id) else "sync"
    env = gym.make_vec(env_id, num_envs=count, vectorization_mode=mode, **env_kwargs)
    if not privileged:
        return env
    from servotrack.envs.wrappers import VectorPrivilegedObservation

    return VectorPrivilegedObservation(env)


def _takes_seed_lists(env_id: str) -> bool:
    """Return True if the id has a vector environment with one seed per row; Gymnasium's own take a single seed."""
    return str(gym.spec(env_id).vector_entry_point).startswith("servotrack.")


def make_single(env_id: str, env_kwargs: Mapping[str, Any], *, privileged: bool = False) -> Any:
    """One environment for an agent to act in alone, for a privileged one with the truth added."""
    env: Any = gym.make(env_id, **env_kwargs)
    if not privileged:
        return env
    from servotrack.envs.wrappers import PrivilegedObservation

    return PrivilegedObservation(env)


def show_belief(env: Any, state: Any) -> None:
    """Draw the believed target position of an agent, where the environment and the agent both support it.

    Args:
        env: One environment; those with an attribute `belief` draw it.
        state: State from the agent's `predict`. A `belief` in it has a leading axis of one.
    """
    belief = getattr(state, "belief", None)
    if belief is not None and hasattr(env.unwrapped, "belief"):
        env.unwrapped.belief = belief[0]


def run_episodes(
    env_id: str,
    card: AgentCard,
    seeds: Sequence[int],
    env_kwargs: Mapping[str, Any],
    on_engine: Callable[[str], None] = lambda engine: None,
) -> tuple[list[Row], int | None]:
    """One episode per seed, side by side.

    Args:
        env_id: Gymnasium id.
        card: Agent.
        seeds: Environment seeds.
        env_kwargs: Arguments of the environment.
        on_engine: Called with the name of the physics engine, where the environment has a choice of engines.

    Returns:
        One row per seed in their order, and the steps of a full episode (None where the environment sets no limit).
    """
    env = make_vector(env_id, len(seeds), env_kwargs, privileged=card.privileged)
    try:
        if isinstance(engine := getattr(env.unwrapped, "engine", None), str):
            on_engine(engine)
        agent: Agent = create_agent(card, env)
        if isinstance(agent, RandomAgent):
            # A row's actions must not depend on the chunk that it is in: chunks change with the number of episodes.
            agent.rows = np.array(seeds) % (CHUNK if _takes_seed_lists(env_id) else FOREIGN_CHUNK)
        observation, _ = env.reset(seed=list(seeds))
        recorder = EpisodeRecorder(seeds, env, observation)
        state: Any = None
        starts: Mask = np.ones(len(seeds), dtype=bool)
        while not recorder.finished:
            action, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            # In Gymnasium's next-step mode the step after an end only resets: its observation starts the next episode.
            starts = recorder.ended
            recorder.record(observation, reward, terminated | truncated, info)
        return recorder.rows(), recorder.max_steps
    finally:
        env.close()


def time_steps(env_id: str, card: AgentCard, env_kwargs: Mapping[str, Any], seed: int) -> list[float]:
    """Durations of single unbatched `predict` calls, s, without the first ones, which may compile or fill caches."""
    env = make_single(env_id, env_kwargs, privileged=card.privileged)
    try:
        agent = create_agent(card, env)
        observation, _ = env.reset(seed=seed)
        state: Any = None
        start, durations = True, []
        for _ in range(UNTIMED_STEPS + TIMED_STEPS):
            begin = time.perf_counter()
            action, state = agent.predict(observation, state=state, episode_start=np.asarray(start), deterministic=True)
            durations.append(time.perf_counter() - begin)
            observation, _, terminated, truncated, _ = env.step(action)
            start = terminated or truncated
            if start:
                observation, _ = env.reset()
        return durations[UNTIMED_STEPS:]
    finally:
        env.close()
