"""The detector behind the observations `blobs` and `centroids`: paper 000's, which knows the empty lobby."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.draw import Stage
from servotrack.envs.track.pedestrians.people import People
from servotrack.estimators.detect import MaskedBackground
from servotrack.estimators.detect.blobs import BlobFinder
from servotrack.estimators.detect.bodies import Cover
from servotrack.estimators.detect.faint import FaintRules
from servotrack.estimators.detect.healing import HealingRules
from servotrack.estimators.types import Array

_EMPTY_FRAMES = 5
"""Frames of the empty lobby from which the detector has learned the background."""
_NONE = np.zeros(0)
_NOBODY = People(np.zeros(0, np.int64), np.zeros((0, 2)), _NONE, _NONE, _NONE, _NONE, np.zeros(0, np.int64))
_DETECTOR = MaskedBackground(
    threshold=30.0,
    least_threshold=15.0,
    faint=10.0,
    learning_rate=0.02,
    start="median",
    color="max",
    hold="blobs",
    shadows=False,
    heal_every=5,
    flood=0.5,
    flood_frames=20,
    blobs=BlobFinder(
        opening=3,
        closing=(3, 7),
        smallest=40,
        split=True,
        least_height=20.0,
        bins=0,
        cover=Cover(
            wide=0.5,
            tall=1.2,
            gap=0.4,
            core=0.2,
            share=0.25,
            penalty=0.25,
            below=0.5,
            score=0.15,
            aspect=0.36,
            reach=0.23,
            people=12,
            join_after=15.0,
            divide_after=60.0,
            quantile=0.65,
        ),
        filled=0.2,
    ),
    faint_rules=FaintRules(slender=0.65, seeds=12, whole=0.8),
    healing=HealingRules(reach=3, ghost_ratio=2.0, light_correlation=0.6, lag=6, light_area=0.02),
)
"""Every parameter is given: the world stays the same where the defaults of the detector change."""


class MotionSensor:
    """Turns the frames of one episode into sets of detections, in random order.

    Args:
        config: The scene.
        stage: Of the episode; the sensor has seen it empty.
        rng: Decides the order of rows, frame by frame.
    """

    def __init__(self, config: PedestrianConfig, stage: Stage, rng: np.random.Generator) -> None:
        self._rows, self._boxes = config.measurement_rows, config.answers_boxes
        self._size = np.array([config.width, config.height], dtype=np.float64)
        empty = np.stack([stage.draw(_NOBODY, frame).image for frame in range(_EMPTY_FRAMES)])
        self._state: Any = _DETECTOR.initial(empty)
        self._order = rng.random((config.horizon + 1, self._rows))

    def observe(self, image: NDArray[np.uint8], frame: int) -> Array:
        """Detections in the next frame; where there are more than rows, the smallest are dropped.

        Args:
            image: RGB, shape (H, W, 3).
            frame: Its number.

        Returns:
            Shape (rows, 1 + 4) or (rows, 1 + 2): existence, then boxes or centroids, px.
        """
        self._state, found = _DETECTOR.step(self._state, image)
        states = found.boxes if self._boxes else found.centroids
        kept = np.argsort(-found.areas, kind="stable")[: self._rows]
        order = np.argsort(self._order[frame, : len(kept)])
        states = states[kept[order]]
        # Boxes have left, top and width, height: two pairs within the frame.
        limits = np.tile(self._size, states.shape[1] // 2)
        out = np.zeros((self._rows, 1 + states.shape[1]))
        out[: len(states), 0] = 1.0
        out[: len(states), 1:] = np.clip(states, 0.0, limits)
        return out
