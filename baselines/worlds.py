"""Kinds of worlds: one record per kind holds everything that follows from it.

An environment declares its kind as `metadata["servotrack_kind"]`, which reaches through wrappers and vector
environments. Nothing else in the package compares ids or looks for keys in `info`. To add a world, add a record here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

KIND_KEY = "servotrack_kind"
"""Entry of an environment's `metadata` that names its kind."""

RANDOM_AGENT = "random"
"""Agent of uniform actions: it can act in every world."""

OTHER = "other"
"""Kind of every environment that declares none: only returns, lengths and successes are recorded."""


@dataclass(frozen=True)
class RankingMetric:
    """One number of an episode, as tables show it.

    Attributes:
        column: Key in the rows of results.
        heading: Heading in tables.
        unit: Unit in tables, "" for none.
        factor: Factor from the unit of the rows to that of the tables.
        digits: Digits behind the point.
        high_is_good: True if larger is better.
    """

    column: str
    heading: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 2
    high_is_good: bool = False

    @property
    def title(self) -> str:
        """Heading and unit."""
        return f"{self.heading} {self.unit}".strip()


@dataclass(frozen=True)
class ScoreAnchors:
    """Errors between which an error is scaled to a score: 0 is the error of `lower`, 1 a bound or the error of `upper`.

    Attributes:
        column: Error in the rows of results; smaller is better.
        lower: Agent without skill.
        upper: Agent that knows the system. Its error is the score 1 where no `EpisodeBound` of the column exists.
        upper_knows: Knowledge of `upper`, for captions.
        bound: Agent whose mean error the column "x bound" divides by; None where an `EpisodeBound` is divided by.
        resolution: Error that is added to all errors before their logarithm is taken, in the column's unit. It keeps a
            bound of zero finite; raising it weakens differences between small errors.
        least_share: Share of the smallest error of `upper`'s episodes that an episode counts at least. Its logarithm
            would let a single tiny error carry the mean of all episodes; raising it weakens single episodes.
    """

    column: str
    lower: str
    upper: str
    upper_knows: str
    bound: str | None = None
    resolution: float = 0.0
    least_share: float = 1e-3


@dataclass(frozen=True)
class EpisodeBound:
    """A number of every episode that no agent can go below on average unless it sees the truth.

    Attributes:
        env_id: Id of its environment.
        column: Column in the rows of results that it bounds.
        heading: Name of the column in captions.
        values: "module:callable" called with the environment's arguments and seeds; returns a list of floats.
        meaning: Knowledge of the agent of the bound, for captions.
        episodes: Largest number of an agent's episodes that the column "x bound" is taken over. Raising it takes time.
    """

    env_id: str
    column: str
    heading: str
    values: str
    meaning: str
    episodes: int = 100


