"""Objects in the lobby: plants with swaying leaves, and pillars and signs that occlude people."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotrack.envs.track.pedestrians import shapes
from servotrack.envs.track.pedestrians.floor import BACK_WALL, MAX_DEPTH, MIN_DEPTH, Camera
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

Color = tuple[float, float, float]

PLANT_DEPTH = BACK_WALL - 0.35
"""z of the two plants at the back wall, m; they never occlude people."""

_WIND_PERIOD = 61.0  # period of the slow component of the wind, frames
_STRAIGHT = (1.0,) * shapes.SAMPLES
_LEAF = (0.25, 0.75, 1.0, 0.92, 0.62, 0.06)
_STONE: Color = (186.0, 180.0, 170.0)
_LEAVES: tuple[Color, ...] = ((34.0, 74.0, 38.0), (48.0, 98.0, 48.0), (66.0, 120.0, 56.0), (92.0, 142.0, 72.0))
_BOARDS: tuple[Color, ...] = ((38.0, 66.0, 96.0), (150.0, 48.0, 40.0), (44.0, 92.0, 78.0), (60.0, 58.0, 66.0))


@dataclass(frozen=True)
class Prop:
    """Object with a fixed place.

    Attributes:
        place: Position on the floor (x, z) and radius of the foot, m.
        base: Row of the foot, px. People whose feet are above this row are behind the object.
        parts: Shapes at rest, in drawing order, shape (k, shapes.NUMBERS).
        swaying: Amplitude with which the end of each part follows the wind, 0 to 1, shape (k,).
        lag: Phase lag of each part behind the wind, rad, shape (k,).
    """

    place: tuple[float, float, float]
    base: float
    parts: Array
    swaying: Array
    lag: Array

    @property
    def sways(self) -> bool:
        """True if any part moves in the wind."""
        return bool(self.swaying.any())


@njit(cache=True, nogil=True)
def _sway(rest, swaying, lag, shift, time, parts):  # type: ignore[no-untyped-def]
    """Write `parts` with ends displaced by the wind: amplitude `shift` px, phase `time` rad."""
    parts[:] = rest
    for k in range(len(rest)):
        gust = math.sin(time + lag[k]) + 0.5 * math.sin(2.3 * time + 1.7 * lag[k])
        parts[k, shapes.END] += shift * swaying[k] * gust
        parts[k, shapes.END + 1] += 0.3 * shift * swaying[k] * math.sin(1.6 * time + 2.0 * lag[k])


def plant_at(camera: Camera, x: float, z: float, size: float, rng: np.random.Generator) -> Prop:
    """Return a potted plant with the height `size`, m."""
    foot, scale = camera.project(np.array([x, z])), float(camera.scale(np.array(z)))
    slope = camera.elevation / z
    pot = 0.26 * size
    rows = [
        _part(foot, scale, (0.0, pot), (0.0, 0.0), 0.12 * size, (1.0, 1.02, 1.0, 0.95, 0.88, 0.8), (92, 78, 70), slope)
    ]
    swaying, lag = [0.0], [0.0]
    leaves = int(rng.integers(20, 26))
    for leaf in range(leaves):
        # Outer leaves hang low and are drawn first; upright ones are in front of them.
        upright = leaf / leaves
        angle = rng.uniform(-1.0, 1.0) * (1.45 - 0.95 * upright)
        length = size * rng.uniform(0.42, 0.74) * (0.72 + 0.28 * upright)
        root = (rng.uniform(-0.04, 0.04) * size, pot + size * rng.uniform(0.0, 0.16))
        tip = (root[0] + length * np.sin(angle), root[1] + length * np.cos(angle) - 0.10 * size * abs(angle))
        color = _LEAVES[int(min(rng.integers(2) + 2 * upright, 3))]
        rows.append(_part(foot, scale, root, tip, size * rng.uniform(0.042, 0.062), _LEAF, color, 1.0))
        swaying.append(rng.uniform(0.6, 1.0))
        lag.append(rng.uniform(0.0, 2.0 * np.pi))
    return Prop((x, z, 0.12 * size), float(foot[1]), np.array(rows), np.array(swaying), np.array(lag))


def pillar_at(camera: Camera, x: float, z: float, rng: np.random.Generator) -> Prop:
    """Return a round pillar up to the ceiling."""
    foot, scale = camera.project(np.array([x, z])), float(camera.scale(np.array(z)))
    slope, radius = camera.elevation / z, rng.uniform(0.22, 0.3)
    shaft = _part(foot, scale, (0.0, 9.0), (0.0, 0.05), radius, _STRAIGHT, _STONE, slope)
    ring = _part(foot, scale, (0.0, 0.22), (0.0, 0.0), radius * 1.14, _STRAIGHT, (96.0, 92.0, 88.0), slope)
    shaft[shapes.GRAIN] = 0.05
    rows = [shaft, ring]
    return Prop((x, z, radius), float(foot[1]), np.array(rows), np.zeros(len(rows)), np.zeros(len(rows)))


def sign_at(camera: Camera, x: float, z: float, rng: np.random.Generator) -> Prop:
    """Return a sign: a board with printed lines on a foot."""
    foot, scale = camera.project(np.array([x, z])), float(camera.scale(np.array(z)))
    slope, half = camera.elevation / z, rng.uniform(0.34, 0.44)
    color = _BOARDS[int(rng.integers(len(_BOARDS)))]
    rows = [
        _part(foot, scale, (0.0, 0.06), (0.0, 0.0), half * 0.7, _STRAIGHT, (58.0, 58.0, 60.0), slope),
        _part(foot, scale, (0.0, 1.72), (0.0, 0.10), half, _STRAIGHT, color, 0.08),
        _part(foot, scale, (0.0, 1.60), (0.0, 1.46), half * 0.8, _STRAIGHT, (236.0, 234.0, 228.0), 0.08),
    ]
    for line in range(5):
        y, reach = 1.3 - 0.16 * line, half * rng.uniform(0.5, 0.78)
        left = -0.8 * half
        rows.append(
            _part(foot, scale, (left, y), (left + 2.0 * reach, y), 0.022, _STRAIGHT, (214.0, 214.0, 208.0), 0.1)
        )
    for row in rows:
        row[shapes.RELIEF] = 0.12
    return Prop((x, z, half), float(foot[1]), np.array(rows), np.zeros(len(rows)), np.zeros(len(rows)))


def lobby_plants(camera: Camera, rng: np.random.Generator) -> list[Prop]:
    """Return the two plants at the back wall, between doors and wooden panels. They never occlude people."""
    reach = float(camera.half_width(PLANT_DEPTH))
    return [
        plant_at(camera, side * min(6.25, 0.83 * reach), PLANT_DEPTH, float(rng.uniform(1.7, 2.1)), rng)
        for side in (-1.0, 1.0)
    ]


def occluders(camera: Camera, count: int, rng: np.random.Generator) -> list[Prop]:
    """Draw pillars, plants and signs spread over the lobby.

    Args:
        camera: Camera of the scene.
        count: Number of objects.
        rng: Generator of kinds and places.

    Returns:
        Objects, farthest first.
    """
    props = []
    kinds = rng.permutation(max(count, 3))
    strips = rng.permutation(count)
    for k in range(count):
        z = float(rng.uniform(MIN_DEPTH + 1.0, MAX_DEPTH - 2.5))
        reach = 0.84 * float(camera.half_width(z))
        # Every object has its own vertical strip of the image, so that objects do not occlude each other.
        x = reach * (2.0 * (strips[k] + rng.uniform(0.2, 0.8)) / count - 1.0)
        kind = kinds[k] % 3
        if kind == 0:
            props.append(pillar_at(camera, x, z, rng))
        elif kind == 1:
            props.append(plant_at(camera, x, z, float(rng.uniform(1.3, 1.8)), rng))
        else:
            props.append(sign_at(camera, x, z, rng))
    return sorted(props, key=lambda prop: prop.base)


class PropPatches:
    """Rendered patches of all objects in one array. Swaying objects are drawn again for each frame.

    Args:
        props: Objects in depth order, farthest first.
        sway: Amplitude of the sway of leaves, px; 0: no sway.
        wind: Initial phase of the wind, rad.
        grain: Tile of the cloth grain.

    Attributes:
        pool: All patches one after the other, float32.
        extents: Left, top, right, bottom of each patch, px, shape (k, 4).
        starts: Index at which each patch begins in the pool, shape (k,).
        bases: Rows of the feet, px, shape (k,).
    """

    def __init__(self, props: list[Prop], sway: float, wind: float, grain: Array) -> None:
        self._props, self._sway, self._wind, self._grain = props, sway, wind, grain
        margin = 2 * math.ceil(sway)
        extents = [shapes.extent(prop.parts, len(prop.parts)) for prop in props]
        self.extents = np.array(extents, dtype=np.int64) + np.array([-margin, -margin, margin, margin])
        sizes = 4 * (self.extents[:, 2] - self.extents[:, 0]) * (self.extents[:, 3] - self.extents[:, 1])
        self.starts = np.cumsum(sizes) - sizes
        self.bases = np.array([prop.base for prop in props])
        self.pool = np.zeros(int(sizes.sum()), dtype=np.float32)
        for k, prop in enumerate(props):
            self._draw(k, prop.parts)

    def at(self, frame: int) -> PropPatches:
        """Draw the swaying objects for a frame, in place, and return this object."""
        if self._sway > 0.0:
            time = self._wind + 2.0 * math.pi * frame / _WIND_PERIOD
            for k, prop in enumerate(self._props):
                if prop.sways:
                    parts = np.empty_like(prop.parts)
                    _sway(prop.parts, prop.swaying, prop.lag, self._sway, time, parts)
                    self._draw(k, parts)
        return self

    def _draw(self, k: int, parts: Array) -> None:
        left, top, right, bottom = self.extents[k].tolist()
        size = 4 * (right - left) * (bottom - top)
        patch = self.pool[self.starts[k] : self.starts[k] + size].reshape(bottom - top, right - left, 4)
        patch[:] = 0.0
        shapes.draw_parts(parts, np.arange(len(parts)), len(parts), left, top, self._grain, patch)


def _part(
    foot: Array,
    scale: float,
    start: tuple[float, float],
    end: tuple[float, float],
    half_width: float,
    widths: tuple[float, ...],
    color: Color | tuple[int, int, int],
    cap: float,
) -> Array:
    """Return a tube between two points relative to a foot (m to the right, m up)."""
    part = np.zeros(shapes.NUMBERS)
    for at, (right, up) in ((shapes.START, start), (shapes.END, end)):
        part[at], part[at + 1] = foot[0] + scale * right, foot[1] - scale * up
    part[shapes.WIDTHS : shapes.WIDTHS + shapes.SAMPLES] = np.array(widths) * half_width * scale
    part[shapes.CAPS], part[shapes.CAPS + 1] = cap, cap
    part[shapes.COLOR : shapes.COLOR + 3] = part[shapes.SECOND : shapes.SECOND + 3] = color
    part[shapes.RELIEF], part[shapes.BRIGHTNESS] = 0.6, 1.0
    return part
