"""Finds people from above on a floor of one material, in every frame by itself.

Whatever the camera does, most of its image is floor: what differs from the floor's own color, or is much darker or
brighter than the floor around it, is somebody. That needs no background of earlier frames, so the camera's motion does
not matter to the detector; it matters to the filter behind it, which takes it out by the image Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.types import Array, Labels

_COLUMNS = 8
_NO_FLOOR = 8.0  # pixels darker than this are where the lens shows nothing, gray levels
_CORE = 0.45  # radius about the middle within which a person's color is taken, widths
_DIM = 60.0  # colors are told from the floor's in proportion to brightness up to this, gray levels


@dataclass(frozen=True)
class PeopleFromAbove:
    """Detector of people in images of a floor, seen from above.

    Args:
        chroma: By how much a color channel has to differ from the floor's at the same brightness, gray levels.
        dark: Brightness, as a share of that of the floor around, below which a pixel is no floor.
        bright: The same above which it is none.
        surroundings: Width of the square that counts as around, as a share of the image's.
        smallest: Area of the smallest person, in squares of a person's width.
        usual: That of a person alone; a part of the image that is several times as large is so many people.
        capacity: Most detections per image; the largest are kept.
        reference_size: Width of the image in whose pixels detections are told, px.

    Raises:
        ValueError: Naming the argument that is out of range.
    """

    chroma: float = 14.0
    dark: float = 0.55
    bright: float = 1.6
    surroundings: float = 0.32
    smallest: float = 0.15
    usual: float = 0.6
    capacity: int = 24
    reference_size: float = 480.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("chroma", 0.0, 255.0),
            ("dark", 0.0, 1.0),
            ("bright", 1.0, 100.0),
            ("surroundings", 0.0, 1.0),
            ("smallest", 0.0, 1.0),
            ("usual", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(f"{name} must lie in ({low:g}, {high:g}], got {value!r}")
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {self.capacity!r}")

    def detect(self, images: ArrayLike, widths: ArrayLike) -> Array:
        """People in square images.

        Args:
            images: RGB, uint8. Shape (*batch, S, S, 3).
            widths: Width of a person. Shape (*batch,), px of `reference_size`.

        Returns:
            Existence (0 or 1); column and row of the middle, width, height, px of `reference_size`; mean red, green,
            blue, gray levels. Shape (*batch, capacity, 8), unused rows zeros.

        Raises:
            ValueError: For images of another shape or type, or widths that are no lengths.
        """
        pixels, width = np.asarray(images), np.asarray(widths, dtype=np.float64)
        if pixels.dtype != np.uint8 or pixels.ndim < 3 or pixels.shape[-1] != 3 or pixels.shape[-3] != pixels.shape[-2]:
            raise ValueError(f"images must be uint8 of shape (*batch, S, S, 3), got {pixels.dtype} {pixels.shape}")
        batch = pixels.shape[:-3]
        if width.shape != batch or not np.all((width > 0.0) & np.isfinite(width)):
            raise ValueError(f"widths must be finite and > 0 px, one for each image {batch}, got {width.tolist()}")
        flat = zip(pixels.reshape(-1, *pixels.shape[-3:]), width.ravel().tolist(), strict=True)
        return np.stack([self._detect(*pair) for pair in flat]).reshape(*batch, self.capacity, _COLUMNS)

    def _detect(self, image: NDArray[np.uint8], width: float) -> Array:
        side = image.shape[0]
        found = np.zeros((self.capacity, _COLUMNS))
        smooth = cv2.GaussianBlur(image, (3, 3), 0)
        brightness = smooth.mean(axis=2, dtype=np.float32)
        floor = brightness >= _NO_FLOOR
        if not floor.any():
            return found
        # Of a coarse grid of pixels: the median does not need all.
        hue = np.median(smooth[1::3, 1::3][floor[1::3, 1::3]], axis=0)
        window = max(3, int(self.surroundings * side) | 1)
        weight = floor.astype(np.float32)
        around = cv2.blur(brightness * weight, (window, window)) / np.maximum(cv2.blur(weight, (window, window)), 1e-3)
        mask = np.empty((side, side), np.uint8)
        _differs(
            smooth, brightness, around, hue / max(float(hue.mean()), 1.0), self.chroma, self.dark, self.bright, mask
        )
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
            number = max(1, int(area / (self.usual * square) + 0.35))
            owner = _parts(place, number)
            for part in range(number):
                mine = owner == part
                if used == self.capacity or mine.sum() < self.smallest * square:
                    continue
                spot = place[mine]
                found[used, 0] = 1.0
                middle = spot.mean(axis=0)
                core = np.hypot(*(spot - middle).T) < _CORE * width / scale
                found[used, 1:3] = scale * middle
                found[used, 3:5] = scale * (np.ptp(spot, axis=0) + 1.0)
                found[used, 5:] = color[mine][core if core.any() else slice(None)].mean(axis=0)
                used += 1
        return found


@njit(cache=True, nogil=True)
def _differs(smooth, brightness, around, hue, chroma, dark, bright, mask):  # type: ignore[no-untyped-def]
    """Mark the pixels that are no floor."""
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            light = brightness[i, j]
            mask[i, j] = 0
            if light < _NO_FLOOR:
                continue
            gain = min(light, _DIM) / light
            off = 0.0
            for channel in range(3):
                off = max(off, abs(smooth[i, j, channel] - light * hue[channel]))
            if off * gain > chroma or light < dark * around[i, j] or light > bright * around[i, j]:
                mask[i, j] = 1


_ROUNDS = 6


def _parts(place: Array, number: int) -> Labels:
    """Divide pixels among people by place alone: Lloyd's algorithm from the longest axis.

    Colors would divide a person's hair from their coat.
    """
    if number == 1:
        return np.zeros(len(place), np.int64)
    centered = place - place.mean(axis=0)
    _, axes = np.linalg.eigh(centered.T @ centered)
    along = centered @ axes[:, -1]
    owner = np.minimum((number * np.argsort(np.argsort(along)) / len(along)).astype(np.int64), number - 1)
    for _ in range(_ROUNDS):
        mine = [place[owner == part] for part in range(number)]
        middles = np.stack([spot.mean(axis=0) if len(spot) else place[0] for spot in mine])
        owner = ((place[:, None] - middles) ** 2).sum(axis=2).argmin(axis=1)
    return owner
