"""Motion detector of the observations `blobs` and `centroids` (Wu and Hu 2010), with a known background."""

from __future__ import annotations

import math
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
"""Number of frames of the empty lobby from which the background is learned."""
_EMPTY = np.zeros(0)
_NO_PEOPLE = People(np.zeros(0, np.int64), np.zeros((0, 2)), _EMPTY, _EMPTY, _EMPTY, _EMPTY, np.zeros(0, np.int64))
_DETECTOR = MaskedBackground(
    threshold=30.0,
    least_threshold=15.0,
    faint=10.0,
    noise=None,
    learning_rate=0.02,
    start="median",
    color="max",
    hold="blobs",
    shadows=False,
    heal_every=5,
    flood=0.5,
    flood_time=0.8,
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
            mass=0.0,
        ),
        filled=0.2,
        scene=None,
    ),
    faint_rules=FaintRules(slender=0.65, seeds=12, whole=0.8),
    healing=HealingRules(reach=3, ghost_ratio=2.0, light_correlation=0.6, lag=6, light_area=0.02),
    edges=0.0,
    still=None,
    motion=None,
    exposure=None,
    dim=None,
    same_light=False,
    full_rate=math.inf,
    frame_rate=25.0,
)
"""All parameters are explicit, so that changes of the detector's defaults do not change the environment."""


class MotionSensor:
    """Sensor that converts the frames of one episode to sets of detections, in random order.

    Args:
        config: Parameters of the environment.
        stage: Renderer of the episode; its empty frames give the background.
        rng: Generator of the order of rows.
    """

    def __init__(self, config: PedestrianConfig, stage: Stage, rng: np.random.Generator) -> None:
        self._rows, self._boxes = config.measurement_rows, config.answers_boxes
        self._size = np.array([config.width, config.height], dtype=np.float64)
        empty = np.stack([stage.draw(_NO_PEOPLE, frame).image for frame in range(_EMPTY_FRAMES)])
        self._state: Any = _DETECTOR.initial(empty)
        self._order = rng.random((config.horizon + 1, self._rows))

    def observe(self, image: NDArray[np.uint8], frame: int) -> Array:
        """Return the detections in the next frame. If there are more than rows, the smallest are dropped.

        Args:
            image: RGB image, shape (H, W, 3).
            frame: Number of the frame.

        Returns:
            Existence, then boxes or centroids (px), shape (rows, 1 + 4) or (rows, 1 + 2).
        """
        self._state, found = _DETECTOR.step(self._state, image)
        states = found.boxes if self._boxes else found.centroids
        kept = np.argsort(-found.areas, kind="stable")[: self._rows]
        order = np.argsort(self._order[frame, : len(kept)])
        states = states[kept[order]]
        # Boxes have two pairs (left, top) and (width, height), both limited by the frame size.
        limits = np.tile(self._size, states.shape[1] // 2)
        out = np.zeros((self._rows, 1 + states.shape[1]))
        out[: len(states), 0] = 1.0
        out[: len(states), 1:] = np.clip(states, 0.0, limits)
        return out
