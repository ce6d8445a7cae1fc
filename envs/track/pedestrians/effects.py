"""What light, sensor and coder do to a frame; every number is a function of the episode's seed and the frame."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PedestrianConfig

Image = NDArray[np.uint8]

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
        self._places: NDArray[np.int64] | None = None
        self._width, self._height = width, height
        if deviation <= 0.0:
            return
        self._places = rng.permutation(_BANK)
        shape = (height + _SIDE, width + _SIDE)
        common = rng.standard_normal((*shape, 1), dtype=np.float32) * np.float32(math.sqrt(_COMMON) * deviation)
        noise = rng.standard_normal((*shape, 3), dtype=np.float32)
        noise *= np.float32(math.sqrt(1.0 - _COMMON) * deviation)
        noise += common
        np.rint(noise, out=noise)
        # Two unsigned tiles: OpenCV adds and subtracts those fastest, and stops at black and white.
        self._brighter = np.clip(noise, 0.0, 255.0).astype(np.uint8)
        self._darker = np.clip(-noise, 0.0, 255.0).astype(np.uint8)

    def expose(self, image: Image, frame: int) -> None:
        """Add the frame's noise in place."""
        if self._places is None:
            return
        top, left = divmod(int(self._places[frame % _BANK]), _SIDE)
        window = (slice(top, top + self._height), slice(left, left + self._width))
        cv2.add(image, self._brighter[window], dst=image)
        cv2.subtract(image, self._darker[window], dst=image)


def brighten(image: Image, change: float) -> None:
    """Make a frame brighter or darker by whole gray levels, in place."""
    levels = round(change)
    if levels > 0:
        cv2.add(image, np.full(4, float(levels)), dst=image)
    elif levels < 0:
        cv2.subtract(image, np.full(4, float(-levels)), dst=image)


def compress(image: Image, strength: float) -> Image:
    """A frame as a JPEG coder leaves it.

    Args:
        image: RGB.
        strength: 0 (left as it is) to 1 (quality 10).
    """
    if strength <= 0.0:
        return image
    quality = round(100.0 - 90.0 * strength)
    written, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not written:
        raise RuntimeError(f"OpenCV could not code a frame of shape {image.shape} as JPEG")
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    if decoded is None:
        raise RuntimeError(f"OpenCV could not read its own JPEG of a frame of shape {image.shape}")
    return np.asarray(decoded, dtype=np.uint8)
