"""Dark and noisy pictures: brightened and averaged, so that thresholds in gray levels still separate people from noise.

In a dark picture people differ from the background by less than the threshold, and only their bright parts are found.
In a noisy one the threshold cuts people to pieces. Brightening restores the contrast, and a mean over a square of k x k
pixels reduces independent noise by the factor k.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from servotrack.estimators.detect.difference import levels_of_sample, rounded
from servotrack.estimators.types import FloatArray, Image


class DimRules(NamedTuple):
    """Conditions under which pictures are brightened or averaged.

    Attributes:
        target: Median of the brightest channel that a dark picture is brightened to, gray levels.
        most: Largest gain.
        least: Smallest gain that is worth it, and smallest ratio of two gains.
        black: Median below which a picture shows nothing that could be brightened, gray levels.
        noisy: Noise, after the gain, from which pictures are averaged over 3 x 3 pixels, gray levels: the quantile
            `NoiseRules.quiet` of the difference to the background. Raising it leaves more noise and more detail.
        grainy: Noise from which they are averaged over 5 x 5 pixels.
        above: Threshold of foreground relative to the noise of averaged pictures, at least.
        changes: Relative change of the brightness between two measurements from which the light changes, so that
            nothing is decided.
        stride: Distance of the sampled pixels, px.
    """

    target: float = 75.0
    most: float = 3.0
    least: float = 1.5
    black: float = 8.0
    noisy: float = 15.0
    grainy: float = 40.0
    above: float = 1.5
    changes: float = 0.1
    stride: int = 7


class View(NamedTuple):
    """Treatment of the pictures.

    Attributes:
        side: Side of the square over which pixels are averaged, px; 1 for none.
        gain: Factor of the gray levels.
    """

    side: int = 1
    gain: float = 1.0


def viewed(image: Image, view: View) -> Image:
    """Return a picture as the detector sees it; the same one with the plain view.

    Args:
        image: Picture. Shape (H, W, 3) or (H, W), uint8.
        view: Treatment.
    """
    if view.side > 1:
        image = np.asarray(cv2.blur(image, (view.side, view.side)), dtype=np.uint8)
    return image if view.gain == 1.0 else np.asarray(cv2.convertScaleAbs(image, alpha=view.gain), dtype=np.uint8)


def next_view(view: View, brightness: float, noise: float, rules: DimRules) -> View:
    """Return the view for what was measured with a view. The side never falls: a measured noise is of averaged pixels.

    Args:
        view: Present view.
        brightness: Median of the brightest channel of the background in this view, gray levels.
        noise: Noise in this view, gray levels.
        rules: Conditions.
    """
    raw, gain = brightness / view.gain, view.gain
    if raw >= rules.black:
        wanted = min(max(rules.target / raw, 1.0), rules.most)
        gain = wanted if max(wanted / gain, gain / wanted) >= rules.least else gain
    expected = noise * view.side * gain / view.gain
    side = 5 if expected >= rules.grainy else 3 if expected >= rules.noisy else 1
    return View(max(side, view.side), gain)


def first_view(frames: list[Image], background: FloatArray, quiet: float, rules: DimRules) -> View:
    """Return the view for some frames of a scene.

    Args:
        frames: Frames with the shape of the background, uint8.
        background: Median of the frames. Shape (H, W, 3) or (H, W), float32.
        quiet: Quantile of the difference that counts as noise, in (0, 1).
        rules: Conditions.
    """
    known = rounded(background)
    flat, outside = known.reshape((*known.shape[:2], -1)), np.zeros(known.shape[:2], np.uint8)
    levels, brightness = [], 0.0
    for frame in frames:
        difference = cv2.absdiff(frame, known)
        difference = difference.max(axis=2) if difference.ndim == 3 else difference
        # The lower half of the differences is background even in a crowd. With it goes the quantile of normal noise.
        brightness, level, _ = levels_of_sample(flat, difference, outside, rules.stride, 0.5)
        levels.append(level)
    noise = float(np.median(levels)) * _normal_ratio(quiet, flat.shape[2])
    return next_view(View(), brightness, noise, rules)


def _normal_ratio(quiet: float, channels: int) -> float:
    """Ratio of a quantile to the median of the largest of some independent normal absolute values."""
    sample = np.abs(np.random.default_rng(0).normal(size=(4096, channels))).max(axis=1)
    return float(np.quantile(sample, quiet) / np.median(sample))


def in_view(background: FloatArray, before: View, after: View) -> FloatArray:
    """Return a background that was learned in another view.

    Args:
        background: Background in the view `before`. Shape (H, W, 3) or (H, W), float32.
        before: View so far.
        after: New view.
    """
    if after.side > before.side:
        background = np.asarray(cv2.blur(background, (after.side, after.side)), dtype=np.float32)
    return background * np.float32(after.gain / before.gain)


def dim_notice(view: View, brightness: float, threshold: float) -> str:
    """Return a sentence on a dark or noisy picture; empty for others.

    Args:
        view: Present view.
        brightness: Median of the brightest channel of the background in this view, gray levels.
        threshold: Difference from which a pixel is foreground, gray levels.
    """
    remedy = "use more light, a longer exposure, or a detector for dark pictures, such as --detector model.onnx"
    if brightness < threshold:
        return (
            f"the picture is dark: half of it is below {threshold / view.gain:.0f} gray levels, where nothing that is "
            f"darker can be found; {remedy}"
        )
    if view.gain > 1.0:
        return (
            f"the picture is dark: half of it is below {brightness / view.gain:.0f} gray levels; it is brightened, and "
            f"small or faint people are missed; {remedy}"
        )
    if view.side > 1:
        return (
            f"the picture is noisy: it is averaged over {view.side} x {view.side} px, and small or faint people are "
            "missed; use more light, a lower gain of the camera, or less compression"
        )
    return ""
