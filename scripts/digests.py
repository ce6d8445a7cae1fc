"""Print a digest of every world and every classical agent as JSON: all bits of a few steps, on this Python.

    python scripts/digests.py [--only TEXT] [--start-method fork|spawn|forkserver]

`scripts/test --matrix` compares what several Pythons print. An agent has null if a package that it needs is missing.
Names under "pictures" are those whose observations are images, which OpenCV takes part in drawing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import locale
import multiprocessing
import platform
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import AGENTS, create_agent
from servotrack.baselines.evaluation.bench import _has_levels
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.worlds import kind_of_id
from servotrack.envs.registration import ENVIRONMENTS

SEEDS = (11, 12)
STEPS = 12
PACKAGES = {
    "NumPy": "numpy",
    "Numba": "numba",
    "SciPy": "scipy",
    "OpenCV": "opencv-python-headless",
    "pymunk": "pymunk",
}


def update(digest: Any, value: Any) -> None:
    """Add all bits of arrays, numbers and texts in nested containers to a digest."""
    if isinstance(value, Mapping):
        for key in sorted(value):
            digest.update(str(key).encode())
            update(digest, value[key])
    elif isinstance(value, (list, tuple)):
        for part in value:
            update(digest, part)
    elif isinstance(value, np.ndarray) and value.dtype != object:
        digest.update(f"{value.dtype.str}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, np.ndarray):
        update(digest, value.tolist())
    elif isinstance(value, (bool, int, float, complex, np.generic)):
        digest.update(np.asarray(value).tobytes())
    else:
        digest.update(repr(value).encode())


def world_digest(env_id: str, level: int | None) -> str:
    """Digest of everything that an environment returns to random actions."""
    digest = hashlib.sha256()
    with gym.make(env_id, **({} if level is None else {"level": level})) as env:
        rng = np.random.Generator(np.random.PCG64(SEEDS[0]))
        update(digest, env.reset(seed=SEEDS[0]))
        space: Any = env.action_space
        for _ in range(STEPS):
            # Products of exactly rounded operations, which are the same everywhere.
            action = space.low + rng.random(space.shape) * (space.high - space.low)
            update(digest, env.step(action.astype(space.dtype)))
    return digest.hexdigest()[:16]


def agent_digest(name: str, env_id: str) -> str | None:
    """Digest of the actions of an agent in two episodes side by side, None if a package that it needs is missing."""
    digest, card = hashlib.sha256(), AGENTS[name]
    env = make_vector(env_id, len(SEEDS), {}, privileged=card.privileged)
    try:
        try:
            agent = create_agent(card, env)
        except ImportError:
            return None
        observation, _ = env.reset(seed=list(SEEDS))
        state, starts = None, np.ones(len(SEEDS), np.bool_)
        for _ in range(STEPS):
            action, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
            update(digest, action)
            observation, *_ = env.step(action)
            starts = np.zeros(len(SEEDS), np.bool_)
    finally:
        env.close()
    return digest.hexdigest()[:16]


def levels_of(env_id: str) -> Sequence[int | None]:
    """All levels of an id, or None where it has no levels."""
    if not _has_levels(env_id):
        return [None]
    found: list[int | None] = []
    for level in range(20):
        try:
            gym.make(env_id, level=level).close()
        except ValueError:
            break
        found.append(level)
    return found


def has_pictures(env_id: str) -> bool:
    """Return True if an observation of an id is or holds an image."""
    with gym.make(env_id) as env:
        space: Any = env.observation_space
        parts = space.values() if isinstance(space, gym.spaces.Dict) else [space]
        return any(part.dtype == np.uint8 and len(part.shape or ()) == 3 for part in parts)


def digests(only: str) -> dict[str, str | None]:
    """Digests of all worlds and classical agents whose line contains a text."""
    found: dict[str, str | None] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for env_id in ENVIRONMENTS:
            for level in levels_of(env_id):
                name = env_id if level is None else f"{env_id} level={level}"
                if only in name:
                    found[name] = world_digest(env_id, level)
            for agent, card in AGENTS.items():
                name = f"{agent} in {env_id}"
                if kind_of_id(env_id) not in card.worlds or card.trained_in is not None or only not in name:
                    continue
                found[name] = agent_digest(agent, env_id)
    return found


def main() -> None:
    """Print the digests, computed in a child process if a start method is given."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="only worlds and agents whose line contains this text")
    parser.add_argument("--start-method", choices=("fork", "spawn", "forkserver"))
    arguments = parser.parse_args()
    # Numbers must not be read or written in the user's way.
    locale.setlocale(locale.LC_ALL, "")
    if arguments.start_method is None:
        found = digests(arguments.only)
    else:
        with multiprocessing.get_context(arguments.start_method).Pool(1) as pool:
            found = pool.apply(digests, (arguments.only,))
    versions = {"Python": platform.python_version()} | {name: version(package) for name, package in PACKAGES.items()}
    pictures = [name for name in found if has_pictures(name.split(" in ")[-1].split()[0])]
    print(json.dumps({"versions": versions, "digests": found, "pictures": pictures}, indent=1))


if __name__ == "__main__":
    main()
