"""Observers of points in clutter, made from an agent's name and the environment's `SceneModel`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from servotrack.baselines.agents.clutter.association_oracle import AssociationOracle
from servotrack.baselines.agents.clutter.catalog import (
    ROBUST_SMOOTHER,
    SMOOTHER,
    TrackFilter,
    observer_settings,
    track_filter,
)
from servotrack.baselines.agents.delayed import DelayedAgent
from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.set_observer import RawObserver, SetObserver
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.estimators.rfs import RawMeasurements
from servotrack.estimators.rfs.extraction import Rule


def create_clutter_observer(
    space: Any,
    scene: SceneModel,
    estimator: str,
    hidden_markov: bool = False,
    extraction: Rule = "threshold",
    values: Mapping[str, float] | None = None,
) -> SetObserver | RawObserver | DelayedAgent:
    """Create an observer of points in clutter. With a lag in the scene, filters without a smoother answer later.

    Args:
        space: Action space of one scene.
        scene: Parameters of the scene that agents receive.
        estimator: A name of `agents.clutter.catalog.TRACK_FILTERS`, or "association-oracle".
        hidden_markov: True ignores the dependence between motion and measurement noise.
        extraction: Rule that extracts targets from the posterior: "threshold", "sum" or "map".
        values: Numbers of the estimator that differ from its defaults, by path; see `with_values`.

    Raises:
        ValueError: An unknown estimator, or values that do not fit it.
    """
    observer = _undelayed(space, scene, estimator, hidden_markov, extraction, values or {})
    return DelayedAgent(observer, scene.lag) if scene.lag and estimator not in (SMOOTHER, ROBUST_SMOOTHER) else observer


def _undelayed(
    space: Any,
    scene: SceneModel,
    estimator: str,
    hidden_markov: bool,
    extraction: Rule,
    values: Mapping[str, float],
) -> SetObserver | RawObserver:
    rows = space.shape[0]
    if estimator == "association-oracle":
        return SetObserver(AssociationOracle(scene.model, scene.birth_covariance), rows, space.low, space.high)
    settings = replace(observer_settings(rows), hidden_markov=hidden_markov, extraction=extraction)
    made: TrackFilter = with_values(track_filter(estimator, scene, settings), values)
    if isinstance(made, RawMeasurements):
        return RawObserver(made, space.low, space.high)
    return SetObserver(made, rows, space.low, space.high)
