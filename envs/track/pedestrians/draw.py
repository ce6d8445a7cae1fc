"""Rendering of the lobby with its people, with exact ground truth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.backdrop import background_colors, paint_backdrop
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.effects import Light, Sensor
from servotrack.envs.track.pedestrians.floor import BACK_WALL, lobby_camera
from servotrack.envs.track.pedestrians.jpeg import JpegCoder
from servotrack.envs.track.pedestrians.outfits import OUTFIT_NUMBERS, draw_outfit
from servotrack.envs.track.pedestrians.people import Drawn, People
from servotrack.envs.track.pedestrians.props import PropPatches, lobby_plants, occluders
from servotrack.envs.track.pedestrians.shading import cast_shadow, contact_shade
from servotrack.envs.track.pedestrians.shapes import (
    NUMBERS,
    draw_parts,
    extent,
    fold_cloth,
    lay_over,
    measure_silhouette,
    patch_at,
)
from servotrack.envs.track.pedestrians.sprites import MAX_PARTS, pose_person
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, FloatArray, Labels

MAX_PEOPLE_IN_FRAME = 255
"""Maximum number of people in a frame, because `owners` has bytes."""

# Child streams of an episode's seed that decide the picture. The numbers must never change.
_BACKDROP, _BLENDING, _GRAIN, _PLANTS, _WIND, _OCCLUDERS, _SUN, _NOISE, _FLICKER, _DRIFT, _STEP = range(2000, 2011)

_MAX_SLOPE = 0.75  # maximum foreshortening (depth relative to height in the image) with which bodies are drawn


def occluder_places(config: PedestrianConfig, seed: int) -> tuple[tuple[float, float, float], ...]:
    """Return the places of the occluders on the floor, as obstacles for the people.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, a non-negative integer.

    Returns:
        x, z and radius of each occluder, m.
    """
    camera = lobby_camera(config.width, config.height)
    return tuple(prop.place for prop in occluders(camera, config.occluders, Streams(seed)[_OCCLUDERS]))


class Stage:
    """Renderer of the lobby of one episode. A frame depends only on seed, people and frame number.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, a non-negative integer.
    """

    def __init__(self, config: PedestrianConfig, seed: int) -> None:
        self._config = config
        streams = Streams(seed)
        camera = lobby_camera(config.width, config.height)
        self._horizon, self._focal = camera.horizon, camera.focal
        self._backdrop = paint_backdrop(camera, config.height, streams[_BACKDROP])
        foot = camera.horizon + camera.focal * camera.elevation / BACK_WALL
        self._blending = background_colors(self._backdrop, foot, streams[_BLENDING])
        self._grain = fold_cloth(streams[_GRAIN])
        self._light = Light(config, streams, _FLICKER, _DRIFT, _STEP)
        self._sensor = Sensor(config.sensor_noise, config.width, config.height, streams[_NOISE])
        quality = round(100.0 - 90.0 * config.compression)
        self._coder = JpegCoder(config.width, config.height, quality) if config.compression > 0.0 else None
        self._sun = float(streams[_SUN].uniform(-0.7, 0.7))
        self._wind = float(streams[_WIND].uniform(0.0, 2.0 * math.pi))
        props = lobby_plants(camera, streams[_PLANTS]) + occluders(camera, config.occluders, streams[_OCCLUDERS])
        self._prop_patches = PropPatches(props, config.plant, self._wind, self._grain)
        self._outfits: dict[int, Array] = {}
        self._pool = np.empty(1 << 16, dtype=np.float32)

    def draw(self, people: People, frame: int) -> Drawn:
        """Render one frame.

        Args:
            people: People in the scene, in any order.
            frame: Number of the frame, from 0.

        Returns:
            Image, a new array, and ground truth with the rows of `people`.

        Raises:
            ValueError: If there are more than `MAX_PEOPLE_IN_FRAME` people.
        """
        count = len(people.ids)
        if count > MAX_PEOPLE_IN_FRAME:
            raise ValueError(f"people must be at most {MAX_PEOPLE_IN_FRAME} in a frame, got {count}")
        config = self._config
        image = self._backdrop.copy()
        owners = np.zeros(image.shape[:2], dtype=np.uint8)
        parts, orders, extents = self._pose(people)
        starts = np.zeros(count + 1, dtype=np.int64)
        np.cumsum(4 * (extents[:, 2] - extents[:, 0]) * (extents[:, 3] - extents[:, 1]), out=starts[1:])
        if starts[-1] > len(self._pool):
            self._pool = np.empty(2 * int(starts[-1]), dtype=np.float32)
        _draw_bodies(parts, orders, extents, starts, self._grain, self._pool)
        truth = _Truth(np.zeros((count, 4)), np.zeros(count), np.zeros(count), owners)
        things = self._prop_patches.at(frame)
        depth = np.lexsort((people.ids, people.feet[:, 1]))
        _compose(
            image, depth, people.feet, people.height, _Patches(self._pool, extents, starts),
            _Patches(things.pool, things.extents, things.starts), things.bases, self._horizon, self._focal,
            config.shadow, self._sun, truth,
        )  # fmt: skip
        self._sensor.expose(image, frame, self._light.offset(frame))
        if self._coder is not None:
            image = self._coder.code(image)
        return Drawn(image, truth.boxes, truth.visible / np.maximum(truth.totals, 1.0), owners)

    def _pose(self, people: People) -> tuple[Array, Labels, Labels]:
        """Return the parts of all bodies, their drawing orders (last column: number of parts), and patch extents."""
        count = len(people.ids)
        outfits = np.empty((count, OUTFIT_NUMBERS))
        for row, seed in enumerate(people.outfit_seeds.tolist()):
            if seed not in self._outfits:
                self._outfits[seed] = draw_outfit(seed, self._config.camouflage, self._blending)
            outfits[row] = self._outfits[seed]
        parts = np.zeros((count, MAX_PARTS, NUMBERS))
        orders = np.zeros((count, MAX_PARTS + 1), dtype=np.int64)
        extents = np.zeros((count, 4), dtype=np.int64)
        _pose_bodies(
            outfits,
            people.feet,
            people.height,
            people.heading,
            people.phase,
            people.stride,
            self._horizon,
            self._focal,
            parts,
            orders,
            extents,
        )
        return parts, orders, extents


class _Patches(NamedTuple):
    """Drawn bodies or objects, in one pool of numbers.

    Attributes:
        pool: All patches one after the other, float32.
        extents: Left, top, right, bottom of each patch, (k, 4) px.
        starts: Index of each patch's first number in the pool; further entries are ignored, (>= k,).
    """

    pool: FloatArray
    extents: Labels
    starts: Labels


class _Truth(NamedTuple):
    """Ground truth of the n people of a frame.

    Attributes:
        boxes: Left, top, width, height of the silhouettes, (n, 4) px.
        totals: Pixels of the whole silhouettes, hidden parts included, (n,).
        visible: Pixels of the visible parts, (n,).
        owners: Index of the person that a pixel shows + 1, 0 for the background, (H, W) uint8.
    """

    boxes: Array
    totals: Array
    visible: Array
    owners: NDArray[np.uint8]


@njit(cache=True, nogil=True)
def _slope(row, horizon, focal):  # type: ignore[no-untyped-def]
    """Return the foreshortening (depth relative to height in the image) at a row of the floor."""
    return min(max((row - horizon) / focal, 0.05), _MAX_SLOPE)


@njit(cache=True, nogil=True)
def _pose_bodies(outfits, feet, heights, headings, phases, strides, horizon, focal, parts, orders, extents):  # type: ignore[no-untyped-def]
    for n in range(len(outfits)):
        slope = _slope(feet[n, 1], horizon, focal)
        tilt = slope / math.sqrt(1.0 + slope * slope)
        count = pose_person(
            outfits[n],
            feet[n, 0],
            feet[n, 1],
            heights[n],
            headings[n],
            phases[n],
            strides[n],
            tilt,
            parts[n],
            orders[n],
        )
        orders[n, -1] = count
        extents[n, 0], extents[n, 1], extents[n, 2], extents[n, 3] = extent(parts[n], count)


@njit(cache=True, nogil=True)
def _draw_bodies(parts, orders, extents, starts, grain, pool):  # type: ignore[no-untyped-def]
    for n in range(len(parts)):
        patch = patch_at(pool, starts[n], extents[n])
        patch[:] = 0.0
        draw_parts(parts[n], orders[n], orders[n, -1], extents[n, 0], extents[n, 1], grain, patch)


@njit(cache=True, nogil=True)
def _compose(  # type: ignore[no-untyped-def]
    image, depth, feet, heights, bodies, props, prop_bases, horizon, focal, shadow, sun, truth
):
    """Draw shadows, then people and objects from the farthest to the nearest, and compute the ground truth.

    Args:
        image: RGB image, painted in place, (H, W, 3) uint8.
        depth: Indices of the people, the farthest first, (n,).
        feet: Column and row of the middle between the feet, (n, 2) px.
        heights: Body heights, (n,) px.
        bodies: Drawn bodies, `_Patches`.
        props: Drawn objects of the lobby, the farthest first, `_Patches`.
        prop_bases: Rows of the feet of these objects, (k,) px.
        horizon: Row of the horizon, px.
        focal: Focal length, px.
        shadow: Opacity of the cast shadows, 0 to 1.
        sun: Distance that shadows fall to the right, as a fraction of the height of the body part.
        truth: Ground truth of the people, overwritten, `_Truth`.
    """
    pool, extents, starts = bodies.pool, bodies.extents, bodies.starts
    prop_pool, prop_extents, prop_starts = props.pool, props.extents, props.starts
    boxes, totals, visible, owners = truth.boxes, truth.totals, truth.visible, truth.owners
    for n in depth:
        slope = _slope(feet[n, 1], horizon, focal)
        if shadow > 0.0:
            patch = patch_at(pool, starts[n], extents[n])
            cast_shadow(
                image, patch, extents[n, 0], extents[n, 1], feet[n, 0], feet[n, 1], heights[n], slope, sun, shadow
            )
        contact_shade(image, feet[n, 0], feet[n, 1], heights[n], slope)
    prop = 0
    for k in range(len(depth) + 1):
        row = feet[depth[k], 1] if k < len(depth) else np.inf
        while prop < len(prop_bases) and prop_bases[prop] <= row:
            patch = patch_at(prop_pool, prop_starts[prop], prop_extents[prop])
            lay_over(patch, prop_extents[prop, 0], prop_extents[prop, 1], 0, image, owners, visible)
            prop += 1
        if k < len(depth):
            n = depth[k]
            left, top = extents[n, 0], extents[n, 1]
            patch = patch_at(pool, starts[n], extents[n])
            totals[n] = measure_silhouette(patch, left, top, image.shape[1], image.shape[0], boxes[n])
            lay_over(patch, left, top, n + 1, image, owners, visible)
