"""Frozen suites: worlds, levels, seeds, anchors of the score, and a digest of each world's behavior."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from servotrack.baselines.agents.learned.field_rules import Many, Number, Plain, Record, Text, Whole
from servotrack.baselines.board.sealed_seeds import derived_seeds, form_of
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.episodes import EpisodeRecorder
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.reporting.files import ResultsError, read_strict_yaml
from servotrack.baselines.worlds import ScoreAnchors, World, describe_environment, world_of_id
from servotrack.estimators.types import Array, Mask

FORMAT, FORMAT_VERSION = "servotrack-suite", 1
FOLDER = Path(__file__).parent / "suites"
MOST_EPISODES = 1000
"""Largest number of episodes of one part of a cell."""
MOST_FORMS = 16
"""Largest number of forms of the sealed episodes, one hexadecimal digit."""

LEAST_SHARE = 1e-3
"""Share of the error at score 1 that an episode counts at least. Part of every frozen suite: it must not change."""

_NAME = Text(40, r"[a-z0-9][a-z0-9.-]*", "a name of lower-case letters, digits, dots and hyphens")
_HEX = Text(64, "[0-9a-f]{64}", "64 hexadecimal digits")
_CELL = Record(
    {
        "env_id": Text(100, r"[\w.-]+", "an id of Gymnasium without a module"),
        "env_kwargs": Plain(20, Text(100, r"[A-Za-z_]\w*", "an identifier")),
        "public": Whole(1, MOST_EPISODES),
        "forms": Text(MOST_FORMS * MOST_EPISODES, "[0-9a-f]+", "one hexadecimal digit for each seed of the pool"),
        "anchors": Many(Number(0.0, 1e6), 2, 2),
        "behavior": _HEX,
        "resolution": Number(0.0, 1e6),
    },
    required=("env_id", "env_kwargs", "public", "forms", "anchors", "behavior"),
)
_SUITE = Record(
    {
        "format": Text(40, FORMAT),
        "format_version": Whole(FORMAT_VERSION, FORMAT_VERSION),
        "name": _NAME,
        "summary": Text(500),
        "grid": Whole(1, 32_767),
        "cells": Many(_CELL, 1, 100),
    },
    required=("format", "format_version", "name", "summary", "grid", "cells"),
)
_BEHAVIOR_SEEDS = (200_000, 2**40 + 1, 2**40 + 2)
_BEHAVIOR_DECIMALS = 6
"""Decimals of the numbers in a behavior digest. Mathematics libraries differ far behind them."""


@dataclass(frozen=True)
class SuiteCell:
    """One environment of a suite.

    Attributes:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        public: Number of episodes on public test seeds.
        forms: Form of each seed of the pool of sealed seeds, as one hexadecimal digit. All forms have as many seeds.
        anchors: Errors at which the score is 0 and 1, in the unit of the rows.
        behavior: Digest of the world's behavior when the suite was frozen; see `behavior_of`.
        resolution: Error that is added to all errors before their logarithm is taken. It keeps a bound of 0 finite; a
            larger one makes small errors count less.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    public: int
    forms: str
    anchors: tuple[float, float]
    behavior: str
    resolution: float = 0.0

    @property
    def name(self) -> str:
        """Id and arguments in one line."""
        return describe_environment(self.env_id, self.env_kwargs)

    @property
    def world(self) -> World:
        """Record of the kind of world."""
        return world_of_id(self.env_id)

    @property
    def ends(self) -> ScoreAnchors:
        """Error that is scored, and the agents whose errors are the anchors."""
        ends = self.world.suite_anchors
        assert ends is not None
        return ends

    @property
    def public_seeds(self) -> list[int]:
        """Public test seeds: the first ones of the range that `servotrack bench` reports on."""
        return seed_ranges.take("test", self.public)

    @property
    def form_count(self) -> int:
        """Number of forms."""
        return len(set(self.forms))

    @property
    def sealed(self) -> int:
        """Number of episodes on the sealed seeds of one form."""
        return len(self.forms) // self.form_count

    def is_stale(self) -> bool:
        """True if this package's world behaves differently from that of the frozen suite."""
        return _behavior(self.env_id, json.dumps(self.env_kwargs)) != self.behavior

    def scores(self, rows: Sequence[Mapping[str, Any]]) -> Array:
        """Scores of episodes: 0 at the error of an agent without skill, 1 at the bound or at an agent that knows more.

        The anchors are frozen with the suite, so that no submission moves another one's score.

        Args:
            rows: Rows of the cell.

        Returns:
            ln((e_0 + r) / (e + r)) / ln((e_0 + r) / (e_1 + r)) of each row, unclipped. Shape (len(rows),).
        """
        lower, upper = (end + self.resolution for end in self.anchors)
        errors = np.array([row[self.ends.column] for row in rows], dtype=np.float64) + self.resolution
        return np.log(lower / np.maximum(errors, LEAST_SHARE * upper)) / np.log(lower / upper)