@dataclass(frozen=True)
class World:
    """Everything that follows from a kind of world.

    Attributes:
        kind: Value of `metadata["servotrack_kind"]`.
        summary: One line for people.
        ids: Ids of this package. Ids that users register need no entry here.
        headline: Metric that ranks agents and of which paired differences are taken.
        reference: Agent that differences are taken against.
        recorder: "module:callable" of the score recorder, called with (rows, observation, max_steps).
        cards: "module:attribute" of the kind's agent cards.
        metrics: Metrics shown before the headline.
        anchors: Agents that scale errors to scores; None where tables have no score.
        frozen_anchors: The same for frozen suites, which have a score in every world; None: `anchors`.
        bounds: Bounds of the column "x bound", at most one for an id. One of the anchors' column is the score 1.
        ranges: Lowest and highest possible value of columns in the rows of results; results outside are refused.
    """

    kind: str
    summary: str
    ids: tuple[str, ...]
    headline: RankingMetric
    reference: str
    recorder: str | None = None
    cards: str | None = None
    metrics: tuple[RankingMetric, ...] = ()
    anchors: ScoreAnchors | None = None
    frozen_anchors: ScoreAnchors | None = None
    bounds: tuple[EpisodeBound, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def shown(self) -> tuple[RankingMetric, ...]:
        """All metrics in the order of the table's columns."""
        return (*self.metrics, self.headline)

    @property
    def suite_anchors(self) -> ScoreAnchors | None:
        """Anchors of the score in frozen suites; None where no suite can have the world."""
        return self.frozen_anchors or self.anchors

    def bound_of(self, env_id: str) -> EpisodeBound | None:
        """Return the bound of an id's episodes, None without one."""
        return next((bound for bound in self.bounds if bound.env_id == env_id), None)

    def load_recorder(self) -> Callable[..., Any] | None:
        """Return the score recorder's factory, None where returns and successes are all there is."""
        return None if self.recorder is None else load(self.recorder)


_RECORDERS = "servotrack.baselines.evaluation"
_AGENTS = "servotrack.baselines.agents"
_RIGHT_COUNT = RankingMetric("count_right", "count right", "%", 100.0, 0, True)
_SHARE, _SIZE = (0.0, 1.0), (0.0, 1e9)
_DISTANCE = (1e-15, 1e9)
"""m. Positions near 1 m are rounded to 1e-16 m, so that a smaller mean distance cannot be a measured one."""
_SET_RANGES = {
    **dict.fromkeys(("ospa", "gospa", "ospa2", "count_error"), _SIZE),
    **dict.fromkeys(("count_right", "idf1", "hota"), _SHARE),
    "mota": (-math.inf, 1.0),
}

WORLDS: Mapping[str, World] = {
    world.kind: world
    for world in (
        World(
            "servo",
            "a robot arm moves its camera over a target",
            ("UncalibServo-v0", "UncalibServoReach-v0", "UncalibServoPixels-v0"),
            RankingMetric("steady", "steady", "mm", 1e3, 1),
            "ukf",
            f"{_RECORDERS}.servo_scores:ServoScoreRecorder",
            f"{_AGENTS}.servo.cards:CARDS",
            anchors=ScoreAnchors("steady", "random", "oracle", "analytic Jacobian", resolution=1e-4),
            bounds=tuple(
                EpisodeBound(
                    env_id,
                    "steady",
                    "steady error",
                    f"servotrack.baselines.leaderboard.servo_bound:{values}",
                    "a controller that knows camera, arm, noise and the law of the target, but not the future",
                    episodes=200,
                )
                for env_id, values in (
                    ("UncalibServo-v0", "episode_bounds"),
                    ("UncalibServoReach-v0", "reach_bounds"),
                )
            ),
            ranges={
                **dict.fromkeys(("transient", "p95", "feature_error"), _SIZE),
                "steady": _DISTANCE,
            },
        ),
        World(
            "clutter",
            "points in clutter, drawn or recorded",
            ("ClutterTracking-v0", "RecordedPoints-v0"),
            RankingMetric("ospa2", "OSPA(2)", "m"),
            "gm-phd",
            f"{_RECORDERS}.set_scores:SetScoreRecorder",
            f"{_AGENTS}.clutter.cards:CARDS",
            (RankingMetric("ospa", "OSPA", "m"),),
            frozen_anchors=ScoreAnchors("ospa2", "random", "association-oracle", "known data association"),
            bounds=(
                EpisodeBound(
                    "ClutterTracking-v0",
                    "ospa",
                    "OSPA",
                    "servotrack.baselines.leaderboard.clutter_bound:episode_bounds",
                    "an agent that knows the motion, who exists and which measurement is whose",
                ),
            ),
            ranges=_SET_RANGES,
        ),
        World(
            "people",
            "boxes of people in rendered or recorded frames",
            ("PedestrianTracking-v0", "VideoTracking-v0"),
            RankingMetric("ospa2", "OSPA(2)", digits=3),
            "gm-phd",
            f"{_RECORDERS}.set_scores:SetScoreRecorder",
            f"{_AGENTS}.people.cards:CARDS",
            (
                _RIGHT_COUNT,
                RankingMetric("mota", "MOTA", high_is_good=True),
                RankingMetric("idf1", "IDF1", high_is_good=True),
                RankingMetric("hota", "HOTA", high_is_good=True),
                RankingMetric("ospa", "OSPA", digits=3),
            ),
            ranges=_SET_RANGES,
        ),
        World(
            "color",
            "the box of one colored object",
            ("ColorTracking-v0",),
            RankingMetric("auc", "AUC", digits=3, high_is_good=True),
            "monte-carlo-color",
            f"{_RECORDERS}.box_scores:BoxScoreRecorder",
            f"{_AGENTS}.color.cards:CARDS",
            (
                RankingMetric("precision", "within 20 px", "%", 100.0, 0, True),
                RankingMetric("failures", "times lost", digits=1),
            ),
            ranges={**dict.fromkeys(("iou", "auc", "precision"), _SHARE), "failures": _SIZE},
        ),
        World(
            "sonar",
            "bearings in a bearing-time record",
            ("SonarTracking-v0",),
            RankingMetric("ospa2", "OSPA(2)", "deg"),
            "hmm-cell",
            f"{_RECORDERS}.set_scores:SetScoreRecorder",
            f"{_AGENTS}.sonar.cards:CARDS",
            (_RIGHT_COUNT, RankingMetric("ospa", "OSPA", "deg")),
            bounds=(
                EpisodeBound(
                    "SonarTracking-v0",
                    "ospa",
                    "OSPA",
                    "servotrack.baselines.leaderboard.sonar_bound:episode_bounds",
                    "an agent that knows who exists and what each target sounds like",
                ),
            ),
            ranges=_SET_RANGES,
        ),
        World(
            "follow",
            "a robot arm follows one person of a crowd",
            ("PedestrianServo-v0",),
            RankingMetric("time_on_target", "within 10 cm", "% of time", 100.0, 1, True),
            "nearest-servo",
            f"{_RECORDERS}.follow_scores:FollowScoreRecorder",
            f"{_AGENTS}.follow.cards:CARDS",
            (
                RankingMetric("identity_error", "at another person", "% of time", 100.0, 1),
                RankingMetric("losses", "times lost", digits=2),
                RankingMetric("reacquisitions", "times found again", digits=2, high_is_good=True),
            ),
            ranges={
                **dict.fromkeys(("time_on_target", "identity_error"), _SHARE),
                **dict.fromkeys(("losses", "reacquisitions"), _SIZE),
            },
        ),
        World(
            "servo3d",
            "a serial arm brings a board of points to its goal in the image",
            ("UncalibServo3D-v0",),
            RankingMetric("hold", "hold", "x bounds", digits=2),
            "ibvs",
            f"{_RECORDERS}.servo3d_scores:Servo3DScoreRecorder",
            f"{_AGENTS}.servo3d.cards:CARDS",
            (
                RankingMetric("settle", "settled after", "s", digits=1),
                RankingMetric("tip", "tip", "mm", 1e3, 2),
            ),
            anchors=ScoreAnchors("hold", "random", "joint-oracle", "joint angles of the goal", "joint-oracle"),
            ranges=dict.fromkeys(("settle", "hold", "tip", "feature_error"), _SIZE),
        ),
        World(
            OTHER,
            "environments that declare no kind",
            (),
            RankingMetric("return", "return", digits=2, high_is_good=True),
            "random",
        ),
    )
}
"""Records by kind."""

_KIND_OF_ID = {env_id: world.kind for world in WORLDS.values() for env_id in world.ids}


def kind_of(env: Any) -> str:
    """Kind that an environment declares.

    Args:
        env: A Gymnasium environment or vector environment, wrapped or not, or an environment class.

    Raises:
        ValueError: A kind without a record in `WORLDS`.
    """
    kind = (getattr(env, "metadata", None) or {}).get(KIND_KEY, OTHER)
    if kind not in WORLDS:
        raise ValueError(f"metadata[{KIND_KEY!r}] must be one of {', '.join(WORLDS)}, got {kind!r}")
    return kind


def public_attribute(env: Any, name: str) -> Any:
    """Value of an environment's public attribute, None where it has none.

    Args:
        env: A Gymnasium environment or vector environment, wrapped or not. Of Gymnasium's own vector
            environments, the first sub-environment is read.
        name: Name of the attribute, such as "scene_model" or "max_joint_rate".
    """
    inner = env.unwrapped
    if hasattr(inner, name) or not isinstance(inner, (SyncVectorEnv, AsyncVectorEnv)):
        return getattr(inner, name, None)
    try:
        return inner.get_attr(name)[0]
    except AttributeError:
        return None


def kind_of_id(env_id: str) -> str:
    """Kind of a Gymnasium id; "other" for ids that are not registered in this process.

    Args:
        env_id: An id such as "ClutterTracking-v0", with "module:" before it or not.

    Raises:
        ValueError: A kind without a record in `WORLDS`.
    """
    if (bare := env_id.rpartition(":")[2]) in _KIND_OF_ID:
        # The package's own ids need no import of their environments.
        return _KIND_OF_ID[bare]
    try:
        spec = gym.spec(env_id)
    except gym.error.Error:
        return OTHER
    entry = spec.entry_point
    creator: Any = gym.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry
    if isinstance(creator, type):
        return kind_of(creator)
    env = gym.make(env_id)
    try:
        return kind_of(env)
    finally:
        env.close()


def world_of_id(env_id: str) -> World:
    """Record of a Gymnasium id's kind; see `kind_of_id`."""
    return WORLDS[kind_of_id(env_id)]


def load(path: str) -> Any:
    """Import "module:attribute"."""
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def plain(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments as a results file gives them back, tuples as lists.

    Raises:
        ValueError: An argument that JSON cannot hold.
    """
    try:
        return json.loads(json.dumps(dict(env_kwargs)))
    except TypeError as error:
        raise ValueError(
            f"env_kwargs must be numbers, texts, and lists of them, got {env_kwargs!r} ({error})"
        ) from error


def describe_environment(env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """Id and arguments in one line, for titles and folder names."""
    arguments = plain(env_kwargs)
    return ",".join([env_id, *(f"{key}={arguments[key]}" for key in sorted(arguments))])
