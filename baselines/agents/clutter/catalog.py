"""Set estimators by observer name, created from the environment's `SceneModel`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias, TypeVar

import numpy as np

from servotrack.envs.track.clutter.scene_model import Model, SceneModel
from servotrack.estimators.rfs import (
    GMCPHD,
    GMPHD,
    PMB,
    PMBM,
    Birth,
    Births,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    InteractingModels,
    MeasurementBirth,
    ParticlePHD,
    RawMeasurements,
    Reduction,
    RegionSurvival,
    RobustPMB,
    RobustTrajectoryPMB,
    TrajectoryPMB,
    maneuvers,
)
from servotrack.estimators.rfs.extraction import Rule
from servotrack.estimators.rfs.steered import CountingPHD, SteadyPHD, SteeredPHD
from servotrack.estimators.types import Array

GaussianT = TypeVar("GaussianT", GMPHD, GMCBMeMBer, PMB, PMBM, TrajectoryPMB)

TrackFilter: TypeAlias = (
    GMPHD
    | GMCPHD
    | GMCBMeMBer
    | PMB
    | PMBM
    | RobustPMB
    | RobustTrajectoryPMB
    | TrajectoryPMB
    | ParticlePHD
    | GlobalNearestNeighbor
    | RawMeasurements
    | SteadyPHD
    | CountingPHD
)

SMOOTHER, ROBUST_SMOOTHER = "trajectory-pmb", "robust-trajectory-pmb"
"""Observers that report the scan that the scene's lag asks for; the others report the newest one."""

SMALLEST_CAPACITY = 100
"""Capacity of a filter (see `FilterSettings`) if three times the rows of an answer are fewer."""


TURN_RATE, MOST_TURN = 0.15, 0.5
"""Rate of the turns of `robust-pmb`, rad/s, and the largest turn within one period, rad."""

ELSEWHERE = 0.35
"""Births of `robust-pmb` at unexplained measurements, as a share of those that the scene model expects at its sites."""


SMOOTHED_AGILITY = 1.5
"""Factor on the standard deviation of the process noise of `robust-trajectory-pmb`, whose smoother has one motion."""


@dataclass(frozen=True)
class FilterSettings:
    """Settings of a filter that do not follow from the scene.

    Attributes:
        hidden_markov: True ignores the dependence between motion and measurement noise.
        extraction: Rule that extracts targets from the posterior: "threshold", "sum" or "map".
        capacity: Largest number of components of a PHD, or of tracks of a multi-Bernoulli filter.
    """

    hidden_markov: bool = False
    extraction: Rule = "threshold"
    capacity: int = SMALLEST_CAPACITY


def observer_settings(rows: int) -> FilterSettings:
    """Return the settings of an observer whose answers have `rows` rows."""
    return FilterSettings(capacity=max(SMALLEST_CAPACITY, 3 * rows))


def track_filter(name: str, scene: SceneModel, settings: FilterSettings | None = None) -> TrackFilter:
    """Create a set estimator for a scene.

    Args:
        name: One of `TRACK_FILTERS`.
        scene: Parameters of the scene that agents receive.
        settings: Settings that do not follow from the scene.

    Raises:
        ValueError: An unknown name.
    """
    if name not in TRACK_FILTERS:
        raise ValueError(f"no tracking filter is called {name!r}; known are {', '.join(TRACK_FILTERS)}")
    return TRACK_FILTERS[name](scene, settings or FilterSettings())


def _birth(scene: SceneModel) -> Birth | MeasurementBirth:
    if scene.birth_means is None:
        return MeasurementBirth(float(scene.birth_weights.sum()), np.sqrt(np.diag(scene.birth_covariance)))
    return Birth(scene.birth_weights, scene.birth_means, scene.birth_covariance)


def _gaussian(
    filter_class: Callable[..., GaussianT], reduction: Callable[[int], Reduction]
) -> Callable[[SceneModel, FilterSettings], GaussianT]:
    def make(scene: SceneModel, settings: FilterSettings) -> GaussianT:
        return filter_class(
            scene.hidden_markov if settings.hidden_markov else scene.model,
            _birth(scene),
            clutter_intensity=scene.clutter_map or scene.clutter_intensity,
            survival=scene.survival_probability,
            detection=scene.detection_probability,
            extraction=settings.extraction,
            spawn=scene.spawn,
            reduction=replace(reduction(settings.capacity), existence=scene.least_existence),
        )

    return make


def _mixture(scene: SceneModel, settings: FilterSettings) -> PMBM:
    made = _gaussian(PMBM, lambda capacity: Reduction(components=5, tracks=10 * capacity))(scene, settings)
    return replace(made, targets=max(made.targets, settings.capacity))


def _robust(scene: SceneModel, settings: FilterSettings) -> RobustPMB:
    model = scene.hidden_markov if settings.hidden_markov else scene.model
    birth: Birth | MeasurementBirth | Births = _birth(scene)
    if isinstance(birth, Birth):
        expected = ELSEWHERE * float(birth.weights.sum())
        birth = Births(birth, MeasurementBirth(expected, np.sqrt(np.diag(scene.birth_covariance)), largest=expected))
    return RobustPMB(
        model,
        birth,
        clutter_intensity=scene.clutter_intensity,
        volume=float(np.prod(scene.seen_high - scene.seen_low)),
        clutter_density=scene.clutter_map and partial(_relative_clutter, scene.clutter_map, scene.clutter_intensity),
        survival=RegionSurvival(model, scene.survival_probability, scene.region_low, scene.region_high),
        detection=scene.detection_probability,
        spawn=scene.spawn,
        modes=_modes(scene, model),
        extraction=settings.extraction,
    )


