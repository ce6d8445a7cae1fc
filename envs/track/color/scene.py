"""Scene of one color tracking episode, and the renderer of its frames with their ground truth."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.streams import Streams
from servotrack.envs.track.color.backdrop import paint_backdrop
from servotrack.envs.track.color.config import ColorConfig
from servotrack.envs.track.color.figures import (
    HEAD,
    Appearance,
    Figure,
    draw_appearance,
    head_boxes,
    paint_figure,
    put_figure,
    similar_appearance,
)
from servotrack.envs.track.color.layers import Canvas, Layer, Placement, put
from servotrack.envs.track.color.scripts import SCENE_ROOM, Motion, Script, Stream, draw_script
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Image, Labels

_NOISE_MARGIN = 32
"""Margin of the noise field around the frame, px. The noise of a frame is a randomly shifted window of the field."""


class Scene(NamedTuple):
    """Motion, figures and backdrop of an episode, ready to be rendered.

    Attributes:
        script: Motion of everything in every frame.
        target: Person whose head is tracked.
        distractors: People behind the target.
        occluders: People or boards that pass in front of the target.
        backdrop: Painted room, larger than a frame.
        boxes: True box of the target in every frame, including occluded parts, shape (F, 4), px.
        noise: Field of sensor noise, larger than a frame.
        noise_shifts: Row and column in the field at which the noise of each frame begins, shape (F, 2).
    """

    script: Script
    target: Figure
    distractors: tuple[Figure, ...]
    occluders: tuple[Figure | Layer, ...]
    backdrop: Image
    boxes: Array
    noise: NDArray[np.int8]
    noise_shifts: Labels


@lru_cache(maxsize=8)
def draw_scene(config: ColorConfig, seed: int) -> Scene:
    """Draw the motion of an episode and paint its layers. The last 8 scenes are cached and must not be changed.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode.
    """
    streams = Streams(seed)
    script = draw_script(config, streams)
    appearance = draw_appearance(streams[Stream.FIGURE])
    target = paint_figure(appearance, streams[Stream.FIGURE])
    distractors = []
    for member in range(config.distractors):
        rng = streams[Stream.DISTRACTOR, member]
        distractors.append(paint_figure(similar_appearance(appearance, rng, config.similarity), rng))
    occluders = tuple(_paint_occluder(streams[Stream.OCCLUDER, member]) for member in range(config.occlusions))
    frames = config.horizon + 1
    field = streams[Stream.NOISE].standard_normal(
        (config.height + 2 * _NOISE_MARGIN, config.width + 2 * _NOISE_MARGIN, 3), dtype=np.float32
    )
    noise = np.clip(np.rint(config.sensor_noise * field), -127, 127).astype(np.int8)
    shifts = streams[Stream.NOISE_SHIFT].integers(0, 2 * _NOISE_MARGIN + 1, (frames, 2))
    boxes = head_boxes(target, *script.target)
    backdrop = _paint_backdrop(config, streams[Stream.BACKDROP], appearance)
    return Scene(script, target, tuple(distractors), occluders, backdrop, boxes, noise, shifts)


class Painter:
    """Renderer of the frames of a scene. The view of the backdrop is reused while the camera rests.

    Args:
        config: Parameters of the environment.
        scene: Scene returned by `draw_scene`.
    """

    def __init__(self, config: ColorConfig, scene: Scene) -> None:
        self._config, self.scene = config, scene
        self._view: Image | None = None
        self._camera: tuple[float, float, float] | None = None

    def frame(self, k: int) -> Image:
        """Render frame k: a new RGB image, shape (height, width, 3), uint8."""
        scene = self.scene
        image = self._backdrop(k).copy()
        for figure, motion in zip(scene.distractors, scene.script.distractors, strict=True):
            put_figure(image, figure, *_at(motion, k))
        put_figure(image, scene.target, *_at(scene.script.target, k))
        for thing, motion in zip(scene.occluders, scene.script.occluders, strict=True):
            center, height, roll, yaw, turn = _at(motion, k)
            if isinstance(thing, Layer):
                put(image, thing, Placement(float(center[0]), float(center[1]), height / HEAD, roll))
            else:
                put_figure(image, thing, center, _OCCLUDER_SCALE * height, roll, yaw, turn)
        top, left = scene.noise_shifts[k]
        height, width = image.shape[:2]
        gains = np.rint(256.0 * scene.script.gains[k]).astype(np.int32)
        _expose(image, gains, scene.noise[top : top + height, left : left + width])
        return image

    def _backdrop(self, k: int) -> Image:
        script = self.scene.script
        zoom, (x, y) = float(script.zooms[k]), script.pans[k].tolist()
        if self._view is None or (zoom, x, y) != self._camera:
            backdrop = self.scene.backdrop
            size = np.array([self._config.width, self._config.height]) / 2.0
            middle = np.array([backdrop.shape[1], backdrop.shape[0]]) / 2.0 + (x, y)
            # Map from frame to scene; OpenCV places pixel centers at integers.
            matrix = np.array([[1.0 / zoom, 0.0, 0.0], [0.0, 1.0 / zoom, 0.0]])
            matrix[:, 2] = middle - 0.5 + (0.5 - size) / zoom
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            shape = (self._config.width, self._config.height)
            self._view = np.asarray(
                cv2.warpAffine(backdrop, matrix, shape, flags=flags, borderMode=cv2.BORDER_REFLECT), dtype=np.uint8
            )
            self._camera = (zoom, x, y)
        return self._view


_OCCLUDER_SCALE = 1.75
"""Size of an occluding person relative to the target; it is closer to the camera."""


def _at(motion: Motion, k: int) -> tuple[Array, float, float, float, float]:
    """Return center, height, roll, yaw and turn of a figure in frame k."""
    return motion.centers[k], *(float(values[k]) for values in motion[1:])  # type: ignore[return-value]


def _paint_backdrop(config: ColorConfig, rng: np.random.Generator, appearance: Appearance) -> Image:
    room = SCENE_ROOM * config.zoom
    width = int(np.ceil(room * config.width + 4.0 * config.pan))
    height = int(np.ceil(room * config.height + 2.0 * config.pan))
    return paint_backdrop(rng, width, height, (appearance.skin, appearance.hair), config.camouflage)


def _paint_occluder(rng: np.random.Generator) -> Figure | Layer:
    """Paint an occluder: a person, or a board of about two head widths."""
    if rng.random() < 0.4:
        appearance = draw_appearance(rng)
        return paint_figure(appearance, rng)
    canvas = Canvas(-68, -110, 136, 220)
    color = rng.uniform(40.0, 210.0, 3)
    grain = np.clip(1.0 + 0.06 * rng.standard_normal((44, 30)), 0.7, 1.3)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    canvas.paint(corners * (66, 106), canvas.shades(tuple(0.55 * color), grain))
    canvas.paint(corners * (62, 102), canvas.shades(tuple(color), grain))
    for k in range(3):
        mark = rng.uniform(30.0, 230.0, 3)
        canvas.paint(corners * (44, 11) + (0, -62 + 60 * k), canvas.shades(tuple(mark), grain))
    return canvas.layer()


@njit(cache=True, nogil=True)
def _expose(image, gains, noise):  # type: ignore[no-untyped-def]
    """Apply light and noise in place. Gains are multiples of 1/256."""
    red, green, blue = gains
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            pixel, grain = image[row, column], noise[row, column]
            a = ((red * np.int32(pixel[0]) + np.int32(128)) >> 8) + np.int32(grain[0])
            b = ((green * np.int32(pixel[1]) + np.int32(128)) >> 8) + np.int32(grain[1])
            c = ((blue * np.int32(pixel[2]) + np.int32(128)) >> 8) + np.int32(grain[2])
            pixel[0] = np.uint8(min(max(a, np.int32(0)), np.int32(255)))
            pixel[1] = np.uint8(min(max(b, np.int32(0)), np.int32(255)))
            pixel[2] = np.uint8(min(max(c, np.int32(0)), np.int32(255)))
