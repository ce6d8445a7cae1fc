"""A bootstrap particle filter with color histograms, as paper 001's rivals have it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.color.contract import (
    BoxEstimate,
    box_about,
    check_count,
    check_positive,
    check_shares,
    checked_box,
    checked_frame,
    middle,
    normals,
    within,
)
from servotrack.estimators.color.histogram import bhattacharyya, color_histogram, similarities
from servotrack.estimators.color.monte_carlo import LARGEST_SCALE, SMALLEST_SCALE

Array = NDArray[np.float64]


class ParticleState(NamedTuple):
    """Memory of a `ColorParticleFilter`.

    Attributes:
        particles: Center x, y (px) and scale of each. Shape (n, 3).
        previous: The same, one frame earlier. Shape (n, 3).
        size: Width and height of the first box, px.
        reference: Histogram of the object, shape (bins ** 3,).
        frame: Number of frames seen.
        shape: Height and width of the frames.
    """

    particles: Array
    previous: Array
    size: Array
    reference: Array
    frame: int
    shape: tuple[int, int]


@dataclass(frozen=True)
class ColorParticleFilter:
    """Particles that move by a second-order autoregression, weighted by color, resampled in every frame.

    Source: Nummiaro, Koller-Meier and Van Gool, "An adaptive color-based particle filter", Image and Vision Computing
    21(1), 2003, pp. 99-110, with paper 001's histogram in place of a kernel's. Values chosen on tune seeds of
    `ColorTracking-v0`.

    Attributes:
        samples: Number of particles.
        damping: Share of the last displacement that goes on: x_k = x_(k-1) + damping (x_(k-1) - x_(k-2)) + noise.
        center_deviation: Of the noise on the center, px.
        scale_deviation: Of the noise on the scale, as a share of it.
        distance_deviation: sigma of the likelihood exp(-d^2 / (2 sigma^2)).
        update_rate: Of the reference.
        update_threshold: Similarity above which the reference is updated.
        bins: Of each color channel.
        seed: The random numbers are a function of it and of the frame's number.
    """

    samples: int = 200
    damping: float = 0.5
    center_deviation: float = 5.0
    scale_deviation: float = 0.01
    distance_deviation: float = 0.02
    update_rate: float = 0.01
    update_threshold: float = 0.9
    bins: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        check_count(samples=self.samples, bins=self.bins)
        check_positive(
            center_deviation=self.center_deviation,
            scale_deviation=self.scale_deviation,
            distance_deviation=self.distance_deviation,
        )
        check_shares(damping=self.damping, update_rate=self.update_rate, update_threshold=self.update_threshold)

    def initial(self, frame: ArrayLike, box: ArrayLike) -> ParticleState:
        """All particles on the box; arguments and errors as in `MonteCarloColor.initial`."""
        image = checked_frame(frame)
        first = checked_box(box, image.shape)
        particles = np.tile([*middle(first), 1.0], (self.samples, 1))
        reference = color_histogram(image, first, self.bins)
        return ParticleState(particles, particles, first[2:], reference, 1, (image.shape[0], image.shape[1]))

    def step(self, state: ParticleState, frame: ArrayLike) -> tuple[ParticleState, BoxEstimate]:
        """Predict, weigh, estimate, resample; arguments and errors as in `MonteCarloColor.step`."""
        image = checked_frame(frame, state.shape)
        noise = normals(self.seed, state.frame, (self.samples + 1, 3))
        moved = state.particles + self.damping * (state.particles - state.previous)
        moved[:, :2] = within(moved[:, :2] + self.center_deviation * noise[:-1, :2], state.shape)
        moved[:, 2] = np.clip(moved[:, 2] * (1.0 + self.scale_deviation * noise[:-1, 2]), SMALLEST_SCALE, LARGEST_SCALE)
        boxes = box_about(moved[:, :2], moved[:, 2:] * state.size)
        squared = np.maximum(1.0 - similarities(image, boxes, state.reference, self.bins), 0.0)
        weights = np.exp((squared.min() - squared) / (2.0 * self.distance_deviation**2))
        weights /= weights.sum()
        mean = weights @ moved
        box = box_about(mean[:2], mean[2] * state.size)
        found = color_histogram(image, box, self.bins)
        similarity = min(bhattacharyya(state.reference, found), 1.0)
        reference = state.reference
        if similarity > self.update_threshold:
            reference = (1.0 - self.update_rate) * reference + self.update_rate * found
        chosen = systematic_resampling(weights, float(_uniform(noise[-1, 0])))
        state = ParticleState(
            moved[chosen], state.particles[chosen], state.size, reference, state.frame + 1, state.shape
        )
        return state, BoxEstimate(box, similarity, boxes, weights)


def systematic_resampling(weights: Array, offset: float) -> NDArray[np.int64]:
    """Indices of n particles in proportion to their weights, by n equidistant pointers.

    Args:
        weights: Of sum 1, shape (n,).
        offset: Of the first pointer, 0 to 1.
    """
    pointers = (np.arange(len(weights)) + offset) / len(weights)
    return np.minimum(np.searchsorted(np.cumsum(weights), pointers), len(weights) - 1)


def _uniform(normal: float) -> float:
    """A normal number as a uniform one: the fraction of a multiple that is far larger than 1."""
    return (1e4 * abs(normal)) % 1.0
