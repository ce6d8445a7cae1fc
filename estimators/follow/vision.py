"""Detector of people from above on a floor of one material, from single frames.

Most of every image is floor: pixels that differ from the floor's color, or are much darker or brighter than the floor
around them, belong to people. Two bodies keep a distance, so pieces that are nearer are one person, and a region that
one body cannot fill is divided. The detector needs no background of earlier frames, so it is independent of the
camera's motion. The filter behind it compensates that motion by the image Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.images import checked_stack
from servotrack.estimators.follow.follower import COLUMNS
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers


@dataclass(frozen=True)
class PeopleFromAbove:
    """Detector of people in images of a floor from above.

    Args:
        chroma: Smallest difference of a color channel from the floor's at the same brightness, gray levels. Raising it
            gives less foreground.
        noise: The same, in medians of that difference over the image: a noisy image has a higher limit.
        dark: Ratio of a pixel's brightness to that of the floor around it below which it is foreground.
        bright: Ratio of a pixel's brightness to that of the floor around it above which it is foreground. Raising it
            misses people in white.
        surroundings: Width of the square that counts as the floor around, as a share of the image's width.
        smallest: Area of the smallest person, in squares of a person's width. Raising it ignores larger specks.
        largest: Area that one person at most has, in squares of a person's width. A larger region is divided.
        gap: Distance across which pieces belong to one region, in a person's widths. Raising it joins people who pass.
        body: Radius about a person's middle within which most of their pixels lie, in a person's widths.
        inside: Share of a region's pixels that must lie within that radius of the middles, or the region is divided
            further. Raising it divides sooner.
        apart: Smallest distance between two people, in a person's widths: nearer pieces are one person.
        trim: Share of a person's pixels beyond each edge of their box, so that a hand does not widen it.
        capacity: Largest number of detections per image; the largest people are kept.
        pieces: Largest number of pieces of the foreground per detection. Raising it takes longer in images of specks.
        reference_size: Width of the image in whose pixels detections are reported, px.
        unlit: Pixels of less brightness show no floor (outside the lens), gray levels.
        core: Radius about the middle within which a person's color is measured, in a person's widths.
        rounds: Number of iterations of Lloyd's algorithm that divides a region among several people.

    Raises:
        ValueError: An argument is out of range.
    """

    chroma: float = 7.0
    noise: float = 6.0
    dark: float = 0.55
    bright: float = 1.45
    surroundings: float = 0.32
    smallest: float = 0.2
    largest: float = 1.35
    gap: float = 0.12
    body: float = 0.6
    inside: float = 0.74
    apart: float = 0.8
    trim: float = 0.06
    capacity: int = 24
    pieces: int = 4
    reference_size: float = 480.0
    unlit: float = 8.0
    core: float = 0.45
    rounds: int = 6

    def __post_init__(self) -> None:
        for name, low, high in (
            ("chroma", 0.0, 255.0),
            ("noise", 0.0, 255.0),
            ("dark", 0.0, 1.0),
            ("bright", 1.0, 100.0),
            ("surroundings", 0.0, 1.0),
            ("smallest", 0.0, 1.0),
            ("largest", 0.0, 10.0),
            ("gap", 0.0, 1.0),
            ("body", 0.0, 10.0),
            ("inside", 0.0, 1.0),
            ("apart", 0.0, 10.0),
            ("trim", 0.0, 0.4),
            ("unlit", 0.0, 255.0),
            ("core", 0.0, 10.0),
        ):
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(f"{name} must lie in ({low:g}, {high:g}], got {value!r}")
        for name in ("capacity", "pieces", "rounds"):
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
        found = np.zeros((self.capacity, COLUMNS))
        scale = self.reference_size / image.shape[0]
        width = width / scale
        people = self._people(self._foreground(image), width)
        for row, place in zip(found, people, strict=False):
            middle = place.mean(axis=0)
            edges, off = np.sort(place, axis=0), int(self.trim * len(place))
            low, high = edges[off], edges[-1 - off]
            row[0] = 1.0
            row[1:3] = scale * middle
            row[3:5] = scale * (high - low + 1.0)
            row[5:] = _color(image, middle, self.core * width)
        return found

    def _foreground(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Mask of the pixels that do not show the floor, (S, S)."""
        side = image.shape[0]
        smooth = cv2.GaussianBlur(image, (3, 3), 0)
        brightness = smooth.mean(axis=2, dtype=np.float32)
        mask, floor = np.zeros((side, side), np.uint8), brightness >= self.unlit
        # A coarse grid of pixels suffices for medians.
        coarse = np.s_[1::3, 1::3]
        known = smooth[coarse][floor[coarse]]
        if not len(known):
            return mask
        hue = np.median(known, axis=0)
        hue = hue / max(float(hue.mean()), 1.0)
        usual = np.median(np.abs(known - brightness[coarse][floor[coarse]][:, None] * hue).max(axis=1))
        window = max(3, int(self.surroundings * side) | 1)
        weight = floor.astype(np.float32)
        around = cv2.blur(brightness * weight, (window, window)) / np.maximum(cv2.blur(weight, (window, window)), 1e-3)
        limits = max(self.chroma, self.noise * float(usual)), self.dark, self.bright, float(self.unlit)
        _differs(smooth, brightness, around, hue, limits, mask)
        return mask

    def _people(self, mask: NDArray[np.uint8], width: float) -> list[Array]:
        """Pixels of each person, shape (P, 2) each, column and row; the largest person comes first."""
        square, reach = width * width, min(round(self.gap * width), len(mask))
        joined = cv2.dilate(mask, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) if reach else mask
        _, labels, boxes, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
        pieces: list[Array] = []
        for region in 1 + np.argsort(-boxes[1:, cv2.CC_STAT_AREA], kind="stable"):
            if len(pieces) >= self.pieces * self.capacity:
                break
            left, top, wide, high = boxes[region, :4].tolist()
            window = np.s_[top : top + high, left : left + wide]
            rows, columns = np.nonzero((labels[window] == region) & (mask[window] > 0))
            place = np.stack([columns + left + 0.5, rows + top + 0.5], axis=-1)
            number = min(max(1, int(min(len(place) / (self.largest * square), self.capacity))), len(place))
            most = min(self.capacity, len(place))
            owner = _divided(place, number, most, self.rounds, (self.body * width) ** 2, self.inside)
            pieces += [place[owner == part] for part in range(owner.max() + 1) if (owner == part).any()]
        pieces.sort(key=len, reverse=True)
        people: list[Array] = []
        middles = np.empty((0, 2))
        for piece in pieces:
            middle = piece.mean(axis=0)
            distance = np.hypot(*(middles - middle).T)
            if len(people) and distance.min() < self.apart * width:
                nearest = int(distance.argmin())
                people[nearest] = np.concatenate([people[nearest], piece])
            else:
                people.append(piece)
                middles = np.concatenate([middles, middle[None]])
        return sorted((place for place in people if len(place) >= self.smallest * square), key=len, reverse=True)


