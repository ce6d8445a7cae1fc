"""Observers by name for every world whose targets are points in clutter or people on video."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotrack.baselines.agents.clutter.observers import create_clutter_observer
from servotrack.baselines.agents.people.observers import create_video_observer
from servotrack.baselines.agents.protocol import Agent
from servotrack.baselines.worlds import public_attribute
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.envs.track.people.camera_model import VideoModel
from servotrack.estimators.rfs.extraction import Rule


def create_observer(
    env: Any,
    estimator: str,
    hidden_markov: bool = False,
    extraction: Rule = "threshold",
    values: Mapping[str, float] | None = None,
) -> Agent:
    """Create the observer of a name; the type of `env.unwrapped.scene_model` decides which kind.

    Args:
        env: A tracking environment or vector environment; only its spaces and its `scene_model` are read.
        estimator: A name of `agents.clutter.catalog.TRACK_FILTERS`, or "association-oracle"; for people on video
            a name that `create_video_observer` takes.
        hidden_markov: True ignores the dependence between motion and measurement noise (points in clutter only).
        extraction: Rule that extracts targets from the posterior: "threshold", "sum" or "map" (points in clutter only).
        values: Numbers of the estimator that differ from its defaults, by path.

    Raises:
        ValueError: An environment without a `SceneModel` or `VideoModel`, or an unknown estimator.
    """
    scene = public_attribute(env, "scene_model")
    if isinstance(scene, VideoModel):
        return create_video_observer(env, estimator, values=values)
    if not isinstance(scene, SceneModel):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {estimator!r} needs an environment whose `unwrapped.scene_model` is a SceneModel; "
            f"{name} has none (is it wrapped in a SyncVectorEnv?)"
        )
    space = getattr(env, "single_action_space", env.action_space)
    return create_clutter_observer(space, scene, estimator, hidden_markov, extraction, values)