@dataclass(frozen=True)
class Suite:
    """A frozen suite.

    Attributes:
        name: Name, part of the derivation of sealed and fresh seeds.
        summary: Description in one line.
        grid: Steps of the action grid from the middle of the action space to its bound.
        cells: Environments.
    """

    name: str
    summary: str
    grid: int
    cells: tuple[SuiteCell, ...]

    def cell(self, name: str) -> SuiteCell:
        """Return the cell of a name such as "UncalibServo-v0,level=3".

        Raises:
            ValueError: The suite has no such cell.
        """
        for cell in self.cells:
            if cell.name == name:
                return cell
        raise ValueError(
            f"suite {self.name} has no cell {name!r}; it has {', '.join(cell.name for cell in self.cells)}"
        )

    def pool(self, cell: SuiteCell) -> list[int]:
        """Return the seeds of all forms of a cell: `derived_seeds` of "suite/cell"."""
        return list(_pool(f"{self.name}/{cell.name}", len(cell.forms)))

    def sealed_seeds(self, cell: SuiteCell, digest: str) -> list[int]:
        """Return the sealed seeds of an agent in a cell: those of its form, in the order of the pool.

        Args:
            cell: The cell.
            digest: Digest of the agent; see `servotrack.baselines.board.sealed_seeds.agent_digest`.
        """
        own = f"{form_of(digest, self.name, cell.form_count):x}"
        return [seed for seed, form in zip(self.pool(cell), cell.forms, strict=True) if form == own]

    def fresh_seeds(self, cell: SuiteCell, digest: str, nonce: str, count: int) -> list[int]:
        """Return seeds that follow from the agent's files and a nonce, which is drawn after the submission.

        Args:
            cell: The cell.
            digest: Digest of the agent.
            nonce: Text that the verifier draws.
            count: Number of seeds.
        """
        return derived_seeds(f"{digest}/{self.name}/{nonce}/{cell.name}", count)


def suite_names() -> list[str]:
    """Names of the suites of this package."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_suite(name: str) -> Suite:
    """Load a suite.

    Args:
        name: Name of a suite of this package, or the path of a .yaml file.

    Raises:
        ResultsError: No such suite, or a file that is not one.
    """
    if name.endswith(".yaml"):
        return _read_suite(Path(name))
    if name not in suite_names():
        raise ResultsError(f"no suite is called {name!r}; known are {', '.join(suite_names())}")
    return _known_suite(name)


@lru_cache(maxsize=8)
def _known_suite(name: str) -> Suite:
    return _read_suite(FOLDER / f"{name}.yaml")


def _read_suite(path: Path) -> Suite:
    document = read_strict_yaml(path)
    try:
        _SUITE.check(document, "")
        cells = tuple(SuiteCell(**{**fields, "anchors": tuple(fields["anchors"])}) for fields in document["cells"])
        _check_cells(cells)
    except ValueError as error:
        raise ResultsError(f"{path} is not a suite ({error})") from error
    return Suite(document["name"], document["summary"], document["grid"], cells)


@lru_cache(maxsize=64)
def _pool(origin: str, count: int) -> tuple[int, ...]:
    return tuple(derived_seeds(origin, count))


def _check_cells(cells: Sequence[SuiteCell]) -> None:
    names = [cell.name for cell in cells]
    if len(set(names)) != len(names):
        raise ValueError("two cells are the same environment")
    # One digest chooses one form for all cells.
    known = [f"{form:x}" for form in range(cells[0].form_count)]
    for cell in cells:
        sizes = Counter(cell.forms)
        if sorted(sizes) != known or len(set(sizes.values())) != 1 or cell.sealed > MOST_EPISODES:
            raise ValueError(
                f"forms of {cell.name} must be {len(known)}, numbered from 0, with equally many seeds each, at most "
                f"{MOST_EPISODES}, got {dict(sorted(sizes.items()))}"
            )
        if cell.world.suite_anchors is None:
            raise ValueError(f"{cell.name} has no score")
        if not cell.anchors[1] < cell.anchors[0]:
            raise ValueError(f"anchors of {cell.name} must fall, got {cell.anchors}")
        if not cell.anchors[1] + cell.resolution > 0.0:
            raise ValueError(f"resolution of {cell.name} must be > 0 beside an anchor of 0, got {cell.resolution}")


@lru_cache(maxsize=64)
def _behavior(env_id: str, env_kwargs: str) -> str:
    return behavior_of(env_id, json.loads(env_kwargs))


def behavior_of(env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """Return the digest of a world's behavior: observations, rewards and rows of three episodes with fixed actions.

    Numbers are rounded to six decimals, so that the digest is the same on other processors. A digest that differs from
    that of a frozen suite means that the world, its noise or its scoring was changed, and that rows are stale.

    Args:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    env = make_vector(env_id, len(_BEHAVIOR_SEEDS), env_kwargs, privileged=False)
    try:
        space = env.single_action_space
        assert isinstance(space, spaces.Box)
        draws = np.random.Generator(np.random.Philox(key=2027))
        observation, _ = env.reset(seed=list(_BEHAVIOR_SEEDS))
        recorder = EpisodeRecorder(_BEHAVIOR_SEEDS, env, observation)
        running: Mask = np.ones(len(_BEHAVIOR_SEEDS), dtype=bool)
        while not recorder.finished:
            parts = observation if isinstance(observation, Mapping) else {"": observation}
            _add(digest, [parts[name][running] for name in sorted(parts)])
            shares = draws.uniform(-0.3, 0.3, (len(_BEHAVIOR_SEEDS), *space.shape))
            actions = ((space.high + space.low) / 2 + shares * (space.high - space.low) / 2).astype(space.dtype)
            observation, reward, terminated, truncated, info = env.step(actions)
            recorder.record(observation, reward, terminated | truncated, info)
            running = running & ~(terminated | truncated)
        _add(digest, [[float(value) for _, value in sorted(row.items())] for row in recorder.rows()])
    finally:
        env.close()
    return digest.hexdigest()


def _add(digest: Any, arrays: Sequence[Any]) -> None:
    for array in arrays:
        # Adding zero turns -0.0 into 0.0.
        rounded = np.round(np.asarray(array, dtype=np.float64), _BEHAVIOR_DECIMALS) + 0.0
        digest.update(np.ascontiguousarray(rounded, dtype="<f8").tobytes())