@njit(cache=True, nogil=True)
def _differs(smooth, brightness, around, hue, limits, mask):  # type: ignore[no-untyped-def]
    """Mark the pixels that differ from the floor."""
    chroma, dark, bright, unlit = limits
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            light = brightness[i, j]
            mask[i, j] = 0
            if light < unlit:
                continue
            off = 0.0
            for channel in range(3):
                off = max(off, abs(smooth[i, j, channel] - light * hue[channel]))
            if off > chroma or light < dark * around[i, j] or light > bright * around[i, j]:
                mask[i, j] = 1


@njit(cache=True, nogil=True)
def _divided(place, number, most, rounds, reach, inside):  # type: ignore[no-untyped-def]
    """Divide pixels among the fewest people whose bodies hold enough of them, by Lloyd's algorithm on positions.

    Division by color would separate a person's hair from their coat.

    Args:
        place: Column and row of each pixel, (P, 2).
        number: Smallest number of people.
        most: Largest number of people.
        rounds: Number of iterations.
        reach: Square of the radius of a body, px^2.
        inside: Share of the pixels within a body that is enough.

    Returns:
        Person of each pixel, (P,).
    """
    count = len(place)
    u, v = place[:, 0] - place[:, 0].mean(), place[:, 1] - place[:, 1].mean()
    angle = 0.5 * np.arctan2(2.0 * (u * v).mean(), (u * u).mean() - (v * v).mean())
    order = np.argsort(np.cos(angle) * u + np.sin(angle) * v)
    owner, middles, sizes = np.zeros(count, np.int64), np.empty((most, 2)), np.empty(most)
    while True:
        for rank in range(count):
            owner[order[rank]] = number * rank // count
        for _ in range(rounds):
            middles[:number], sizes[:number] = 0.0, 0.0
            for i in range(count):
                middles[owner[i]] += place[i]
                sizes[owner[i]] += 1.0
            for part in range(number):
                middles[part] = middles[part] / sizes[part] if sizes[part] > 0.0 else place[0]
            held = 0
            for i in range(count):
                nearest = np.inf
                for part in range(number):
                    du, dv = place[i, 0] - middles[part, 0], place[i, 1] - middles[part, 1]
                    if du * du + dv * dv < nearest:
                        nearest, owner[i] = du * du + dv * dv, part
                held += nearest < reach
            if number == 1:
                break
        if held >= inside * count or number >= most:
            return owner
        number += 1


def _color(image: NDArray[np.uint8], middle: Array, radius: float) -> Array:
    """Mean color of all pixels of a disc, (3,): clothes in the floor's color are missing in the foreground."""
    side = image.shape[0]
    first = np.clip((middle - radius).astype(np.int64), 0, side - 1)
    last = np.clip((middle + radius).astype(np.int64) + 1, first + 1, side)
    window = image[first[1] : last[1], first[0] : last[0]]
    columns, rows = (np.arange(first[axis], last[axis]) + 0.5 - middle[axis] for axis in range(2))
    disc = np.hypot(rows[:, None], columns) < radius
    return window[disc if disc.any() else np.ones_like(disc)].mean(axis=0, dtype=np.float64)
