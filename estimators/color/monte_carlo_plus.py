"""Monte-Carlo tracking with more features, as paper 001's last section asks for: what to add, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.color.cells import CHANNELS, ORIENTATIONS, describe, integrate_channels
from servotrack.estimators.color.contract import (
    BoxEstimate,
    Pose,
    check_fields,
    checked_frame,
    normals,
    start,
)
from servotrack.estimators.color.histogram import color_histogram
from servotrack.estimators.types import Array, FloatArray, Image


class View(NamedTuple):
    """Part of a frame.

    Attributes:
        integral: As `integrate_channels` writes it.
        corner: Left and top of the part, then zeros. Shape (4,), px.
    """

    integral: FloatArray
    corner: Array


class PlusState(NamedTuple):
    """Memory of a `MonteCarloColorPlus`.

    Attributes:
        pose: The last estimate.
        velocity: Of the center, shape (2,), px per frame.
        inside: Histogram of the object's colors, shape (bins ** 3,).
        outside: Histogram of the colors around it, shape (bins ** 3,).
        first: FloatArray of the first box, shape (2, f).
        recent: FloatArray as they are now, shape (2, f).
        contrast: Usual contrast of the object with its surroundings.
        lost: How sure it is that the object is out of sight, 0 to 1.
        frame: Number of frames seen.
    """

    pose: Pose
    velocity: Array
    inside: Array
    outside: Array
    first: FloatArray
    recent: FloatArray
    contrast: float
    lost: float
    frame: int


@dataclass(frozen=True)
class MonteCarloColorPlus:
    """Monte-Carlo tracking by gradients, spatial colors, and colors weighted against the background.

    What differs from `MonteCarloColor`: a candidate is described by a grid of cells, gradient directions and colors in
    each, so that it matters where a color is; its contrast, the mean chance that a pixel is the object's and not the
    surroundings' inside less that around it, tells its scale; candidates are drawn about where the object is bound for,
    first widely, then closely about the best ones; memory is what the first frame and the recent ones showed, and is
    left alone while the object seems hidden.

    Values chosen on tune seeds of `ColorTracking-v0`.

    Attributes:
        samples: Candidates of a frame, half of them drawn widely.
        center_deviation: Standard deviation of wide candidates' centers, as a share of the box's size.
        scale_deviation: Standard deviation of their scales, as a share of the last one.
        narrowing: Share of these deviations with which the other half is drawn.
        sharpness: Weights are exp(sharpness * similarity).
        gradient_share: Of gradients in the similarity; colors have `color_share`, contrast the rest.
        color_share: Of spatial colors.
        inertia: Share of the last velocity that the object is expected to keep.
        update_rate: Of the memory, where the object is in sight.
        loyalty: Share of the first frame's features in the comparison.
        hidden_below: Similarity below which the object counts as hidden.
        widening: How much wider candidates are drawn, at most, while it is hidden.
        braking: Share of its velocity that a hidden object is expected to keep.
        grid: Cells to a side.
        rim: Width of the surroundings, as a share of the box.
        bins: Of each color channel.
        seed: The random numbers are a function of it and of the frame's number.
    """

    samples: int = 200
    center_deviation: float = 0.16
    scale_deviation: float = 0.05
    narrowing: float = 0.3
    sharpness: float = 60.0
    gradient_share: float = 0.6
    color_share: float = 0.3
    inertia: float = 0.8
    update_rate: float = 0.03
    loyalty: float = 1.0
    hidden_below: float = 0.65
    widening: float = 1.5
    braking: float = 0.8
    grid: int = 5
    rim: float = 0.35
    bins: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        check_fields(
            self,
            counts=("samples", "grid"),
            positive=("center_deviation", "scale_deviation", "narrowing", "sharpness", "rim"),
            shares=(
                "gradient_share", "color_share", "inertia", "update_rate", "loyalty", "hidden_below", "braking",
            ),
        )  # fmt: skip
        if self.samples < 2:
            raise ValueError(f"samples must be at least 2, wide ones and close ones, got {self.samples!r}")
        if self.gradient_share + self.color_share > 1.0:
            raise ValueError(
                "gradient_share + color_share must be at most 1, contrast has the rest, got "
                f"{self.gradient_share!r} + {self.color_share!r}"
            )
        if not 0.0 <= self.widening < np.inf:
            raise ValueError(f"widening must be finite and at least 0, got {self.widening!r}")

    def initial(self, frame: ArrayLike, box: ArrayLike) -> PlusState:
        """Take the object's features; arguments and errors as in `MonteCarloColor.initial`."""
        image, first, pose = start(frame, box)
        inside, outside = self._colors(image, first)
        view = self._view(image, first[None], _chances(inside, outside))
        features, contrast = self._describe(view, first[None])
        return PlusState(
            pose, np.zeros(2), inside, outside, features[0], features[0], float(contrast[0]), lost=0.0, frame=1
        )

    def step(self, state: PlusState, frame: ArrayLike) -> tuple[PlusState, BoxEstimate]:
        """Find the object in the next frame; arguments and errors as in `MonteCarloColor.step`."""
        last = state.pose
        image = checked_frame(frame, last.shape)
        half = self.samples // 2
        noise = normals(self.seed, state.frame, (self.samples, 3))
        expected = last.center + self.inertia * state.velocity
        wide = self._draw(last, noise[:half], expected, last.scale, 1.0 + self.widening * state.lost)
        # One candidate stays where it is expected, so that a still object is met exactly.
        wide[0] = (*expected, last.scale)
        boxes = last.boxes(wide[:, :2], wide[:, 2])
        view = self._view(image, boxes, _chances(state.inside, state.outside))
        coarse = self._similarity(view, state, boxes)[0]
        about = _weights(coarse, self.sharpness) @ wide
        close = self._draw(last, noise[half:], about[:2], float(about[2]), self.narrowing)
        candidates = np.concatenate([wide, close])
        boxes = np.concatenate([boxes, last.boxes(close[:, :2], close[:, 2])])
        similarity = np.concatenate([coarse, self._similarity(view, state, boxes[half:])[0]])
        weights = _weights(similarity, self.sharpness)
        found = weights @ candidates
        own, features, contrast = self._similarity(view, state, last.boxes(found[None, :2], found[None, 2]))
        hidden = bool(own[0] < self.hidden_below)
        # What is there instead must not carry the estimate away: it goes where the object was bound for.
        pose = (
            last._replace(center=last.within(expected))
            if hidden
            else last._replace(center=found[:2], scale=float(found[2]))
        )
        state = self._remember(state, image, pose, hidden, features[0], float(contrast[0]))
        return state, BoxEstimate(pose.box, min(max(float(own[0]), 0.0), 1.0), boxes, weights)

    def _draw(self, last: Pose, noise: Array, center: Array, scale: float, width: float) -> Array:
        """Candidates as rows of center x, y and scale."""
        spread = width * self.center_deviation * scale * float(np.sqrt(last.size[0] * last.size[1]))
        drawn = np.empty((len(noise), 3))
        drawn[:, :2] = last.within(center + spread * noise[:, :2])
        deviation = min(width, 1.0) * self.scale_deviation
        drawn[:, 2] = last.bounded(scale * np.exp(deviation * noise[:, 2]))
        return drawn

    def _similarity(self, view: View, state: PlusState, boxes: Array) -> tuple[Array, FloatArray, Array]:
        """Similarity (n,), features (n, 2, f) and contrast (n,) of boxes."""
        features, contrast = self._describe(view, boxes)
        memory = self.loyalty * state.first + (1.0 - self.loyalty) * state.recent
        gradients, colors = features[:, 0] @ memory[0], features[:, 1] @ memory[1]
        relative = np.minimum(np.maximum(contrast / max(state.contrast, _LEAST_CONTRAST), -1.0), 1.5)
        rest = 1.0 - self.gradient_share - self.color_share
        total = self.gradient_share * gradients + self.color_share * colors + rest * relative
        return total.astype(np.float64), features, contrast

    def _view(self, image: Image, boxes: Array, chances: FloatArray) -> View:
        """The part of a frame that holds boxes with their surroundings, integrated."""
        margin = self.rim * boxes[:, 2:] + 2.0
        size = np.array([image.shape[1], image.shape[0]])
        low = np.floor((boxes[:, :2] - margin).min(axis=0)).astype(np.int64)
        high = np.ceil((boxes[:, :2] + boxes[:, 2:] + margin).max(axis=0)).astype(np.int64)
        low = np.clip(low, 0, size - 1)
        high = np.maximum(np.clip(high, 0, size), low + 1)
        region = image[low[1] : high[1], low[0] : high[0]]
        integral = np.empty((region.shape[0] + 1, region.shape[1] + 1, CHANNELS), np.float32)
        integrate_channels(region, chances, self.bins, integral)
        return View(integral, np.array([*low, 0.0, 0.0]))

    def _describe(self, view: View, boxes: Array) -> tuple[FloatArray, Array]:
        """Features (n, 2, f) and contrast (n,) of boxes."""
        found = np.zeros((len(boxes), 2, self.grid**2 * ORIENTATIONS), np.float32)
        contrast = np.zeros(len(boxes))
        describe(view.integral, boxes - view.corner, self.grid, self.rim, found, contrast)
        return found, contrast

    def _colors(self, image: Image, box: Array) -> tuple[Array, Array]:
        """Histograms inside a box and in its surroundings."""
        rim = self.rim * box[2:]
        around = np.concatenate([box[:2] - rim, box[2:] + 2.0 * rim])
        inside, both = color_histogram(image, box, self.bins), color_histogram(image, around, self.bins)
        share = float(box[2] * box[3] / (around[2] * around[3]))
        return inside, np.maximum(both - share * inside, 0.0) / (1.0 - share)

    def _remember(
        self, state: PlusState, image: Image, pose: Pose, hidden: bool, features: FloatArray, contrast: float
    ) -> PlusState:
        """The next state: hidden objects teach nothing and keep going ever more slowly."""
        after = state._replace(pose=pose, frame=state.frame + 1)
        if hidden:
            return after._replace(velocity=self.braking * state.velocity, lost=min(1.0, state.lost + _LOSING))
        inside, outside = self._colors(image, pose.box)
        rate = self.update_rate
        return after._replace(
            velocity=0.5 * (state.velocity + pose.center - state.pose.center),
            inside=(1.0 - rate) * state.inside + rate * inside,
            # What is around changes as the object moves on.
            outside=(1.0 - 2.0 * rate) * state.outside + 2.0 * rate * outside,
            recent=(1.0 - rate) * state.recent + np.float32(rate) * features,
            contrast=(1.0 - rate) * state.contrast + rate * contrast,
            lost=0.5 * state.lost,
        )


def _chances(inside: Array, outside: Array) -> FloatArray:
    """That a pixel of each color is the object's, 0 to 1; a half where neither has the color."""
    return ((inside + _UNSEEN) / (inside + outside + 2.0 * _UNSEEN)).astype(np.float32)


_LOSING = 0.15
"""Each hidden frame makes it so much surer that the object is out of sight."""
_LEAST_CONTRAST = 0.05
"""An object of less contrast than this is judged as if it had this."""
_UNSEEN = 1e-3
"""Share of a color below which it tells little."""


def _weights(similarity: Array, sharpness: float) -> Array:
    weights = np.exp(sharpness * (similarity - similarity.max()))
    return weights / weights.sum()
