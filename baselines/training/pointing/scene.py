"""A clutter scene behind a pointed sensor, and a filter that knows where the sensor looks."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr

from servotrack.envs.track.clutter.config import ClutterConfig, clutter_config
from servotrack.envs.track.clutter.episode import ClutterEpisode, draw_episode
from servotrack.envs.track.clutter.scene_model import SceneModel, scene_model_of
from servotrack.estimators.rfs.birth import Birth, BirthMixture, MeasurementBirth
from servotrack.estimators.rfs.pmb import PMB, PMBState
from servotrack.estimators.rfs.pmb_kernel import Prediction
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.types import Array, Mask


@dataclass(frozen=True)
class PointedScene:
    """Parameters of a scene with a pointed sensor.

    Attributes:
        name: Short name.
        shape: `square` (moves along both axes) or `strip` (full height, moves along x); both cover a third of the
            region.
        rate: Largest change of each coordinate of the sensor's center per scan, m. Raising it sees more of the region
            in the same time.
        axes: Level and other arguments of `ClutterTracking-v0`.
    """

    name: str
    shape: str
    rate: float
    axes: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def config(self) -> ClutterConfig:
        """Parameters of the world without the field of view."""
        return clutter_config(**{"level": 1, "structure": "HMM", **self.axes})

    @cached_property
    def model(self) -> SceneModel:
        """Scene model that every policy and its filter know."""
        return scene_model_of(self.config)

    @cached_property
    def half(self) -> Array:
        """Half sides of the field of view, shape (2,), m."""
        h = self.config.half_width
        return np.array([h / np.sqrt(3.0)] * 2) if self.shape == "square" else np.array([h / 3.0, h])

    @cached_property
    def limit(self) -> Array:
        """Largest absolute coordinates of the center, shape (2,), m: the field of view stays inside the region."""
        return self.config.half_width - self.half

    @cached_property
    def rates(self) -> Array:
        """Largest change of the center per scan, shape (2,), m."""
        return np.where(self.limit > 0.0, self.rate, 0.0)

    def moved(self, center: Array, wanted: Array) -> Array:
        """Return the center at the next scan if the sensor turns toward `wanted`, shape (2,), m."""
        step = np.clip(wanted - center, -self.rates, self.rates)
        return np.asarray(np.clip(center + step, -self.limit, self.limit))

    def sees(self, center: Array, positions: Array) -> Mask:
        """Return which positions (..., 2) lie in the field of view."""
        return np.asarray((np.abs(positions - center) <= self.half).all(axis=-1))

    def inside(self, axis: int, centers: Array, means: Array, deviations: Array) -> Array:
        """Return the probability of Gaussians to lie in the field of view of each center along one axis.

        Args:
            axis: 0 for x, 1 for y.
            centers: Coordinates of centers, shape (g,), m.
            means: Mean coordinates, shape (k,), m.
            deviations: Standard deviations, shape (k,), m.

        Returns:
            Shape (g, k).
        """
        away = means - centers[:, None]
        wide = np.maximum(deviations, 1e-9)
        return np.asarray(ndtr((self.half[axis] - away) / wide) - ndtr((-self.half[axis] - away) / wide))


class PointedEpisode:
    """An episode of which the sensor sees a part: targets in the field of view, and clutter in it."""

    def __init__(self, scene: PointedScene, seed: int) -> None:
        self.scene = scene
        self.episode: ClutterEpisode = draw_episode(scene.config, seed)
        self.positions = self.episode.states[..., [0, 2]]

    def scan(self, k: int, center: Array) -> Array:
        """Return the measurements of scan k with the sensor at `center`, shape (Z, 2), m."""
        rows, source = self.episode.measurements[k], self.episode.source[k]
        # A target is detected if it stands in the field of view, clutter if it is measured there.
        place = np.where((source >= 0)[:, None], self.positions[k, np.maximum(source, 0)], rows[:, 1:])
        return np.asarray(rows[(source > -2) & self.scene.sees(center, place), 1:])


@dataclass(frozen=True, eq=False)
class PointedPMB(PMB):
    """Poisson multi-Bernoulli filter whose detection probability is that of a field of view.

    Each component has p_D times its probability of lying in the field of view.
    """

    scene: PointedScene | None = None
    center: Array = field(default_factory=lambda: np.zeros(2))

    def _predict(self, state: PMBState, presence: Array, births: BirthMixture) -> Prediction:
        found = super()._predict(state, presence, births)
        assert self.scene is not None
        detections = []
        for mixture in (found.pool, found.hidden):
            used, share = int(mixture.number[0]), np.zeros(mixture.weight.shape)
            share[0, :used] = self.scene.config.detection_probability
            for axis in (0, 1):
                deviation = np.sqrt(mixture.covariance[0, :used, 2 * axis, 2 * axis])
                mean = mixture.mean[0, :used, 2 * axis]
                share[:, :used] *= self.scene.inside(axis, self.center[axis : axis + 1], mean, deviation)
            detections.append(share)
        return found._replace(detection=detections[0], hidden_detection=detections[1])

    def look(self, center: Array) -> None:
        """Point the sensor of the next step."""
        self.center[:] = center


def pointed_filter(scene: PointedScene) -> PointedPMB:
    """Return the filter of a scene."""
    model = scene.model
    birth: Birth | MeasurementBirth
    if model.birth_means is None:
        # The expected births are those of the whole region; the sensor finds them when it comes by.
        deviation = scene.config.birth_speed
        birth = MeasurementBirth(3.0 * scene.config.birth_rate, hidden_deviation=deviation)
    else:
        birth = Birth(
            model.birth_weights, model.birth_means, np.stack([model.birth_covariance] * len(model.birth_means))
        )
    return PointedPMB(
        model.hidden_markov,
        birth,
        clutter_intensity=model.clutter_intensity,
        survival=model.survival_probability,
        detection=model.detection_probability,
        gate_probability=0.9999,
        reduction=Reduction(components=3),
        scene=scene,
    )
