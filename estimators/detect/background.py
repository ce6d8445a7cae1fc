"""Motion detection by the difference to a background that learns outside the foreground (Wu and Hu 2010, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.detect.blobs import REFERENCE_HEIGHT, BlobFinder, Sizes
from servotrack.estimators.detect.camera_motion import CameraMotion, MotionRules, check_motion, in_doubt
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.detect.difference import (
    above,
    difference_of,
    drop_shadows,
    frames_of_same_light,
    learned,
    levels_of_sample,
    rounded,
    share_above,
    start_of_light,
)
from servotrack.estimators.detect.dim_pictures import (
    DimRules,
    View,
    dim_notice,
    first_view,
    in_view,
    next_view,
    viewed,
)
from servotrack.estimators.detect.exposure import ExposureRules, exposure_line
from servotrack.estimators.detect.faint import FaintRules, add_faint_regions, join_by_faint_regions
from servotrack.estimators.detect.flooding import Flood, FloodRules, follow_flood, returned, unsettled
from servotrack.estimators.detect.healing import HealingRules, heal_regions
from servotrack.estimators.detect.images import checked_image, checked_images
from servotrack.estimators.detect.runs import clear_removed, label_again, label_runs, measure_runs
from servotrack.estimators.detect.soft_light import SoftLightRules, trim_soft_light
from servotrack.estimators.detect.stillness import Stillness, StillRules, absorb_still_regions, no_stillness
from servotrack.estimators.types import Array, FloatArray, Image
from servotrack.estimators.validation import checked_period


class NoiseRules(NamedTuple):
    """Measurement of the noise, with which the lower threshold rises.

    Attributes:
        quiet: Share of the background below the lower threshold. Raising it completes fewer people in noise.
        every: Number of frames between two measurements.
        stride: Distance of the sampled pixels, px.
        rate: Weight of a new measurement.
    """

    quiet: float = 0.9
    every: int = 10
    stride: int = 7
    rate: float = 0.36


class BackgroundState(NamedTuple):
    """State of a `MaskedBackground`; its arrays are never changed in place.

    Attributes:
        background: Background with the shape of a frame, float32, gray levels.
        rounded: Background in uint8.
        mask: Foreground of the last frame after opening and closing, 0 or 255. Shape (H, W), uint8.
        sizes: Heights of people by row.
        frames: Number of frames so far.
        flood: Memory of foreground that covers more than `MaskedBackground.flood` of the image.
        still: Content of the foreground and for how long it has not changed; None without `MaskedBackground.still`.
        noise: Gray levels that most background pixels do not exceed; 0 before they are measured.
        brightness: Median gray level of the background, measured together with the noise.
        view: Treatment of dark and noisy pictures, in which the background is.
        motion: Memory of the checks for a moving camera.
        notice: Sentence on what does not work at the moment, with the remedy; empty if all is well.
    """

    background: FloatArray
    rounded: Image
    mask: Image
    sizes: Sizes
    frames: int
    flood: Flood
    still: Stillness | None
    noise: float
    brightness: float
    view: View
    motion: CameraMotion
    notice: str


class _Regions(NamedTuple):
    """Regions of the foreground of a frame, and the faint regions around them."""

    mask: Image
    runs: NDArray[np.int32]
    number: int
    faint_runs: NDArray[np.int32] | None
    faint_boxes: Array | None


@dataclass(frozen=True)
class MaskedBackground:
    """Background subtraction whose background does not learn under foreground (Wu and Hu 2010, equations 5 and 6).

    P = |I - B| >= threshold and B' = (1 - a) B + a P.B + a (1 - P).I. This rule never absorbs a person who stands
    still. For the same reason it never recovers from a change of light larger than the threshold, nor from people in
    the first frame. `heal_every` corrects both (see `servotrack.estimators.detect.healing`), `flood` the rest.

    Args:
        threshold: Difference from which a pixel is foreground, gray levels, or "otsu" for Otsu's threshold of every
            frame. Raising it gives less foreground.
        least_threshold: Lower limit of Otsu's threshold, gray levels; in an empty scene Otsu's threshold divides noise.
        faint: Lower threshold for slender regions around clear foreground, gray levels; 0 for none. It completes people
            in the background's colors; slender regions cannot join people.
        noise: Rules by which the lower threshold rises with the noise; None for a fixed one.
        learning_rate: Weight a of a new frame, in (0, 1). Raising it adapts faster.
        start: First background from the frames given to `initial`: their "median", or their "mean", as in the paper.
        color: Difference of a pixel: "max" over the channels, or of "gray" values.
        hold: Region where the background does not learn: the "pixels" above the threshold, as in the paper, or the
            "blobs", so that specks are learned and holes in people are not.
        shadows: True to remove pixels that are darker than the background and have its color.
        heal_every: Number of frames between two searches for ghosts and changed light; 0 for never.
        flood: Share of the image above which the foreground cannot be people. Then no detections are reported, and
            after `flood_time` the frame becomes the background. 1 for never.
        flood_time: Time above `flood` in steady light after which the background is replaced, s. Raising it waits
            longer for the light to return.
        flooding: Conditions under which the light is steady, and an earlier background is back.
        blobs: Converts the mask to detections.
        faint_rules: Conditions under which a faint region completes a person.
        healing: Conditions under which a region is a ghost or changed light.
        edges: Share of a region's outline that must be an edge of the ratio of frame and background, 0 to 1. Below it
            soft light is removed from the region: reflections, highlights and soft shadows; from regions wider than a
            person also cast shadows (see `servotrack.estimators.detect.soft_light`). 0 for never. Raising it removes
            more.
        soft_light: Conditions under which foreground is light.
        still: Conditions under which a region that does not move becomes background; None for never.
        motion: Conditions under which the camera moves. Then no detections are reported, and `BackgroundState.notice`
            says so; None for never.
        exposure: Conditions under which the background gets the exposure of a frame, a gain and an offset for the whole
            picture; None for never.
        dim: Conditions under which dark and noisy pictures are brightened and averaged; None for never. Needs `noise`.
        same_light: True to compute the first background only from frames before the first change of light; a fade-in
            from black is left out.
        full_rate: Frames per second above which `learning_rate` and `heal_every` refer to periods of 1 / `full_rate`,
            so that a faster camera does not learn people sooner. Infinity: they always refer to frames.
        frame_rate: Frames per second, where `step` is not given the time between frames.

    Raises:
        ValueError: A parameter is out of range.
    """

    threshold: float | str = 30.0
    least_threshold: float = 15.0
    faint: float = 10.0
    noise: NoiseRules | None = field(default_factory=NoiseRules)
    learning_rate: float = 0.02
    start: str = "median"
    color: str = "max"
    hold: str = "blobs"
    shadows: bool = False
    heal_every: int = 5
    flood: float = 0.4
    flood_time: float = 0.8
    flooding: FloodRules = field(default_factory=FloodRules)
    blobs: BlobFinder = field(default_factory=BlobFinder)
    faint_rules: FaintRules = field(default_factory=FaintRules)
    healing: HealingRules = field(default_factory=HealingRules)
    edges: float = 0.7
    soft_light: SoftLightRules = field(default_factory=SoftLightRules)
    still: StillRules | None = field(default_factory=StillRules)
    motion: MotionRules | None = field(default_factory=MotionRules)
    exposure: ExposureRules | None = field(default_factory=ExposureRules)
    dim: DimRules | None = field(default_factory=DimRules)
    same_light: bool = True
    full_rate: float = 25.0
    frame_rate: float = 25.0

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.threshold != "otsu" and not (isinstance(self.threshold, int | float) and 0.0 < self.threshold <= 255.0):
            raise ValueError(
                f'threshold must be above 0 and at most 255 gray levels, or "otsu", got {self.threshold!r}'
            )
        if not 0.0 < self.least_threshold <= 255.0:
            raise ValueError(f"least_threshold must be above 0 and at most 255, got {self.least_threshold!r}")
        if not 0.0 <= self.faint <= 255.0:
            raise ValueError(f"faint must be at least 0, for none, and at most 255 gray levels, got {self.faint!r}")
        if not 0.0 < self.learning_rate < 1.0:
            raise ValueError(f"learning_rate must lie between 0 and 1, got {self.learning_rate!r}")
        for name, kinds in (("start", ("median", "mean")), ("color", ("max", "gray")), ("hold", ("blobs", "pixels"))):
            if getattr(self, name) not in kinds:
                raise ValueError(f"{name} must be one of {', '.join(kinds)}, got {getattr(self, name)!r}")
        if not (isinstance(self.heal_every, int) and self.heal_every >= 0):
            raise ValueError(f"heal_every must be a whole number of frames, 0 for never, got {self.heal_every!r}")
        if not 0.0 < self.flood <= 1.0:
            raise ValueError(f"flood must be a share above 0 and at most 1, got {self.flood!r}")
        if not 0.0 <= self.edges <= 1.0:
            raise ValueError(f"edges must be a share from 0 to 1, got {self.edges!r}")
        if not self.full_rate > 0.0:
            raise ValueError(f"full_rate must be > 0, infinity for none, got {self.full_rate!r}")
        for name in ("flood_time", "frame_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)!r}")

    @classmethod
    def paper(cls) -> MaskedBackground:
        """Create the paper's detector: mean of the first frames, gray, hold at pixels, one opening, no healing.

        The paper does not give threshold, learning rate and smallest blob.
        """
        return cls(
            threshold=25.0,
            faint=0.0,
            start="mean",
            color="gray",
            hold="pixels",
            heal_every=0,
            flood=1.0,
            noise=None,
            edges=0.0,
            still=None,
            motion=None,
            exposure=None,
            dim=None,
            same_light=False,
            full_rate=math.inf,
            blobs=BlobFinder(opening=3, closing=(1, 1), smallest=40, split=False),
        )

    def initial(self, frames: ArrayLike) -> BackgroundState:
        """Compute the first background.

        Args:
            frames: One frame, RGB of shape (H, W, 3) or gray of shape (H, W), uint8; or several, as an array
                (k, H, W, 3) or a sequence: for the median about 40 frames over a minute or more, so that people who
                pass are removed; for the mean, frames without people.

        Raises:
            ValueError: There is no frame, frames differ in shape, or a frame is not a valid image.
        """
        several, notice = checked_images(frames), ""
        if self.same_light and len(several) > 1:
            change = float(self.least_threshold)
            begin = start_of_light(several, change, self.flood)
            if begin:
                notice = f"the light settles in the first {begin} of the {len(several)} frames for the background; "
                notice += "those after it are used"
                several = several[begin:]
            count = frames_of_same_light(several, change, self.flood)
            if count < len(several):
                notice = (
                    f"the light changes after {count} of the {len(several)} frames for the background; only "
                    "those before it are used"
                )
                several = several[:count]
        first, view = _average(several, self.start), View()
        # The noise of one frame is not known, and brightened noise would flood the picture.
        if len(several) > 1 and self.dim is not None and self.noise is not None:
            view = first_view(several, first, self.noise.quiet, self.dim)
            if view != View():
                first = _average([viewed(frame, view) for frame in several], self.start)
        height, width = int(first.shape[0]), int(first.shape[1])
        mask = np.zeros((height, width), np.uint8)
        still = no_stillness(height, width) if self.still is not None and self.heal_every else None
        return BackgroundState(
            first,
            rounded(first),
            mask,
            self.blobs.initial(),
            0,
            Flood(),
            still,
            0.0,
            255.0,
            view,
            CameraMotion(),
            notice,
        )

    def step(
        self, state: BackgroundState, frame: ArrayLike, dt: float | None = None
    ) -> tuple[BackgroundState, Detections]:
        """Detect in a frame, then learn from it.

        Args:
            state: Result of `initial` or of the last `step`.
            frame: Frame with the shape of the first one, uint8.
            dt: Time since the last frame, s; None for 1 / `frame_rate`.

        Returns:
            State and detections.

        Raises:
            ValueError: The frame is not a valid image, its shape differs, or `dt` is not positive.
        """
        dt = checked_period(dt, self.frame_rate)
        plain = checked_image(frame, shape=state.rounded.shape)
        image, view = viewed(plain, state.view), state.view
        difference = difference_of(image, state.rounded, self.color)
        exposed = self._exposed(state, image, difference)
        if exposed is not state:
            state, difference = exposed, difference_of(image, exposed.rounded, self.color)
        foreground, threshold = self._foreground(difference, image, state)
        noise, level, brightness = self._noise_level(state, difference)
        found = self._regions(difference, foreground, threshold, noise, state.sizes)
        every = max(self.heal_every, round(self.heal_every / (self.full_rate * dt)))
        rate = self.learning_rate * min(self.full_rate * dt, 1.0)
        held = found.runs if self.hold == "blobs" else label_runs(foreground)[0]
        background = learned(image, state.background, held, np.float32(rate))
        frames, still = state.frames + 1, state.still
        if still is not None:
            still = Stillness(still.level, still.age, still.passed + dt)
        share = cv2.countNonZero(found.mask) / found.mask.size
        flood = follow_flood(state.flood, image, state.background, share > self.flood, dt, self.flooding)
        motion = self._motion(state, dt, image, share, found.number)
        if motion.moving:
            # The newest frame, so that nothing old is in the background when the camera stops.
            background, flood = image.astype(np.float32), Flood(flood.passed, flood.steady, flood.light)
        elif returned(flood, image, difference, self.color, threshold, self.flood, self.flooding):
            background, flood = np.array(flood.reserve), Flood()
            found.runs[:, 3] = -1
        elif flood.steady > (self.flooding.memory if flood.dark else self.flood_time) + 0.5 * dt:
            # In the plain view: noise that was brightened may be the flood.
            before = flood.reserve if flood.reserve is None else in_view(flood.reserve, view, View())
            background, flood, view = plain.astype(np.float32), Flood(reserve=before), View()
            found.runs[:, 3] = -1
        elif every and frames % every == 0 and found.number and not flood.dark:
            search = state.frames // every
            still = self._heal(state, image, background, found, threshold, still, dt, search, flood.passed > 0.0)
        if unsettled(flood, self.flooding) or in_doubt(motion):
            found.runs[:, 3] = -1
        elif self.edges and found.number:
            found = self._without_soft_light(found, image, state.rounded, background, threshold, rate)
        sizes, detections = self.blobs.find(state.sizes, found.runs, found.number, image)
        if view != state.view:
            # Both are measured anew.
            noise, brightness = 0.0, 255.0
        elif unsettled(flood, self.flooding):
            # A measurement in this light is none of the noise.
            noise, brightness = state.noise, state.brightness
        elif not (unsettled(state.flood, self.flooding) or in_doubt(motion) or in_doubt(state.motion)):
            view = self._next_view(state, brightness, min(noise, level))
            if view != state.view:
                background, noise, brightness, flood = _changed(background, noise, brightness, flood, state.view, view)
        notice = self._notice(motion, flood.passed, share, dt) or self.blobs.notice(sizes)
        notice = notice or self._darkness(view, brightness)
        return BackgroundState(
            background,
            rounded(background),
            found.mask,
            sizes,
            frames,
            flood,
            still,
            noise,
            brightness,
            view,
            motion,
            notice,
        ), detections

    def _next_view(self, state: BackgroundState, brightness: float, noise: float) -> View:
        """Treatment of the next frames, from a new measurement of brightness and noise.

        In the first frame people are not yet left out of the measurement, and while the light changes it is of no use.
        """
        if self.dim is None or self.noise is None or not state.frames or state.frames % self.noise.every:
            return state.view
        if abs(brightness - state.brightness) > self.dim.changes * state.brightness:
            return state.view
        # Brightened only from a first pass: a background of one dark frame is its noise.
        return next_view(state.view, brightness, noise, self.dim._replace(most=state.view.gain))

    def _exposed(self, state: BackgroundState, image: Image, difference: Image) -> BackgroundState:
        """State whose background has the exposure of a frame; the same state if it has not changed."""
        if self.exposure is None:
            return state
        threshold = self.least_threshold if isinstance(self.threshold, str) else float(self.threshold)
        changed = share_above(difference, 0.5 * threshold, self.exposure.stride)
        if changed <= self.exposure.changed * self.exposure.usable:
            return state
        gain, offset = exposure_line(image, state.rounded, threshold, self.exposure)
        if gain == 1.0 and offset == 0.0:
            return state
        background = state.background * np.float32(gain) + np.float32(offset)
        return state._replace(background=background, rounded=rounded(background))

    def _motion(self, state: BackgroundState, dt: float, image: Image, share: float, regions: int) -> CameraMotion:
        """Memory of the checks for a moving camera; the first frame is checked, then one in each period."""
        motion, rules = state.motion, self.motion
        if rules is None:
            return motion
        motion = CameraMotion(motion.small, motion.checks, motion.moving, motion.speed, motion.passed + dt)
        if motion.small is not None and motion.passed < rules.period - 0.5 * dt:
            return motion
        return check_motion(motion, image, share, regions, rules)

    def _notice(self, motion: CameraMotion, flooded: float, share: float, dt: float) -> str:
        """Sentence on why nothing is reported; empty if something may be."""
        if motion.moving:
            return (
                f"the camera moves by about {motion.speed:.0f} px/s, so that everything differs from the "
                "background; nothing is reported until it stands still; use a detector that needs no background, such "
                "as --detector model.onnx"
            )
        if flooded > max(0.5 * (self.flood_time - dt), 0.0):
            return (
                f"the foreground covers {100.0 * share:.0f} % of the image, more than people can; nothing is reported "
                "until the background is learned anew; if this comes again and again, use a detector that needs no "
                "background, such as --detector model.onnx"
            )
        return ""

    def _darkness(self, view: View, brightness: float) -> str:
        """Sentence on a dark or noisy picture; empty for others."""
        return "" if isinstance(self.threshold, str) else dim_notice(view, brightness, self.threshold)

    def _noise_level(self, state: BackgroundState, difference: Image) -> tuple[float, float, float]:
        """Gray levels that most of the background does not exceed, smoothed and now; and its brightness.

        The brightness is the median of the brightest channel. All are taken from a sample of pixels.
        """
        rules = self.noise
        if rules is None or state.frames % rules.every or unsettled(state.flood, self.flooding):
            return state.noise, state.noise, state.brightness
        known = state.rounded.reshape((*difference.shape, -1))
        brightness, level, count = levels_of_sample(known, difference, state.mask, rules.stride, rules.quiet)
        if count < rules.stride:
            return state.noise, state.noise, brightness
        smooth = level if state.noise == 0.0 else state.noise + rules.rate * (level - state.noise)
        return smooth, level, brightness

    def _regions(self, difference: Image, foreground: Image, threshold: float, noise: float, sizes: Sizes) -> _Regions:
        """Regions of clear foreground, with what belongs to them of the faint foreground."""
        typical = self.blobs.typical_height(sizes)
        # Smallest and largest values of a neighborhood commute with a threshold, so that one pass serves both.
        clean = self.blobs.clean(difference, typical)
        # Without shadows the foreground is no threshold of the difference. Copied, because `hold` needs it unchanged.
        mask = self.blobs.clean(foreground.copy(), typical) if self.shadows else above(clean, threshold)
        faint = max(self.faint, noise) if self.faint > 0.0 else 0.0
        if not 0.0 < faint < threshold:
            return self._joined(mask, label_runs(mask), None, None)
        faint_runs, count = label_runs(above(clean, faint))
        faint_boxes = measure_runs(faint_runs, count)[0]
        rules = self.faint_rules
        if typical:
            seeds = min(rules.seeds, max(round(rules.seeds * (typical / REFERENCE_HEIGHT) ** 2), rules.fewest))
            rules = rules._replace(seeds=seeds)
        add_faint_regions(mask, faint_runs, faint_boxes, rules)
        return self._joined(mask, label_runs(mask), faint_runs, faint_boxes)

    def _joined(
        self,
        mask: Image,
        labeled: tuple[NDArray[np.int32], int],
        faint_runs: NDArray[np.int32] | None,
        faint_boxes: Array | None,
    ) -> _Regions:
        """Regions from labeled runs; parts within one slender faint region get the same index, in place."""
        runs, count = labeled
        if faint_runs is not None:
            join_by_faint_regions(runs, count, faint_runs, faint_boxes, self.faint_rules)
        return _Regions(mask, runs, count, faint_runs, faint_boxes)

    def _heal(
        self,
        state: BackgroundState,
        image: Image,
        background: FloatArray,
        found: _Regions,
        threshold: float,
        still: Stillness | None,
        dt: float,
        search: int,
        flooded: bool,
    ) -> Stillness | None:
        """Correct the background under ghosts, changed light and things that do not move; in place."""
        flat = (*found.mask.shape, -1)
        channels, known = image.reshape(flat), background.reshape(flat)
        # Of foreground that covers the image there is no outline, by which ghosts are known.
        rules = self.healing._replace(ghost_ratio=np.inf) if flooded else self.healing
        heal_regions(channels, known, found.runs, found.number, threshold, rules)
        if still is None or self.still is None or search % self.still.every:
            return still
        level, age = still.level.copy(), still.age.copy()
        boxes, _, _ = measure_runs(found.runs, found.number)
        heights = self.blobs.expected_heights(state.sizes, boxes)
        absorb_still_regions(
            channels,
            known,
            found.runs,
            boxes,
            heights,
            level,
            age,
            still.passed,
            dt,
            threshold,
            self.still,
        )
        return Stillness(level, age, 0.0)

    def _without_soft_light(
        self, found: _Regions, image: Image, known: Image, background: FloatArray, threshold: float, rate: float
    ) -> _Regions:
        """Regions without reflections and soft shadows, which the background learns, in place."""
        flat, mask = (*found.mask.shape, -1), found.mask.copy()
        removed = trim_soft_light(
            image.reshape(flat), known.reshape(flat), background.reshape(flat), found.runs, found.number, mask,
            threshold, self.edges, rate, self.soft_light,
        )  # fmt: skip
        if not removed:
            return found
        clear_removed(mask, found.runs)
        return self._joined(mask, label_again(found.runs), found.faint_runs, found.faint_boxes)

    def _foreground(self, difference: Image, image: Image, state: BackgroundState) -> tuple[Image, float]:
        """Mask of the pixels that differ (equation 5), and the threshold."""
        if isinstance(self.threshold, str):
            found, _ = cv2.threshold(difference, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
            threshold = max(found + 1.0, self.least_threshold)
        else:
            threshold = float(self.threshold)
        if self.dim is not None and state.view.side > 1:
            threshold = max(threshold, self.dim.above * state.noise)
        mask = above(difference, threshold)
        if self.shadows and image.ndim == 3:
            drop_shadows(mask, image, state.rounded, self.soft_light)
        return mask, threshold


def _average(frames: list[Image], kind: str) -> FloatArray:
    """Median or mean of some frames."""
    average = np.median if kind == "median" else np.mean
    return np.array(frames[0] if len(frames) == 1 else average(np.stack(frames), axis=0), dtype=np.float32)


def _changed(
    background: FloatArray, noise: float, brightness: float, flood: Flood, before: View, after: View
) -> tuple[FloatArray, float, float, Flood]:
    """Background, noise, brightness and flood in another view."""
    gain = after.gain / before.gain
    if flood.reserve is not None:
        flood = flood._replace(reserve=in_view(flood.reserve, before, after))
    return in_view(background, before, after), noise * gain * before.side / after.side, brightness * gain, flood
