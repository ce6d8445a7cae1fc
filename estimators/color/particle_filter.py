"""Bootstrap particle filter with color histograms, one of the methods compared in Zhang and Li 2008."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.color.contract import (
    BoxEstimate,
    Pose,
    check_fields,
    checked_frame,
    normals,
    start,
)
from servotrack.estimators.color.histogram import color_histogram, color_weights, learn, similarities
from servotrack.estimators.types import Array, Labels


class ParticleState(NamedTuple):
    """Memory of a `ColorParticleFilter`.

    Attributes:
        particles: Center x, y (px) and scale of each. Shape (n, 3).
        previous: Center and scale of each, one frame earlier. Shape (n, 3).
        pose: The last estimate.
        reference: Histogram of the object, shape (bins ** 3,).
        frame: Number of frames so far.
    """

    particles: Array
    previous: Array
    pose: Pose
    reference: Array
    frame: int


@dataclass(frozen=True)
class ColorParticleFilter:
    """Particles that move by a second-order autoregression, weighted by color, resampled in every frame.

    Source: Nummiaro, Koller-Meier and Van Gool, "An adaptive color-based particle filter", Image and Vision Computing
    21(1), 2003, pp. 99-110, with the histogram of Zhang and Li 2008 in place of a kernel-weighted one. The values were
    chosen on tune seeds of `ColorTracking-v0`.

    Attributes:
        samples: Number of particles. Raising it costs time and reduces noise.
        damping: Factor on the last displacement: x_k = x_(k-1) + damping (x_(k-1) - x_(k-2)) + noise.
        center_deviation: Standard deviation of the noise of the center, px. Raising it follows faster motion with more
            noise.
        scale_deviation: Standard deviation of the noise of the scale, as a share of it.
        distance_deviation: sigma of the likelihood exp(-d^2 / (2 sigma^2)). Raising it makes the weights more equal.
        update_rate: Weight of a new frame in the reference.
        update_threshold: Similarity above which the reference is updated.
        bins: Number of bins of each color channel.
        seed: Seed; the random numbers depend only on it and on the number of the frame.
    """

    samples: int = 200
    damping: float = 0.5
    center_deviation: float = 8.0
    scale_deviation: float = 0.01
    distance_deviation: float = 0.02
    update_rate: float = 0.01
    update_threshold: float = 0.9
    bins: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        check_fields(
            self,
            counts=("samples",),
            positive=("center_deviation", "scale_deviation", "distance_deviation"),
            shares=("damping", "update_rate", "update_threshold"),
        )

    def initial(self, frame: ArrayLike, box: ArrayLike) -> ParticleState:
        """Place all particles on the box; arguments and errors as in `MonteCarloColor.initial`."""
        image, first, pose = start(frame, box)
        particles = np.tile([*pose.center, pose.scale], (self.samples, 1))
        return ParticleState(particles, particles, pose, color_histogram(image, first, self.bins), 1)

    def step(self, state: ParticleState, frame: ArrayLike) -> tuple[ParticleState, BoxEstimate]:
        """Predict, weigh, estimate, resample; arguments and errors as in `MonteCarloColor.step`."""
        image = checked_frame(frame, state.pose.shape)
        noise = normals(self.seed, state.frame, (self.samples + 1, 3))
        moved = state.particles + self.damping * (state.particles - state.previous)
        moved[:, :2] = state.pose.within(moved[:, :2] + self.center_deviation * noise[:-1, :2])
        moved[:, 2] = state.pose.bounded(moved[:, 2] * (1.0 + self.scale_deviation * noise[:-1, 2]))
        boxes = state.pose.boxes(moved[:, :2], moved[:, 2])
        weights = color_weights(
            similarities(image, boxes, state.reference, self.bins), 2.0 * self.distance_deviation**2
        )
        mean = weights @ moved
        pose = state.pose._replace(center=mean[:2], scale=float(mean[2]))
        found = color_histogram(image, pose.box, self.bins)
        similarity, reference = learn(state.reference, found, self.update_rate, self.update_threshold)
        chosen = systematic_resampling(weights, float(_uniform(noise[-1, 0])))
        state = ParticleState(moved[chosen], state.particles[chosen], pose, reference, state.frame + 1)
        return state, BoxEstimate(pose.box, similarity, boxes, weights)


def systematic_resampling(weights: Array, offset: float) -> Labels:
    """Resample n particles in proportion to their weights by n equidistant pointers and return their indices.

    Args:
        weights: Weights of sum 1, shape (n,).
        offset: Offset of the first pointer, 0 to 1.
    """
    pointers = (np.arange(len(weights)) + offset) / len(weights)
    return np.minimum(np.searchsorted(np.cumsum(weights), pointers), len(weights) - 1)


def _uniform(normal: float) -> float:
    """Convert a normal number to a uniform one: the fractional part of a large multiple."""
    return (1e4 * abs(normal)) % 1.0
