"""Detector of people from above on a floor of one material, from single frames.

Most of every image is floor: pixels that differ from the floor's color, or are much darker or brighter than the floor
around them, belong to people. The detector needs no background of earlier frames, so it is independent of the camera's
motion. The filter behind it compensates that motion by the image Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.images import checked_stack
from servotrack.estimators.follow.follower import COLUMNS
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import LIMITS, as_numbers


@dataclass(frozen=True)
class PeopleFromAbove:
    """Detector of people in images of a floor from above.

    Args:
        chroma: Smallest difference of a color channel from the floor's at the same brightness, gray levels. Raising it
            gives less foreground.
        dark: Ratio of a pixel's brightness to that of the floor around it below which it is foreground.
        bright: Ratio of a pixel's brightness to that of the floor around it above which it is foreground.
        surroundings: Width of the square that counts as the floor around, as a share of the image's width.
        smallest: Area of the smallest person, in squares of a person's width. Raising it ignores larger specks.
        usual: Usual area of one person, in squares of a person's width. A larger region is divided among as many people
            as it has multiples of this area.
        capacity: Largest number of detections per image; the largest regions are kept.
        reference_size: Width of the image in whose pixels detections are reported, px.
        unlit: Pixels of less brightness show no floor (outside the lens), gray levels.
        core: Radius about the middle within which a person's color is measured, in a person's widths.
        dim: Brightness above which the required difference grows in proportion to the brightness, gray levels.
        rounds: Number of iterations of Lloyd's algorithm that divides a region among several people.

    Raises:
        ValueError: An argument is out of range.
    """

    chroma: float = 14.0
    dark: float = 0.55
    bright: float = 1.6
    surroundings: float = 0.32
    smallest: float = 0.15
    usual: float = 0.6
    capacity: int = 24
    reference_size: float = 480.0
    unlit: float = 8.0
    core: float = 0.45
    dim: float = 60.0
    rounds: int = 6

    def __post_init__(self) -> None:
        for name, low, high in (
            ("chroma", 0.0, 255.0),
            ("dark", 0.0, 1.0),
            ("bright", 1.0, 100.0),
            ("surroundings", 0.0, 1.0),
            ("smallest", 0.0, 1.0),
            ("usual", 0.0, 1.0),
            ("unlit", 0.0, 255.0),
            ("core", 0.0, 10.0),
            ("dim", 0.0, 255.0),
        ):
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(f"{name} must lie in ({low:g}, {high:g}], got {value!r}")
        for name in ("capacity", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")

    def detect(self, images: ArrayLike, widths: ArrayLike) -> Array:
        """Detect people in square images.

        Args:
            images: RGB, uint8. Shape (*batch, S, S, 3).
            widths: Width of a person in each image. Shape (*batch,), px of `reference_size`.

        Returns:
            Existence (0 or 1); column and row of the middle, width, height, px of `reference_size`; mean red, green,
            blue, gray levels. Shape (*batch, capacity, 8), unused rows zero.

        Raises:
            ValueError: Images have another shape or type, or widths are not positive and finite.
        """
        pixels, width = checked_stack(images, square=True), as_numbers("widths", widths)
        batch = pixels.shape[:-3]
        if width.shape != batch or not np.all((width > 0.0) & (width <= LIMITS.boxes)):
            raise ValueError(
                f"widths must be finite and > 0 px, one for each image {batch}, at most {LIMITS.boxes:g}, got "
                f"{width.tolist()}; pass the width of a person in px of reference_size"
            )
        flat = zip(pixels.reshape(-1, *pixels.shape[-3:]), width.ravel().tolist(), strict=True)
        return np.stack([self._detect(*pair) for pair in flat]).reshape(*batch, self.capacity, COLUMNS)

    def _detect(self, image: NDArray[np.uint8], width: float) -> Array:
        side = image.shape[0]
        found = np.zeros((self.capacity, COLUMNS))
        smooth = cv2.GaussianBlur(image, (3, 3), 0)
        brightness = smooth.mean(axis=2, dtype=np.float32)
        floor = brightness >= self.unlit
        if not floor.any():
            return found
        # A coarse grid of pixels suffices for the median, unless all that is lit lies between its points.
        coarse = np.s_[1::3, 1::3] if floor[1::3, 1::3].any() else np.s_[:, :]
        hue = np.median(smooth[coarse][floor[coarse]], axis=0)
        window = max(3, int(self.surroundings * side) | 1)
        weight = floor.astype(np.float32)
        around = cv2.blur(brightness * weight, (window, window)) / np.maximum(cv2.blur(weight, (window, window)), 1e-3)
        mask = np.empty((side, side), np.uint8)
        limits = self.chroma, self.dark, self.bright, float(self.unlit), float(self.dim)
        _differs(smooth, brightness, around, hue / max(float(hue.mean()), 1.0), limits, mask)
        _, labels, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
        areas = boxes[1:, cv2.CC_STAT_AREA]
        scale = self.reference_size / side
        square = (width / scale) ** 2
        used = 0
        for component in 1 + np.argsort(-areas, kind="stable"):
            area = boxes[component, cv2.CC_STAT_AREA]
            if area < self.smallest * square:
                break
            left, top, wide, high = boxes[component, :4].tolist()
            window_of = np.s_[top : top + high, left : left + wide]
            rows, columns = np.nonzero(labels[window_of] == component)
            place = np.stack([columns + left + 0.5, rows + top + 0.5], axis=-1)
            color = image[window_of][rows, columns].astype(np.float64)
            # More parts than are kept would cost time without end where a person's width is tiny.
            number = min(max(1, int(min(area / (self.usual * square) + 0.35, self.capacity))), self.capacity)
            owner = _parts(place, number, self.rounds)
            for part in range(number):
                mine = owner == part
                if used == self.capacity or mine.sum() < self.smallest * square:
                    continue
                spot = place[mine]
                found[used, 0] = 1.0
                middle = spot.mean(axis=0)
                core = np.hypot(*(spot - middle).T) < self.core * width / scale
                found[used, 1:3] = scale * middle
                found[used, 3:5] = scale * (np.ptp(spot, axis=0) + 1.0)
                found[used, 5:] = color[mine][core if core.any() else slice(None)].mean(axis=0)
                used += 1
        return found


@njit(cache=True, nogil=True)
def _differs(smooth, brightness, around, hue, limits, mask):  # type: ignore[no-untyped-def]
    """Mark the pixels that differ from the floor."""
    chroma, dark, bright, unlit, dim = limits
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            light = brightness[i, j]
            mask[i, j] = 0
            if light < unlit:
                continue
            gain = min(light, dim) / light
            off = 0.0
            for channel in range(3):
                off = max(off, abs(smooth[i, j, channel] - light * hue[channel]))
            if off * gain > chroma or light < dark * around[i, j] or light > bright * around[i, j]:
                mask[i, j] = 1


def _parts(place: Array, number: int, rounds: int) -> Labels:
    """Divide pixels among people by position only: Lloyd's algorithm, initialized along the longest axis.

    Division by color would separate a person's hair from their coat.
    """
    if number == 1:
        return np.zeros(len(place), np.int64)
    centered = place - place.mean(axis=0)
    _, axes = np.linalg.eigh(centered.T @ centered)
    along = centered @ axes[:, -1]
    owner = np.minimum((number * np.argsort(np.argsort(along)) / len(along)).astype(np.int64), number - 1)
    for _ in range(rounds):
        mine = [place[owner == part] for part in range(number)]
        middles = np.stack([spot.mean(axis=0) if len(spot) else place[0] for spot in mine])
        owner = ((place[:, None] - middles) ** 2).sum(axis=2).argmin(axis=1)
    return owner
