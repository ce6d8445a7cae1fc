"""Layers: small RGBA pictures, and their affine placement in a frame. Results do not depend on library versions."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, FloatArray, Image

Color = tuple[float, float, float]

_SUPERSAMPLING = 4
"""Subpixels per pixel and axis with which edges are painted."""


class Layer(NamedTuple):
    """RGBA picture that is placed in frames.

    Attributes:
        pixels: Red, green and blue, premultiplied by opacity, and opacity; 0 to 255, shape (h, w, 4), float32.
        origin: Point of the layer that lies at the center of the figure, shape (2,), px of the layer.
        outline: Convex hull of the painted area, relative to the origin, shape (k, 2), px of the layer.
    """

    pixels: FloatArray
    origin: Array
    outline: Array


class Canvas:
    """Canvas on which a layer is painted, in coordinates relative to the origin of the layer.

    Args:
        left: Left border of the canvas, below 0, px.
        top: Top border of the canvas, below 0, px.
        width: Width of the canvas, px.
        height: Height of the canvas, px.
    """

    def __init__(self, left: int, top: int, width: int, height: int) -> None:
        self._origin = np.array([-left, -top], dtype=np.float64)
        self._pixels = np.zeros((height, width, 4), np.float32)
        self._points: list[Array] = []

    def paint(self, points: Array, color: Color | FloatArray, *, inside: bool = False) -> None:
        """Paint a filled polygon.

        Args:
            points: Corners, shape (k, 2), px from the origin.
            color: One color, or a color for each pixel, made by `shades`.
            inside: If True, paint only where the canvas is already opaque.
        """
        size = np.array([self._pixels.shape[1], self._pixels.shape[0]])
        corners = points + self._origin
        low = np.clip(np.floor(corners.min(axis=0)).astype(np.int64), 0, size)
        high = np.clip(np.ceil(corners.max(axis=0)).astype(np.int64), 0, size)
        width, height = (high - low).tolist()
        if width == 0 or height == 0:
            return
        fine = np.zeros((height * _SUPERSAMPLING, width * _SUPERSAMPLING), np.uint8)
        cv2.fillPoly(fine, [np.rint((corners - low) * _SUPERSAMPLING - 0.5).astype(np.int32)], 255)
        cover = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.float32)[..., None] / 255
        window = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
        part = self._pixels[window]
        if inside:
            cover = cover * (part[..., 3:] / 255.0)
        else:
            self._points.append(np.asarray(points, dtype=np.float32))
        chosen = color[window] if isinstance(color, np.ndarray) else np.asarray(color, dtype=np.float32)
        part *= 1.0 - cover
        part[..., :3] += cover * chosen
        part[..., 3:] += cover * 255.0

    def shades(self, color: Color, strength: Array) -> FloatArray:
        """Return a color for every pixel: `color` times `strength`, which is resized from any coarser shape."""
        height, width = self._pixels.shape[:2]
        blown = cv2.resize(strength.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        return np.clip(blown[..., None] * np.asarray(color, dtype=np.float32), 0.0, 255.0)

    def layer(self) -> Layer:
        """Return the finished layer. The canvas must not be painted on afterwards."""
        hull = cv2.convexHull(np.concatenate(self._points))[:, 0]
        return Layer(self._pixels, self._origin, hull.astype(np.float64))


def oval(x: float, y: float, rx: float, ry: float, start: float = 0.0, end: float = 360.0) -> Array:
    """Return points of an elliptic arc, shape (49, 2). Angles are clockwise from the right, deg."""
    angles = np.radians(np.linspace(start, end, 49))
    return np.stack([x + rx * np.cos(angles), y + ry * np.sin(angles)], axis=1)


class Placement(NamedTuple):
    """Position, size and rotation of a layer in a frame.

    Attributes:
        x, y: Center of the figure, px.
        scale: Frame pixels per layer pixel.
        roll: Rotation about the center, rad.
        shift: Shift of this layer to the right within the figure, px of the layer.
        squash: Factor on the width of the layer.
    """

    x: float
    y: float
    scale: float
    roll: float
    shift: float = 0.0
    squash: float = 1.0


def put(image: Image, layer: Layer, placement: Placement) -> None:
    """Blend a layer into an image, in place.

    Args:
        image: Image to change, shape (H, W, 3).
        layer: Layer to place.
        placement: Position, size and rotation of the layer.
    """
    x, y, scale, roll, shift, squash = placement
    _put(image, layer.pixels, layer.origin, x, y, math.cos(roll) / scale, math.sin(roll) / scale, shift, squash)


@njit(cache=True, nogil=True)
def _put(image, pixels, origin, x, y, cos, sin, shift, squash):  # type: ignore[no-untyped-def]
    """Sample premultiplied pixels bilinearly, in each row only between the columns that the layer covers."""
    height, width = pixels.shape[:2]
    # Layer coordinates of a frame point: u = u0 + a * column + b * row, v likewise.
    a, b = cos / squash, sin / squash
    u0 = origin[0] - 0.5 + (0.5 - x) * a + (0.5 - y) * b - shift / squash
    v0 = origin[1] - 0.5 - (0.5 - x) * sin + (0.5 - y) * cos
    for row in range(image.shape[0]):
        u, v = u0 + b * row, v0 + cos * row
        # Both coordinates must lie inside the layer.
        if a == 0.0:
            if u < 0.0 or u > width - 1.001:
                continue
            first, last = 0.0, image.shape[1] - 1.0
        else:
            one, two = -u / a, (width - 1.001 - u) / a
            first, last = min(one, two), max(one, two)
        if sin == 0.0:
            if v < 0.0 or v > height - 1.001:
                continue
        else:
            one, two = v / sin, (v - height + 1.001) / sin
            first, last = max(first, min(one, two)), min(last, max(one, two))
        begin, end = int(np.ceil(max(first, 0.0))), int(np.floor(min(last, image.shape[1] - 1.0)))
        for column in range(begin, end + 1):
            at_u, at_v = u + a * column, v - sin * column
            left, top = int(at_u), int(at_v)
            if left < 0 or top < 0 or left > width - 2 or top > height - 2:
                continue
            c, d = np.float32(at_u - left), np.float32(at_v - top)
            s = c * d
            p, q, r = np.float32(1.0) - c - d + s, c - s, d - s
            opacity = (
                p * pixels[top, left, 3]
                + q * pixels[top, left + 1, 3]
                + r * pixels[top + 1, left, 3]
                + s * pixels[top + 1, left + 1, 3]
            )
            if opacity < np.float32(0.5):
                continue
            kept = np.float32(1.0) - opacity * np.float32(1.0 / 255.0)
            for channel in range(3):
                value = (
                    p * pixels[top, left, channel]
                    + q * pixels[top, left + 1, channel]
                    + r * pixels[top + 1, left, channel]
                    + s * pixels[top + 1, left + 1, channel]
                )
                value += kept * np.float32(image[row, column, channel]) + np.float32(0.5)
                image[row, column, channel] = np.uint8(min(value, np.float32(255.0)))
