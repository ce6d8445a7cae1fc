"""Pictures of a color tracking scene: enlarged frame with true and reported box and trail, and a plot of the IoU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import FLOOR, FLOOR_GRID, INK, PAPER, SOFT_INK, Color, Panel, mix
from servotrack.envs.drawing.plots import PLOT_INSET, SUBPIXEL_BITS, TITLE_HEIGHT, write_value
from servotrack.envs.track.color.world import ColorWorld
from servotrack.estimators.types import Array, Image

ANSWER: Color = (255, 138, 0)
"""Color of the answer's box, its trail and its IoU curve."""
TRUTH: Color = (255, 255, 255)
_ZOOM = 2
_MARGIN, _SIDE = 16, 208
_TRAIL_LENGTH = 60


class ColorRecorder:
    """Recorder of one scene. Call `record` after every reset and step; `frame` draws the last answered frame.

    Args:
        world: World to record; it is not changed.
        row: Index of the scene.
    """

    def __init__(self, world: ColorWorld, row: int = 0) -> None:
        self._world, self._row = world, row
        self._newest = self._answered = np.zeros(0, np.uint8)
        self._truth = self._newest_truth = np.zeros(4)
        self._answers: list[Array] = []

    def record(self) -> None:
        """Store the newest answer of the world. After a reset, drop the previous episode."""
        world, row = self._world, self._row
        started = world.steps[row] == 0
        if started:
            self._answers = []
        elif world.steps[row] > len(self._answers):
            self._answers.append(world.answers[row].copy())
            self._answered, self._truth = self._newest, self._newest_truth
        self._newest, self._newest_truth = world.observations[row].copy(), world.boxes[row].copy()
        if started:
            self._answered, self._truth = self._newest, self._newest_truth

    @property
    def frame(self) -> Callable[..., Image]:
        """Function that draws the last answered frame, or the first frame before any answer."""
        return self._draw

    def _draw(self) -> Image:
        """Return a new RGB image, uint8."""
        config = self._world.config
        scene, plot = panels(config.width, config.height)
        image = _backdrop(config.width, config.height).copy()
        picture = scene.of(image)
        cv2.resize(self._answered, (scene.width, scene.height), dst=picture, interpolation=cv2.INTER_LINEAR)
        draw_box(picture, _ZOOM * self._truth, TRUTH, 1)
        if self._answers:
            draw_trail(picture, [_ZOOM * answer for answer in self._answers[-_TRAIL_LENGTH:]])
            draw_box(picture, _ZOOM * self._answers[-1], ANSWER, 2)
            self._plot(plot.of(image))
        return image

    def _plot(self, panel: Image) -> None:
        iou = self._world.answered_overlaps(self._row)
        height, width = panel.shape[0] - 2 * PLOT_INSET - TITLE_HEIGHT, panel.shape[1] - 2 * PLOT_INSET
        x = PLOT_INSET + width * (np.arange(len(iou)) + 0.5) / self._world.config.horizon
        y = PLOT_INSET + TITLE_HEIGHT + height * (1.0 - iou)
        floor = np.array([[x[-1], PLOT_INSET + TITLE_HEIGHT + height], [x[0], PLOT_INSET + TITLE_HEIGHT + height]])
        line = np.stack([x, y], axis=1)
        cv2.fillPoly(
            panel, [_fixed(np.concatenate([line, floor]))], mix(FLOOR, ANSWER, 0.18), cv2.LINE_8, SUBPIXEL_BITS
        )
        cv2.polylines(panel, [_fixed(line)], False, ANSWER, 2, cv2.LINE_AA, SUBPIXEL_BITS)
        write_value(panel, f"{iou[-1]:.2f}")


def draw_box(image: Image, box: Array, color: Color, thickness: int) -> None:
    """Draw a rectangle with a dark rim, which is visible on any background.

    Args:
        image: Image to change.
        box: Left, top, width and height, px of the image.
        color: Color of the line.
        thickness: Thickness of the line, px.
    """
    # OpenCV's fixed-point coordinates overflow at 2^15 px.
    low = np.clip(box[:2], -4000.0, 8000.0)
    high = np.clip(box[:2] + box[2:], -4000.0, 8000.0)
    for shade, weight in ((mix(color, INK, 0.85), thickness + 2), (color, thickness)):
        cv2.rectangle(image, _fixed(low).tolist(), _fixed(high).tolist(), shade, weight, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_trail(image: Image, boxes: Sequence[Array]) -> None:
    """Draw the path of the centers of boxes.

    Args:
        image: Image to change.
        boxes: Left, top, width and height of each box, newest last, px of the image.
    """
    middles = np.clip([box[:2] + box[2:] / 2.0 for box in boxes], -4000.0, 8000.0)
    cv2.polylines(image, [_fixed(middles)], False, mix(ANSWER, INK, 0.6), 3, cv2.LINE_AA, SUBPIXEL_BITS)
    cv2.polylines(image, [_fixed(middles)], False, ANSWER, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def panels(width: int, height: int) -> tuple[Panel, Panel]:
    """Return the panels of the frame and of the plot, for frames of this size."""
    scene = Panel(_MARGIN, _MARGIN, _ZOOM * width, _ZOOM * height)
    return scene, Panel(scene.left + scene.width + _MARGIN, _MARGIN, _SIDE, scene.height)


@lru_cache(maxsize=4)
def _backdrop(width: int, height: int) -> Image:
    scene, plot = panels(width, height)
    image = np.empty((scene.height + 2 * _MARGIN, plot.left + plot.width + _MARGIN, 3), dtype=np.uint8)
    image[:] = PAPER
    panel = plot.of(image)
    panel[:] = FLOOR
    for quarter in range(5):
        at = PLOT_INSET + TITLE_HEIGHT + round(quarter * (panel.shape[0] - 2 * PLOT_INSET - TITLE_HEIGHT) / 4)
        panel[min(at, panel.shape[0] - PLOT_INSET - 1), PLOT_INSET : panel.shape[1] - PLOT_INSET] = FLOOR_GRID
    put_text(panel, "overlap", PLOT_INSET, PLOT_INSET + 8, SOFT_INK)
    image.setflags(write=False)
    return image


def _fixed(points: Array) -> NDArray[np.int32]:
    """Return fixed-point coordinates for OpenCV, which places pixel centers at integers."""
    return np.rint((np.asarray(points) - 0.5) * (1 << SUBPIXEL_BITS)).astype(np.int32)
