"""What light and sensor do to a frame; every number is a function of the episode's seed and the frame."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.estimators.types import Image, Labels

_BANK = 4096
"""Frames after which noise and flicker repeat."""
_SIDE = 64
"""The noise's tile is this much larger than the frame; _SIDE squared is _BANK."""
_COMMON = 0.6
"""Share of the noise's variance that the three channels have in common, as cameras deliver it."""
_DRIFT_PERIODS = (380.0, 230.0)


class Light:
    """Brightness of the lobby against the backdrop's, gray levels.

    Args:
        config: Of the scene: flicker, light_drift, light_step, horizon.
        streams: Of the episode.
        flicker: Key of flicker's stream.
        drift: Key of drift's stream.
        step: Key of the step's stream.
    """

    def __init__(self, config: PedestrianConfig, streams: Streams, flicker: int, drift: int, step: int) -> None:
        self._config = config
        self._flicker = config.flicker * streams[flicker].standard_normal(_BANK) if config.flicker > 0.0 else None
        self._drift = streams[drift].uniform(0.0, 2.0 * math.pi, 2) if config.light_drift > 0.0 else None
        third = config.horizon / 3.0
        self.step_frame = int(streams[step].uniform(third, 2.0 * third)) if config.light_step != 0.0 else None
        """Frame of the sudden change; None without one."""

    def offset(self, frame: int) -> float:
        """Gray levels that the frame is brighter."""
        change = 0.0
        if self._flicker is not None:
            change += float(self._flicker[frame % _BANK])
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
    """Noise of the pixels: one tile made at the start, laid at another place in each frame.

    Args:
        deviation: Standard deviation, gray levels.
        width: Of the frame, px.
        height: Of the frame, px.
        rng: Of the noise.
    """

    def __init__(self, deviation: float, width: int, height: int, rng: np.random.Generator) -> None:
        self._places: Labels | None = None
        self._width, self._height = width, height
        if deviation <= 0.0:
            return
        self._places = rng.permutation(_BANK)
        shape = (height + _SIDE, width + _SIDE)
        common = rng.standard_normal((*shape, 1), dtype=np.float32)
        own = rng.standard_normal((*shape, 3), dtype=np.float32)
        # Rows of channels as they lie in memory: what is added to them needs to know no more.
        self._tile = np.empty((shape[0], 3 * shape[1]), dtype=np.int16)
        share, rest = math.sqrt(_COMMON) * deviation, math.sqrt(1.0 - _COMMON) * deviation
        _mix(common, own, np.float32(share), np.float32(rest), self._tile)

    def expose(self, image: Image, frame: int, change: float) -> None:
        """Make a frame brighter by whole gray levels and add its noise, in place.

        Args:
            image: RGB, contiguous.
            frame: Its number.
            change: Gray levels that it is brighter.
        """
        levels = np.int16(round(change))
        if self._places is not None:
            top, left = divmod(int(self._places[frame % _BANK]), _SIDE)
            _expose(image.reshape(len(image), -1), levels, self._tile, top, 3 * left)
        elif levels > 0:
            cv2.add(image, np.full(4, float(levels)), dst=image)
        elif levels < 0:
            cv2.subtract(image, np.full(4, float(-levels)), dst=image)


@njit(cache=True, nogil=True)
def _mix(common, own, share, rest, tile):  # type: ignore[no-untyped-def]
    """A tile of noise in whole gray levels, of which three channels have a share in common."""
    for i in range(own.shape[0]):
        for j in range(own.shape[1]):
            for c in range(3):
                tile[i, 3 * j + c] = np.int16(np.rint(own[i, j, c] * rest + common[i, j, 0] * share))


@njit(cache=True, nogil=True)
def _expose(rows, levels, tile, top, left):  # type: ignore[no-untyped-def]
    """Add `levels` and then noise; both stop at black and at white. All numbers are short: the loop is of vectors."""
    black, white = np.int16(0), np.int16(255)
    for i in range(rows.shape[0]):
        row = rows[i]
        grain = tile[top + i, left : left + len(row)]
        for j in range(len(row)):
            lit = min(max(np.int16(np.int16(row[j]) + levels), black), white)
            row[j] = np.uint8(min(max(np.int16(lit + grain[j]), black), white))
