"""Monte Carlo tracking with further features, as suggested in the last section of Zhang and Li 2008."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.color.cells import (
    CHANNELS,
    ORIENTATIONS,
    cell_weights,
    compare,
    describe,
    integrate_channels,
)
from servotrack.estimators.color.contract import (
    BoxEstimate,
    Pose,
    check_fields,
    checked_frame,
    normals,
    start,
    uniforms,
)
from servotrack.estimators.color.histogram import color_histogram
from servotrack.estimators.color.light import Light, LightMeter, relit_histogram
from servotrack.estimators.color.turned_views import TurnedViews, turned_sizes, turned_views
from servotrack.estimators.elementary import exponential
from servotrack.estimators.types import Array, FloatArray, Image, Labels


class View(NamedTuple):
    """Part of a frame.

    Attributes:
        integral: Integral image from `integrate_channels`.
        corner: Left and top of the part, then zeros. Shape (4,), px.
    """

    integral: FloatArray
    corner: Array


class PlusState(NamedTuple):
    """Memory of a `MonteCarloColorPlus`.

    Attributes:
        pose: The last estimate.
        angle: Angle by which the object has turned in the image plane since the first frame, rad.
        velocity: Changes of the center and of the angle from frame to frame, shape (3,), px and rad.
        inside: Histogram of the object's colors, shape (bins ** 3,).
        outside: Histogram of the colors around it, shape (bins ** 3,).
        first: Features of the first box, turned by each of the angles.
        recent: Running mean of the features, shape (2, f). It adapts faster while the light changes.
        contrast: Running mean of the contrast of the object with its surroundings.
        lost: Degree of belief that the object is hidden, 0 to 1.
        frame: Number of frames so far.
        light: Light of the last frame.
        colored: Logarithm of the gains at which `inside` and `outside` are, shape (3,).
        clear: Share of the object that is not saturated under these gains, 0 to 1.
    """

    pose: Pose
    angle: float
    velocity: Array
    inside: Array
    outside: Array
    first: TurnedViews
    recent: FloatArray
    contrast: float
    lost: float
    frame: int
    light: Light
    colored: Array
    clear: float


@dataclass(frozen=True)
class MonteCarloColorPlus:
    """Monte Carlo tracking by gradients, spatial colors, and contrast with the surroundings.

    Differences from `MonteCarloColor`:

    * A candidate is described by gradient directions and colors in a grid of cells, so that the position of a color
      counts.
    * The contrast determines the scale: the mean probability that a pixel belongs to the object rather than to its
      surroundings, inside the box minus around it.
    * The object may turn in the image plane: a candidate has an angle, its box is that of the turned ellipse, and it is
      compared with the first box turned by the nearest of `angles`.
    * Candidates are drawn about the predicted position, first widely, then closely about the best ones.
    * The reference combines the first frame with recent frames and is not updated while the object seems hidden.
    * The light is estimated from the whole frame, and the first frame is compared as it would look under it. Where the
      light saturates most of the object, recent frames take the place of the first one, the corners of the box count
      less, and scale and angle stay. While the light stays, none of this has an effect.
    * While the object is lost, some candidates are drawn far away, where only a good match is believed.

    The values were chosen on tune seeds of `ColorTracking-v0`.

    Attributes:
        samples: Number of candidates per frame, half of them drawn widely. Raising it costs time and reduces noise.
        center_deviation: Standard deviation of wide candidates' centers, as a share of the box's size. Raising it
            follows faster motion with more noise.
        scale_deviation: Standard deviation of their scales, as a share of the last one. Raising it follows faster
            growth with more noise.
        angle_deviation: Standard deviation of their angles, rad. Raising it follows faster turns with more noise.
        angles: Number of directions in which the first box is remembered; 1 for objects that stay upright, whose frames
            then cost less.
        narrowing: Factor on these deviations for the other half of the candidates.
        sharpness: Weights are exp(sharpness * similarity). Raising it concentrates them on the best candidates.
        gradient_share: Share of gradients in the similarity; colors have `color_share`, contrast the rest.
        color_share: Share of spatial colors in the similarity.
        inertia: Share of the last velocity in the predicted motion.
        update_rate: Weight of a new frame in the reference while the object is visible.
        loyalty: Share of the first frame's features in the reference; recent frames have the rest.
        hidden_below: Similarity below which the object counts as hidden. Raising it follows occluding objects less,
            and coasts more often.
        widening: Largest relative widening of the candidates' spread while the object is hidden.
        braking: Factor on the velocity in each frame while the object is hidden.
        grid: Number of cells per side.
        rim: Width of the surroundings, as a share of the box.
        bins: Number of bins of each color channel.
        seed: Seed; the random numbers depend only on it and on the number of the frame.
        losing: Increase of `PlusState.lost` in each hidden frame. Raising it widens the search sooner.
        least_contrast: Lower limit of the reference contrast in the comparison of contrasts.
        rare_color: Share added to both histograms in the ratio of colors. Raising it gives rare colors less influence.
        light_tolerance: Change of the light, as a logarithm, from which the reference is drawn anew. Raising it saves
            time and compares less exactly.
        light_adaptation: Rate at which recent features follow a change of the light, per unit of its logarithm. Raising
            it follows the light faster and learns more from what merely passes by.
        saturated_corners: Weight that the corners of the box lose where the whole object is saturated. Raising it
            ignores more of what lies behind the object.
        saturated_relief: Share by which `hidden_below` is lower where the whole object is saturated. Raising it coasts
            less often then.
        lost_above: Value of `PlusState.lost` above which the object counts as lost. Raising it searches later.
        roaming: Share of the wide candidates that are drawn within `roaming_reach` while the object is lost. Raising it
            finds the object sooner where it comes back elsewhere, and less exactly where it comes back near.
        roaming_reach: Largest distance of these candidates along each axis, as a share of the object's longer side.
            Raising it finds the object farther away and costs time and memory.
        found_above: Similarity from which a lost object is found farther than `reach` from where it is expected.
            Raising it confuses it less with other objects, and finds it later.
        reach: This distance, as a share of the object's size.
        meter: Estimator of the light.
    """

    samples: int = 200
    center_deviation: float = 0.16
    scale_deviation: float = 0.08
    angle_deviation: float = 0.1
    angles: int = 32
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
    losing: float = 0.15
    least_contrast: float = 0.05
    rare_color: float = 1e-3
    light_tolerance: float = 0.1
    light_adaptation: float = 2.0
    saturated_corners: float = 0.75
    saturated_relief: float = 0.3
    lost_above: float = 0.95
    roaming: float = 0.5
    roaming_reach: float = 4.0
    found_above: float = 0.75
    reach: float = 1.5
    meter: LightMeter = field(default_factory=LightMeter)

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        check_fields(
            self,
            counts=("samples", "grid", "angles"),
            positive=(
                "center_deviation", "scale_deviation", "angle_deviation", "narrowing", "sharpness", "rim",
                "least_contrast", "rare_color", "light_tolerance", "reach", "roaming_reach",
            ),
            shares=(
                "gradient_share", "color_share", "inertia", "update_rate", "loyalty", "hidden_below", "braking",
                "losing", "saturated_corners", "saturated_relief", "roaming", "found_above", "lost_above",
            ),
        )  # fmt: skip
        if self.samples < 2:
            raise ValueError(f"samples must be at least 2, a wide and a close one, got {self.samples!r}")
        if self.gradient_share + self.color_share > 1.0:
            raise ValueError(
                "gradient_share + color_share must be at most 1, contrast has the rest, got "
                f"{self.gradient_share!r} + {self.color_share!r}"
            )
        for name in ("widening", "light_adaptation"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {getattr(self, name)!r}")

    def initial(self, frame: ArrayLike, box: ArrayLike) -> PlusState:
        """Compute the object's features; arguments and errors as in `MonteCarloColor.initial`."""
        image, first, pose = start(frame, box)
        inside, outside = self._colors(image, first)
        chances = self._chances(inside, outside)
        features, contrast = self._describe(self._view(image, first[None], chances), first[None], 1.0)
        views = turned_views(image, first, self.angles, self.grid)
        return PlusState(
            pose,
            0.0,
            np.zeros(3),
            inside,
            outside,
            views,
            features[0],
            float(contrast[0]),
            lost=0.0,
            frame=1,
            light=self.meter.initial(image),
            colored=np.zeros(3),
            clear=1.0,
        )

    def step(self, state: PlusState, frame: ArrayLike) -> tuple[PlusState, BoxEstimate]:
        """Find the object in the next frame; arguments and errors as in `MonteCarloColor.step`."""
        last = state.pose
        image = checked_frame(frame, last.shape)
        state, change = self._under(state, self.meter.next(state.light, image))
        half = self.samples // 2
        noise = normals(self.seed, state.frame, (self.samples, 4))
        expected = np.array([*last.center, last.scale, state.angle])
        expected[[0, 1, 3]] += self.inertia * state.velocity
        wide = self._draw(last, noise[:half], expected, 1.0 + self.widening * state.lost, state.clear)
        if state.lost > self.lost_above:
            roaming = int(self.roaming * half)
            moves = (
                self.roaming_reach
                * last.scale
                * last.size.max()
                * (2.0 * uniforms(self.seed, state.frame, (roaming, 2)) - 1.0)
            )
            wide[half - roaming :, :2] = last.within(last.center + moves)
        # One candidate is the prediction itself, so that a still object is matched exactly.
        wide[0] = expected
        boxes = self._boxes(last, wide)
        view = self._view(image, boxes, self._chances(state.inside, state.outside))
        # The other candidates and the estimate lie among the angles of these.
        views = state.first.under(
            state.light.gains, self._nearest(wide[:, 3]), self.light_tolerance, self._corners(state.clear)
        )
        state = state._replace(first=views)
        coarse = self._similarity(view, state, boxes, wide)
        about = _weights(coarse, self.sharpness) @ wide
        close = self._draw(last, noise[half:], about, self.narrowing, state.clear)
        candidates = np.concatenate([wide, close])
        boxes = np.concatenate([boxes, self._boxes(last, close)])
        similarity = np.concatenate([coarse, self._similarity(view, state, boxes[half:], close)])
        weights = _weights(similarity, self.sharpness)
        found = (weights @ candidates)[None]
        estimated = self._boxes(last, found)
        own = float(self._similarity(view, state, estimated, found)[0])
        far = np.abs(found[0, :2] - expected[:2]).max() > self.reach * last.scale * np.sqrt(last.size.prod())
        hidden = bool(own < self.hidden_below * (1.0 - self.saturated_relief * (1.0 - state.clear)))
        hidden = hidden or bool(state.lost > self.lost_above and far and own < self.found_above)
        if hidden:
            # An occluding object must not attract the estimate, which follows the prediction.
            found = expected[None]
            found[0, :2] = last.within(expected[:2])
            estimated = self._boxes(last, found)
        box = estimated[0]
        pose = last._replace(center=found[0, :2], scale=float(found[0, 2]))
        after = state._replace(pose=pose, angle=float(found[0, 3]), frame=state.frame + 1)
        if hidden:
            # The reference stays, and the velocity decreases.
            lost = min(1.0, state.lost + self.losing)
            after = after._replace(velocity=self.braking * state.velocity, lost=lost)
        else:
            after = self._remember(state, after, image, view, box, change)
        return after, BoxEstimate(box, min(max(own, 0.0), 1.0), boxes, weights)

    def _under(self, state: PlusState, light: Light) -> tuple[PlusState, float]:
        """The state with its colors under the light of the next frame, and the change of the light."""
        step = float(np.abs(light.gains - state.light.gains).max())
        state = state._replace(light=light)
        change = light.gains - state.colored
        if np.abs(change).max() <= self.light_tolerance:
            return state, step
        after = state._replace(
            inside=relit_histogram(state.inside, change, self.bins),
            outside=relit_histogram(state.outside, change, self.bins),
            colored=light.gains,
            clear=state.first.unsaturated(light.gains),
        )
        return after, step

    def _corners(self, clear: float) -> float:
        return 1.0 - self.saturated_corners * (1.0 - clear)

    def _draw(self, last: Pose, noise: Array, middle: Array, width: float, clear: float) -> Array:
        """Candidates as rows of center x, y, scale and angle, drawn about the middle one.

        The less of the object is clear, the less its scale and its angle change.
        """
        spread = width * self.center_deviation * middle[2] * float(np.sqrt(last.size[0] * last.size[1]))
        drawn = np.empty((len(noise), 4))
        drawn[:, :2] = last.within(middle[:2] + spread * noise[:, :2])
        deviation = clear * min(width, 1.0) * self.scale_deviation
        drawn[:, 2] = last.bounded(middle[2] * exponential(deviation * noise[:, 2]))
        drawn[:, 3] = middle[3]
        if self.angles > 1:
            drawn[:, 3] += clear * width * self.angle_deviation * noise[:, 3]
        return drawn

    def _boxes(self, last: Pose, candidates: Array) -> Array:
        """Boxes of candidates (n, 4): those around the ellipse that fills the first box, turned."""
        size = candidates[:, 2:3] * turned_sizes(last.size, candidates[:, 3])
        return np.concatenate([candidates[:, :2] - 0.5 * size, size], axis=1)

    def _similarity(self, view: View, state: PlusState, boxes: Array, candidates: Array) -> Array:
        """Similarity (n,) of candidates (n, 4) with their boxes."""
        alike, contrast = np.empty((len(boxes), 2)), np.empty(len(boxes))
        compare(
            view.integral,
            boxes - view.corner,
            self.grid,
            self.rim,
            cell_weights(self.grid, self._corners(state.clear)),
            state.first.features,
            self._nearest(candidates[:, 3]),
            state.recent,
            np.float32(self.loyalty * state.clear),
            alike,
            contrast,
        )
        # A box that is too large and one that is too small both have less contrast or more than the object.
        relative = 1.0 - np.minimum(np.abs(1.0 - contrast / max(state.contrast, self.least_contrast)), 2.0)
        rest = 1.0 - self.gradient_share - self.color_share
        return self.gradient_share * alike[:, 0] + self.color_share * alike[:, 1] + rest * relative

    def _nearest(self, angles: Array) -> Labels:
        return np.rint(angles * (self.angles / (2.0 * np.pi))).astype(np.int64) % self.angles

    def _view(self, image: Image, boxes: Array, chances: FloatArray) -> View:
        """Integrate the part of a frame that contains boxes with their surroundings."""
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

    def _describe(self, view: View, boxes: Array, corners: float) -> tuple[FloatArray, Array]:
        """Features (n, 2, f) and contrast (n,) of boxes whose corners have the given weight."""
        weights = cell_weights(self.grid, corners)
        found = np.zeros((len(boxes), 2, self.grid**2 * ORIENTATIONS), np.float32)
        contrast = np.zeros(len(boxes))
        describe(view.integral, boxes - view.corner, self.grid, self.rim, weights, found, contrast)
        return found, contrast

    def _chances(self, inside: Array, outside: Array) -> FloatArray:
        """Probability of each color to belong to the object, 0 to 1; one half for a color of neither histogram."""
        return ((inside + self.rare_color) / (inside + outside + 2.0 * self.rare_color)).astype(np.float32)

    def _colors(self, image: Image, box: Array) -> tuple[Array, Array]:
        """Histograms inside a box and in its surroundings."""
        rim = self.rim * box[2:]
        around = np.concatenate([box[:2] - rim, box[2:] + 2.0 * rim])
        inside, both = color_histogram(image, box, self.bins), color_histogram(image, around, self.bins)
        share = float(box[2] * box[3] / (around[2] * around[3]))
        return inside, np.maximum(both - share * inside, 0.0) / (1.0 - share)

    def _remember(
        self, before: PlusState, after: PlusState, image: Image, view: View, box: Array, change: float
    ) -> PlusState:
        """State after a frame in which the object was seen: its velocity and the new reference."""
        features, contrast = self._describe(view, box[None], self._corners(after.clear))
        inside, outside = self._colors(image, box)
        rate = self.update_rate
        fast = 1.0 - (1.0 - rate) * float(exponential(-self.light_adaptation * change))
        moved = np.array([*(after.pose.center - before.pose.center), after.angle - before.angle])
        return after._replace(
            velocity=0.5 * (before.velocity + moved),
            inside=(1.0 - rate) * before.inside + rate * inside,
            # The surroundings change faster, as the object moves.
            outside=(1.0 - 2.0 * rate) * before.outside + 2.0 * rate * outside,
            recent=np.float32(1.0 - fast) * before.recent + np.float32(fast) * features[0],
            contrast=(1.0 - rate) * before.contrast + rate * float(contrast[0]),
            lost=0.5 * before.lost,
        )


def _weights(similarity: Array, sharpness: float) -> Array:
    weights = exponential(sharpness * (similarity - similarity.max()))
    return weights / weights.sum()