def _modes(scene: SceneModel, model: Model) -> InteractingModels | None:
    """Motion modes in the plane: measured maneuvers, else turns at a usual rate; None in space."""
    if len(scene.region_low) != 2:
        return None
    if scene.maneuver > 0.0:
        # A measured maneuver lasts one scan.
        return maneuvers(model, agility=scene.agility, turn_rate=0.0, straight=1.0 / scene.maneuver, turning=1.0)
    return maneuvers(model, turn_rate=min(TURN_RATE, MOST_TURN / model.period))


def _relative_clutter(intensity: Callable[[Array], Array], mean: float, z: Array) -> Array:
    return np.asarray(intensity(z) / mean)


def _trajectories(scene: SceneModel, settings: FilterSettings) -> TrajectoryPMB:
    made = _gaussian(TrajectoryPMB, lambda capacity: Reduction(components=5, tracks=capacity))(scene, settings)
    pairwise = made.model.packed.pairwise
    return replace(made, lag=scene.lag, maneuver=0.0 if pairwise else scene.maneuver, agility=scene.agility)


def _robust_trajectories(scene: SceneModel, settings: FilterSettings) -> RobustTrajectoryPMB:
    guide, model = _robust(scene, settings), scene.hidden_markov if settings.hidden_markov else scene.model
    if scene.maneuver > 0.0:
        return RobustTrajectoryPMB(guide, lag=scene.lag, maneuver=scene.maneuver, agility=scene.agility)
    motion = None if guide.modes is None else maneuvers(model, agility=SMOOTHED_AGILITY).models[1]
    return RobustTrajectoryPMB(guide, motion, lag=scene.lag)


def steered_phd(scene: SceneModel, settings: FilterSettings | None = None) -> SteeredPHD:
    """Create a GM-PHD filter for a scene whose parameters are passed at every step."""
    made = _phd(scene, settings or FilterSettings())
    deviation = np.sqrt(np.diag(scene.birth_covariance))
    return SteeredPHD(made, MeasurementBirth(1.0, deviation, largest=1.0))


def _anywhere(scene: SceneModel, settings: FilterSettings) -> SteadyPHD:
    return SteadyPHD(steered_phd(scene, settings))


def _counting(scene: SceneModel, settings: FilterSettings) -> CountingPHD:
    return CountingPHD(steered_phd(scene, settings), scene.clutter_rate)


def _cardinalized(scene: SceneModel, settings: FilterSettings) -> GMCPHD:
    return GMCPHD(
        scene.hidden_markov if settings.hidden_markov else scene.model,
        _birth(scene),
        clutter_intensity=scene.clutter_intensity,
        survival=scene.survival_probability,
        detection=scene.detection_probability,
        # The number is what this filter is for.
        extraction="map" if settings.extraction == "threshold" else settings.extraction,
        reduction=Reduction(components=settings.capacity),
    )


def _particle(scene: SceneModel, settings: FilterSettings) -> ParticlePHD:
    birth = _birth(scene)
    if isinstance(birth, MeasurementBirth):
        # Birth particles are drawn from one Gaussian with the variance of the uniform region.
        covariance, mean = scene.birth_covariance.copy(), np.zeros((1, len(scene.birth_covariance)))
        position = np.arange(0, len(covariance), 2)
        covariance[position, position] = (0.5 * (scene.region_high - scene.region_low)) ** 2 / 3.0
        mean[0, position] = 0.5 * (scene.region_low + scene.region_high)
        birth = Birth(scene.birth_weights, mean, covariance)
    return ParticlePHD(
        scene.hidden_markov,
        birth,
        clutter_intensity=scene.clutter_intensity,
        survival=scene.survival_probability,
        detection=scene.detection_probability,
    )


def _velocity_deviation(scene: SceneModel) -> float:
    return float(np.sqrt(scene.birth_covariance[1, 1]))


def _nearest(scene: SceneModel, settings: FilterSettings) -> GlobalNearestNeighbor:
    return GlobalNearestNeighbor(
        scene.hidden_markov if settings.hidden_markov else scene.model, hidden_deviation=_velocity_deviation(scene)
    )


def _raw(scene: SceneModel, settings: FilterSettings) -> RawMeasurements:
    return RawMeasurements(scene.model)


_phd = _gaussian(GMPHD, lambda capacity: Reduction(components=capacity))

TRACK_FILTERS: Mapping[str, Callable[[SceneModel, FilterSettings], TrackFilter]] = {
    "gm-phd": _phd,
    "gm-phd-anywhere": _anywhere,
    "gm-phd-counting": _counting,
    "gm-cphd": _cardinalized,
    "gm-cbmember": _gaussian(GMCBMeMBer, lambda capacity: Reduction(components=10, tracks=capacity)),
    "pmb": _gaussian(PMB, lambda capacity: Reduction(components=5, tracks=capacity)),
    "robust-pmb": _robust,
    "pmbm": _mixture,
    SMOOTHER: _trajectories,
    ROBUST_SMOOTHER: _robust_trajectories,
    "smc-phd": _particle,
    "gnn": _nearest,
    "raw-measurements": _raw,
}
"""Factory of each observer's estimator."""
