"""The Monte-Carlo color tracker of Zhang and Li 2008."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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
from servotrack.estimators.types import Array


class MonteCarloState(NamedTuple):
    """Memory of a `MonteCarloColor`.

    Attributes:
        pose: The last estimate.
        reference: Histogram of the object, shape (bins ** 3,).
        frame: Number of frames seen.
    """

    pose: Pose
    reference: Array
    frame: int


@dataclass(frozen=True)
class MonteCarloColor:
    """Mean of candidate boxes of random center and scale, weighted by the similarity of their color histograms.

    Source: Zhang and Li, "Object tracking with Monte Carlo methods", Journal of Image and Graphics 13(5), 2008,
    section 3. The number of samples and of bins are the paper's. It does not give the other five values; they are
    assumed and were chosen on tune seeds of `ColorTracking-v0`.

    Attributes:
        samples: Number of candidates per frame, n of section 3.2. Raising it costs time and reduces noise.
        center_deviation: Standard deviation of the candidates' centers about the last one, px. Raising it follows
            faster motion with more noise. Assumed.
        scale_deviation: Standard deviation of the candidates' scales, as a share of the last one. Assumed.
        distance_deviation: sigma_0 of eq. (11), with the exponent as printed, d^2 / sigma_0^2. Raising it makes the
            weights more equal. Assumed.
        update_rate: alpha of eq. (12). Raising it adapts the reference faster. Assumed.
        update_threshold: Similarity above which the reference is updated. Assumed.
        bins: Number of bins of each color channel.
        seed: Seed; the random numbers depend only on it and on the number of the frame.
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
        check_fields(
            self,
            counts=("samples",),
            positive=("center_deviation", "scale_deviation", "distance_deviation"),
            shares=("update_rate", "update_threshold"),
        )

    def initial(self, frame: ArrayLike, box: ArrayLike) -> MonteCarloState:
        """Compute the object's reference from the first frame (steps 1 and 2 of section 3.2).

        Args:
            frame: RGB (H, W, 3) or gray (H, W), uint8.
            box: Left, top, width and height, px.

        Raises:
            ValueError: The frame is invalid, or the box has no area or lies outside the frame.
        """
        image, first, pose = start(frame, box)
        return MonteCarloState(pose, color_histogram(image, first, self.bins), 1)

    def step(self, state: MonteCarloState, frame: ArrayLike) -> tuple[MonteCarloState, BoxEstimate]:
        """Find the object in the next frame (steps 3 and 4).

        Args:
            state: Result of `initial` or of the last `step`.
            frame: Frame of the same size.

        Raises:
            ValueError: The frame is invalid or has another size.
        """
        image = checked_frame(frame, state.pose.shape)
        centers, scales = self.draw(state)
        boxes = state.pose.boxes(centers, scales)
        weights = color_weights(similarities(image, boxes, state.reference, self.bins), self.distance_deviation**2)
        pose = state.pose._replace(center=weights @ centers, scale=float(weights @ scales))
        found = color_histogram(image, pose.box, self.bins)
        similarity, reference = learn(state.reference, found, self.update_rate, self.update_threshold)
        return MonteCarloState(pose, reference, state.frame + 1), BoxEstimate(pose.box, similarity, boxes, weights)

    def draw(self, state: MonteCarloState) -> tuple[Array, Array]:
        """Draw candidates from a Gaussian about the last estimate, clipped to the frame.

        Returns:
            Centers (n, 2), px, and scales (n,).
        """
        noise = normals(self.seed, state.frame, (self.samples, 3))
        centers = state.pose.within(state.pose.center + self.center_deviation * noise[:, :2])
        scales = state.pose.scale * (1.0 + self.scale_deviation * noise[:, 2])
        return centers, state.pose.bounded(scales)
