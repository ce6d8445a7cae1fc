"""Episodes of vector environments as Minari datasets, for offline reinforcement learning and imitation.

Minari's own `DataCollector` wraps a single environment. Here all seeds of a batch run side by side.
"""

from __future__ import annotations

import operator
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.protocol import Agent, AgentCard
from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.worlds import describe_environment, plain
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.types import Array, Mask

if TYPE_CHECKING:
    from minari import MinariDataset


def collect_dataset(
    dataset_id: str,
    env_id: str,
    agent: str | AgentCard,
    seeds: Sequence[int],
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    num_envs: int = 64,
    info_keys: Collection[str] = (),
    **fields: Any,
) -> MinariDataset:
    """Run one episode per seed and store all of them as a local Minari dataset.

    Every seed's episode is complete and equals, to the bit, the one of a single environment with that seed, whatever
    `num_envs` is. No episode is left out, so short ones are not preferred.

    Args:
        dataset_id: Minari's name of the dataset, such as `servo/kf-v0`.
        env_id: Gymnasium id.
        agent: Agent that acts: a registered name, "name+law", "module:callable", or a card. Agents that see the truth
            act on it; the dataset holds the observations without it.
        seeds: Environment seeds, all different.
        env_kwargs: Arguments of the environment, as plain values. They are stored, so `recover_environment` makes the
            same environment.
        num_envs: Number of episodes that run side by side. Larger values are faster and take more memory: a batch is
            written when its last episode ends.
        info_keys: Names of infos to store, such as `tracking_error`. Only infos with one array for all rows.
        **fields: Further arguments of `minari.create_dataset_from_buffers`, such as `author` or `data_format`.

    Returns:
        The dataset. `minari.load_dataset(dataset_id)` loads it again.

    Raises:
        ImportError: Minari is not installed.
        TypeError: A seed is not an integer.
        ValueError: No or repeated seeds, `num_envs` below 1, an unknown agent or info, or an existing dataset.
    """
    try:
        import minari
    except ImportError as error:
        raise ImportError("Minari is not installed; run `pip install servotrack[minari]`") from error
    seeds = [operator.index(seed) for seed in seeds]
    if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise ValueError(f"seeds must be different whole numbers >= 0, at least one, got {seeds[:10]}")
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    kwargs = plain(dict(env_kwargs or {}))
    card = agent if isinstance(agent, AgentCard) else agent_card(agent)
    env = gym.make(env_id, **kwargs)
    dataset = None
    try:
        for start in range(0, len(seeds), num_envs):
            episodes = [
                minari.data_collector.EpisodeBuffer(**episode)
                for episode in _batch(env_id, card, seeds[start : start + num_envs], kwargs, info_keys)
            ]
            if dataset is None:
                named = {
                    "algorithm_name": card.name,
                    "description": f"{card.name} ({card.summary}) in {describe_environment(env_id, kwargs)}",
                    "eval_env": env.spec,
                    **fields,
                }
                dataset = minari.create_dataset_from_buffers(dataset_id, episodes, env=env, **named)
            else:
                dataset.storage.update_episodes(episodes)
    except BaseException:
        # A dataset of the first batches would look complete.
        if dataset is not None:
            minari.delete_dataset(dataset_id)
        raise
    finally:
        env.close()
    return minari.load_dataset(dataset_id)


def _batch(
    env_id: str, card: AgentCard, seeds: Sequence[int], env_kwargs: Mapping[str, Any], info_keys: Collection[str]
) -> Iterator[dict[str, Any]]:
    """Run one episode per seed side by side, and yield the fields of their `EpisodeBuffer`, in that order."""
    env = make_vector(env_id, len(seeds), env_kwargs, privileged=card.privileged)
    own = env.env.single_observation_space if card.privileged else env.single_observation_space
    try:
        agent: Agent = create_agent(card, env)
        seen, info = env.reset(seed=list(seeds))
        observations, infos = [_own(seen, own)], [_chosen(info, info_keys)]
        steps: list[tuple[NDArray[Any], Array, Mask, Mask]] = []
        lengths = np.zeros(len(seeds), np.int64)
        state: Any = None
        starts: Mask = np.ones(len(seeds), np.bool_)
        while not lengths.all():
            action, state = agent.predict(seen, state=state, episode_start=starts, deterministic=True)
            seen, reward, terminated, truncated, info = env.step(action)
            # In Gymnasium's next-step mode the step after an end only resets: its observation starts the next episode.
            starts = terminated | truncated
            steps.append((np.array(action), reward, terminated, truncated))
            observations.append(_own(seen, own))
            infos.append(_chosen(info, info_keys))
            lengths[starts & (lengths == 0)] = len(steps)
    finally:
        env.close()
    for row, (seed, length) in enumerate(zip(seeds, lengths.tolist(), strict=True)):
        actions, rewards, terminations, truncations = (
            np.stack([step[part][row] for step in steps[:length]]) for part in range(4)
        )
        yield {
            "seed": seed,
            "observations": _column(observations[: length + 1], row),
            "actions": actions,
            "rewards": rewards,
            "terminations": terminations,
            "truncations": truncations,
            "infos": _column(infos[: length + 1], row) if info_keys else None,
        }


def _own(observation: Any, space: gym.Space[Any]) -> Any:
    """Return an observation without the truth that a privileged agent sees."""
    if isinstance(space, gym.spaces.Dict):
        return {key: observation[key] for key in space.spaces}
    return observation[OBSERVATION_KEY] if isinstance(observation, dict) else observation


def _chosen(info: Mapping[str, Any], keys: Collection[str]) -> dict[str, NDArray[Any]]:
    for key in keys:
        if not isinstance(info.get(key), np.ndarray) or info[key].dtype == object:
            arrays = sorted(name for name, value in info.items() if isinstance(value, np.ndarray) and name[0] != "_")
            raise ValueError(f"info_keys must name infos that are arrays, {', '.join(arrays)}, got {key!r}")
    return {key: info[key] for key in keys}


def _column(values: Sequence[Any], row: int) -> Any:
    """Return one row of every time step, stacked; of a dictionary, one array for each of its keys."""
    if isinstance(values[0], dict):
        return {key: np.stack([value[key][row] for value in values]) for key in values[0]}
    return np.stack([value[row] for value in values])
