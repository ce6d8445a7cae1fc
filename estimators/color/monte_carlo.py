"""The Monte-Carlo color tracker of paper 001 (Zhang and Li 2008)."""

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

Array = NDArray[np.float64]

SMALLEST_SCALE, LARGEST_SCALE = 0.1, 10.0
"""How far a box may shrink and grow against the first one."""


class MonteCarloState(NamedTuple):
    """Memory of a `MonteCarloColor`.

    Attributes:
        center: Of the box, shape (2,), px.
        scale: Of the box, 1 for the first one.
        size: Width and height of the first box, px.
        reference: Histogram of the object, shape (bins ** 3,).
        frame: Number of frames seen.
        shape: Height and width of the frames.
    """

    center: Array
    scale: float
    size: Array
    reference: Array
    frame: int
    shape: tuple[int, int]


@dataclass(frozen=True)
class MonteCarloColor:
    """Candidates of random place and scale, weighted by how much their colors are the object's; their mean is the box.

    Source: Zhang and Li, "Object tracking with Monte Carlo methods", Journal of Image and Graphics 13(5), 2008,
    section 3. The number of samples and the bins are the paper's. It does not give the other five; they are assumed,
    chosen on tune seeds of `ColorTracking-v0`.

    Attributes:
        samples: n of section 3.2.
        center_deviation: Standard deviation of the samples' centers about the last one, px. Assumed.
        scale_deviation: Standard deviation of their scales, as a share of the last one. Assumed.
        distance_deviation: sigma_0 of eq. (11), whose exponent is read as printed, d^2 / sigma_0^2. Assumed.
        update_rate: alpha of eq. (12). Assumed.
        update_threshold: Similarity above which the reference is updated. Assumed.
        bins: Of each color channel.
        seed: The random numbers are a function of it and of the frame's number.
    """

    samples: int = 200
    center_deviation: float = 10.0
    scale_deviation: float = 0.04
    distance_deviation: float = 0.05
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
        check_shares(update_rate=self.update_rate, update_threshold=self.update_threshold)

    def initial(self, frame: ArrayLike, box: ArrayLike) -> MonteCarloState:
        """Take the object's reference from the first frame (steps 1 and 2 of section 3.2).

        Args:
            frame: RGB (H, W, 3) or gray (H, W), uint8.
            box: Left, top, width and height, px.

        Raises:
            ValueError: No such frame, or a box without area or outside of it.
        """
        image = checked_frame(frame)
        first = checked_box(box, image.shape)
        reference = color_histogram(image, first, self.bins)
        return MonteCarloState(middle(first), 1.0, first[2:], reference, 1, (image.shape[0], image.shape[1]))

    def step(self, state: MonteCarloState, frame: ArrayLike) -> tuple[MonteCarloState, BoxEstimate]:
        """Find the object in the next frame (steps 3 and 4).

        Args:
            state: What `initial` or the last `step` returned.
            frame: Of the same size.

        Raises:
            ValueError: No such frame, or one of another size.
        """
        image = checked_frame(frame, state.shape)
        centers, scales = self.draw(state)
        boxes = box_about(centers, scales[:, None] * state.size)
        # Eqs (8), (9) and (11): the distance is the root of 1 - rho; the factor before the exponential cancels.
        weights = self.weigh(similarities(image, boxes, state.reference, self.bins))
        center, scale = weights @ centers, float(weights @ scales)
        box = box_about(center, scale * state.size)
        found = color_histogram(image, box, self.bins)
        similarity = min(bhattacharyya(state.reference, found), 1.0)
        reference = state.reference
        if similarity > self.update_threshold:
            reference = (1.0 - self.update_rate) * reference + self.update_rate * found
        state = state._replace(center=center, scale=scale, reference=reference, frame=state.frame + 1)
        return state, BoxEstimate(box, similarity, boxes, weights)

    def draw(self, state: MonteCarloState) -> tuple[Array, Array]:
        """Candidates, Gaussian about the last estimate, none outside of the frame.

        Returns:
            Centers (n, 2), px, and scales (n,).
        """
        noise = normals(self.seed, state.frame, (self.samples, 3))
        centers = within(state.center + self.center_deviation * noise[:, :2], state.shape)
        scales = state.scale * (1.0 + self.scale_deviation * noise[:, 2])
        return centers, np.clip(scales, SMALLEST_SCALE, LARGEST_SCALE)

    def weigh(self, similarity: Array) -> Array:
        """Weights of sum 1 from Bhattacharyya coefficients (eqs (9) and (11)). Shape (n,)."""
        squared = np.maximum(1.0 - similarity, 0.0)
        # The nearest candidate has exponent 0, so that not all of them vanish.
        weights = np.exp((squared.min() - squared) / self.distance_deviation**2)
        return weights / weights.sum()
