"""Alternatives that Wu and Hu (2010) argue against, and the cost of a step of their filter."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.people.catalog import REFERENCE_AREA, phd_as_printed
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.boxes import Effect
from servotrack.baselines.papers.claims import mean_effect
from servotrack.estimators.boxes import BoxSetFilter, centroid_model
from servotrack.estimators.detect import MaskedBackground
from servotrack.estimators.detect.background import BackgroundState
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs import Birth, MeasurementBirth, ParticlePHD

TIMED = 12
"""Repetitions of the timing of one step."""
MEASUREMENTS, TARGETS = (40, 80, 160, 320), (5, 10, 20, 40)
"""Numbers of measurements, and of targets, of the timing."""
KEPT_WEIGHT = 1e-5
"""Smallest weight of a component in the filter without the paper's pruning."""


@dataclass(frozen=True)
class UnmaskedBackground:
    """The paper's detector with a background that also learns under foreground: B' = (1 - a) B + a I.

    Args:
        masked: Detector with eq. (6), whose other steps are used.
    """

    masked: MaskedBackground

    def initial(self, frames: ArrayLike) -> BackgroundState:
        """Return the state before the first frame, as `MaskedBackground.initial` does."""
        return self.masked.initial(frames)

    def step(
        self, state: BackgroundState, frame: ArrayLike, dt: float | None = None
    ) -> tuple[BackgroundState, Detections]:
        """Detect in a frame, then learn from all of it; arguments as in `MaskedBackground.step`."""
        after, found = self.masked.step(state, frame, dt)
        background = state.background.copy()
        cv2.accumulateWeighted(np.asarray(frame), background, self.masked.learning_rate)
        rounded = np.clip(np.rint(background), 0.0, 255.0).astype(np.uint8)
        return after._replace(background=background, rounded=rounded), found


def with_births(weight: float) -> BoxSetFilter:
    """Return the filter of table 1 with births of a weight at unexplained measurements."""
    return BoxSetFilter(replace(phd_as_printed(), birth=MeasurementBirth(weight, 2.0, weight)))


def without_pruning() -> BoxSetFilter:
    """Return the filter of table 1 that keeps components down to a weight of `KEPT_WEIGHT` instead of T = 0.2."""
    printed = phd_as_printed()
    return BoxSetFilter(replace(printed, reduction=replace(printed.reduction, prune=KEPT_WEIGHT)))


def particle_filter(size: tuple[int, int]) -> BoxSetFilter:
    """Return a particle PHD filter with the values of table 1; births anywhere in the frame.

    Args:
        size: Width and height of the frame, px.
    """
    width, height = size
    birth = Birth(
        np.array([0.05]),
        np.array([[0.5 * width, 0.0, 0.5 * height, 0.0]]),
        np.diag([width**2 / 12.0, 4.0, height**2 / 12.0, 4.0]),
    )
    model = centroid_model(process_noise=4.0, measurement_noise=2.0)
    return BoxSetFilter(ParticlePHD(model, birth, 0.01 / REFERENCE_AREA, survival=0.9, detection=0.99))  # type: ignore[arg-type]


def cost_slopes() -> tuple[Effect, ...]:
    """Effects of "the cost is linear": slopes of log time over log number of measurements, and of components."""
    by_measurements = _slopes([(10, number) for number in MEASUREMENTS], MEASUREMENTS)
    by_targets = _slopes([(number, 10) for number in TARGETS], TARGETS)
    names = ("measurements, 10 targets", "targets, 10 measurements")
    return tuple(
        mean_effect(slopes, "log/log", f"slope of the time of a step over the number of {name}")
        for slopes, name in zip((by_measurements, by_targets), names, strict=True)
    )


def _slopes(sizes: Sequence[tuple[int, int]], numbers: Sequence[int]) -> list[float]:
    """Slopes of the log of the least time of a step over the log of `numbers`, in each repetition.

    Args:
        sizes: Targets and measurements.
        numbers: Number that grows.
    """
    tracker = phd_as_printed(spawn=False)
    slopes = []
    for seed in seeds.take("tune", TIMED):
        rng = np.random.default_rng(seed)
        least = []
        for targets, measured in sizes:
            places = rng.uniform((0.0, 0.0), (380.0, 280.0), (max(targets, measured), 2))
            state = tracker.initial(places[:targets])
            for _ in range(4):
                state, _ = tracker.step(state, places[:targets])
            times = []
            for _ in range(30):
                begin = time.perf_counter()
                tracker.step(state, places[:measured])
                times.append(time.perf_counter() - begin)
            least.append(min(times))
        slopes.append(float(np.polyfit(np.log(numbers), np.log(least), 1)[0]))
    return slopes
