"""Effects of light and sensor on a frame, as functions of the episode's seed and the frame number."""

from __future__ import annotations

import math

import cv2
import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Image, Labels

_NOISE_PERIOD = 4096
"""Number of frames after which noise and flicker repeat; the square of `_TILE_MARGIN`."""
_TILE_MARGIN = 64
"""Margin of the noise tile beyond the frame, px: its number of possible positions per axis."""
_COMMON_VARIANCE = 0.6
"""Share of the noise variance that is common to the three channels, as in real cameras."""
_DRIFT_PERIODS = (380.0, 230.0)
"""Periods of the slow change of brightness, frames."""


class Light:
    """Change of brightness over time, relative to the backdrop, gray levels.

    Args:
        config: Parameters: flicker, light_drift, light_step, horizon.
        streams: Random streams of the episode.
        flicker: Key of the stream of flicker.
        drift: Key of the stream of drift.
        step: Key of the stream of the sudden change.
    """

    def __init__(self, config: PedestrianConfig, streams: Streams, flicker: int, drift: int, step: int) -> None:
        self._config = config
        self._flicker = (
            config.flicker * streams[flicker].standard_normal(_NOISE_PERIOD) if config.flicker > 0.0 else None
        )
        self._drift = streams[drift].uniform(0.0, 2.0 * math.pi, 2) if config.light_drift > 0.0 else None
        third = config.horizon / 3.0
        self.step_frame = int(streams[step].uniform(third, 2.0 * third)) if config.light_step != 0.0 else None
        """Frame of the sudden change; None without one."""

    def offset(self, frame: int) -> float:
        """Return the change of brightness in a frame, gray levels."""
        change = 0.0
        if self._flicker is not None:
            change += float(self._flicker[frame % _NOISE_PERIOD])
        if self._drift is not None:
            first, second = (
                math.sin(2.0 * math.pi * frame / period + phase)
                for period, phase in zip(_DRIFT_PERIODS, self._drift.tolist(), strict=True)
            )
            change += self._config.light_drift * (0.75 * first + 0.25 * second)
        if self.step_frame is not None and frame >= self.step_frame:
            change += self._config.light_step
        return change


class Sensor:
    """Pixel noise: one tile, drawn at the start and shifted to another place in each frame.

    Args:
        deviation: Standard deviation, gray levels.
        width: Width of the frame, px.
        height: Height of the frame, px.
        rng: Generator of the noise.
    """

    def __init__(self, deviation: float, width: int, height: int, rng: np.random.Generator) -> None:
        self._places: Labels | None = None
        self._width, self._height = width, height
        if deviation <= 0.0:
            return
        self._places = rng.permutation(_NOISE_PERIOD)
        shape = (height + _TILE_MARGIN, width + _TILE_MARGIN)
        common = rng.standard_normal((*shape, 1), dtype=np.float32)
        own = rng.standard_normal((*shape, 3), dtype=np.float32)
        # Rows of interleaved channels, in the memory layout of the image, so that they are added as flat rows.
        self._tile = np.empty((shape[0], 3 * shape[1]), dtype=np.int16)
        share, rest = math.sqrt(_COMMON_VARIANCE) * deviation, math.sqrt(1.0 - _COMMON_VARIANCE) * deviation
        _mix(common, own, np.float32(share), np.float32(rest), self._tile)

    def expose(self, image: Image, frame: int, change: float) -> None:
        """Change the brightness of a frame by whole gray levels and add its noise, in place.

        Args:
            image: Contiguous RGB image.
            frame: Number of the frame.
            change: Change of brightness, gray levels.
        """
        levels = np.int16(round(change))
        if self._places is not None:
            top, left = divmod(int(self._places[frame % _NOISE_PERIOD]), _TILE_MARGIN)
            _expose(image.reshape(len(image), -1), levels, self._tile, top, 3 * left)
        elif levels > 0:
            cv2.add(image, np.full(4, float(levels)), dst=image)
        elif levels < 0:
            cv2.subtract(image, np.full(4, float(-levels)), dst=image)


@njit(cache=True, nogil=True)
def _mix(common, own, share, rest, tile):  # type: ignore[no-untyped-def]
    """Fill a tile with noise in whole gray levels; part of it is common to the three channels."""
    for i in range(own.shape[0]):
        for j in range(own.shape[1]):
            for c in range(3):
                tile[i, 3 * j + c] = np.int16(np.rint(own[i, j, c] * rest + common[i, j, 0] * share))


@njit(cache=True, nogil=True)
def _expose(rows, levels, tile, top, left):  # type: ignore[no-untyped-def]
    """Add `levels`, then noise, clipped to 0 and 255 each time. 16-bit numbers keep the loop vectorized."""
    black, white = np.int16(0), np.int16(255)
    for i in range(rows.shape[0]):
        row = rows[i]
        grain = tile[top + i, left : left + len(row)]
        for j in range(len(row)):
            lit = min(max(np.int16(np.int16(row[j]) + levels), black), white)
            row[j] = np.uint8(min(max(np.int16(lit + grain[j]), black), white))
