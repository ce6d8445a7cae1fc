"""Box of open assumptions of Wu and Hu (2010), and the alternatives that the paper argues against."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from rich.progress import Progress

from servotrack.baselines.agents.people.catalog import (
    REFERENCE_AREA,
    BoxTracker,
    Detector,
    create_detector,
    phd_as_printed,
)
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.statistics import wilson_interval
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.boxes import Effect, Point, Value, box_points
from servotrack.baselines.papers.claims import effect_of, mean_effect, paired_effect
from servotrack.baselines.papers.gm_phd_video.events import KINDS, WINDOW, find_events, handled
from servotrack.baselines.papers.gm_phd_video.experiment import Progressing, count_right
from servotrack.baselines.papers.parts import Arrays, part, setting_of
from servotrack.estimators.boxes import BoxSetFilter, RawDetections, centroid_model
from servotrack.estimators.detect import MaskedBackground
from servotrack.estimators.detect.background import BackgroundState
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs import Birth, MeasurementBirth, ParticlePHD
from servotrack.estimators.types import Array

PAPER_NAME = "gm_phd_video"
COUNT_AXES = ("detector", "threshold", "birth_weight")
UPDATE_AXES = ("threshold", "learning_rate")
SEQUENCES = 10
"""Rendered sequences of the box; each gives all its points."""
DETECTORS = {"printed": "masked-paper", "ours": "masked"}
UNFILTERED, PARTICLES, MIXTURE = "no filter", "particles", "mixture"
TIMED = 12
"""Repetitions of the timing of one step."""
MEASUREMENTS, TARGETS = (40, 80, 160, 320), (5, 10, 20, 40)
"""Numbers of measurements, and of targets, of the timing."""


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


def _count_detectors() -> dict[str, Detector]:
    found: dict[str, Detector] = {}
    for at in box_points(PAPER_NAME, COUNT_AXES):
        name = f"{at['detector']}/{at['threshold']:g}"
        found.setdefault(name, create_detector(DETECTORS[str(at["detector"])], threshold=at["threshold"]))
    return found


def _update_detectors() -> dict[str, Detector]:
    found: dict[str, Detector] = {}
    for at in box_points(PAPER_NAME, UPDATE_AXES):
        masked: Any = create_detector(DETECTORS["printed"], None, **at)
        name = f"{at['threshold']:g}/{at['learning_rate']:g}"
        found |= {f"masked/{name}": masked, f"unmasked/{name}": UnmaskedBackground(masked)}
    return found


def _trackers(size: tuple[int, int]) -> dict[str, tuple[str, BoxTracker]]:
    """Trackers by name, each with the name of its detector."""
    found: dict[str, tuple[str, BoxTracker]] = {}
    for at in box_points(PAPER_NAME, COUNT_AXES):
        detector = f"{at['detector']}/{at['threshold']:g}"
        found[f"{detector}/{UNFILTERED}"] = (detector, RawDetections())
        found[f"{detector}/{at['birth_weight']:g}"] = (detector, with_births(float(at["birth_weight"])))
    for name in _update_detectors():
        found[name] = (name, BoxSetFilter(phd_as_printed()))
    shipped = "ours/25"
    found[MIXTURE] = (shipped, BoxSetFilter(phd_as_printed()))
    found[PARTICLES] = (shipped, particle_filter(size))
    return found


def play(sequence: sequences.Sequence) -> Arrays:
    """Run all detectors and trackers of the box over a sequence.

    Returns:
        By tracker: the share of frames with the right count, the number of events of each kind that it handled, its
        median time per frame, s. Beside them the events of each kind, and where wrong counts lie.
    """
    detectors = {**_count_detectors(), **_update_detectors()}
    states: dict[str, Any] = {}
    trackers = _trackers(sequence.size)
    runs = {name: Progressing(tracker) for name, (_, tracker) in trackers.items()}
    for number, frame in enumerate(sequence.frames):
        found = {}
        for name, detector in detectors.items():
            if name not in states:
                states[name] = detector.initial(frame if sequence.background is None else sequence.background)
            states[name], found[name] = detector.step(states[name], frame)
        for name, (detector_name, _) in trackers.items():
            runs[name].take(number, found[detector_name])
    events = find_events(sequence.truth, len(sequence.numbers))
    kinds = np.array([KINDS.index(event.kind) for event in events], np.int64)
    changes = np.zeros(len(sequence.numbers) + WINDOW, np.bool_)
    for event in events:
        if event.kind in ("appear", "disappear"):
            changes[max(event.frame - WINDOW, 0) : event.frame + WINDOW] = True
    arrays: dict[str, Any] = {"happened": np.bincount(kinds, minlength=len(KINDS))}
    for name, run in runs.items():
        outcome = run.outcome(0.0)
        good = np.array(handled(events, sequence.truth, sequence.numbers, outcome.tracks, outcome.counts), np.bool_)
        wrong = outcome.counts != sequence.numbers
        arrays |= {
            f"{name}|right": count_right(outcome, sequence.numbers),
            f"{name}|handled": np.bincount(kinds[good], minlength=len(KINDS)),
            f"{name}|seconds": outcome.filter_seconds,
            f"{name}|near": float(changes[: len(wrong)][wrong].mean()) if wrong.any() else np.nan,
        }
    return arrays


class VideoBox:
    """Results at all points, computed or read.

    Args:
        folder: Folder of the finished parts.
        progress: Progress display that gets a bar.
        count: Number of rendered sequences.
    """

    def __init__(self, folder: Path, progress: Progress, count: int = SEQUENCES) -> None:
        bar = progress.add_task("box of assumptions", total=count)
        self._rows = []
        points = [box_points(PAPER_NAME, axes) for axes in (COUNT_AXES, UPDATE_AXES)]
        for seed in seeds.take("test", count):
            setting = setting_of(seed=seed, points=points)
            self._rows.append(part(folder / f"{seed}.npz", setting, lambda seed=seed: _rendered(seed)))  # type: ignore[misc]
            progress.advance(bar)

    def values(self, tracker: str, field: str) -> Array:
        """Values of a tracker, one per sequence."""
        return np.array([row[f"{tracker}|{field}"] for row in self._rows], np.float64)

    def counts(self, reference: float) -> tuple[Point, ...]:
        """Points of "the count is right in more than a share of the frames", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            right = 100.0 * self.values(_filtered(at), "right")
            measured = f"count right - {100.0 * reference:.1f}, GM-PHD table 1"
            return paired_effect(right, np.full_like(right, 100.0 * reference), "% of frames", measured)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, COUNT_AXES))

    def filtering(self) -> tuple[Point, ...]:
        """Points of "the count is right more often with the filter than without", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            bare = f"{at['detector']}/{at['threshold']:g}/{UNFILTERED}"
            filtered, plain = (self.values(name, "right") for name in (_filtered(at), bare))
            return paired_effect(filtered, plain, "% of frames", "count right, GM-PHD table 1 - no filter", 100.0)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, COUNT_AXES))

    def events(self) -> tuple[Point, ...]:
        """Points of "events of each kind are handled", share of the events, one effect per kind."""
        happened = np.array([row["happened"] for row in self._rows], np.float64)
        return tuple(
            Point(at, event_effects(self.values(_filtered(at), "handled"), happened))
            for at in box_points(PAPER_NAME, COUNT_AXES)
        )

    def changes(self) -> tuple[Point, ...]:
        """Points of "wrong counts lie near appearances and disappearances", share of the wrong frames."""

        def effect(at: Mapping[str, Value]) -> Effect:
            near = self.values(_filtered(at), "near")
            near = near[np.isfinite(near)]
            measured = f"within {WINDOW} frames of an appearance or disappearance, GM-PHD table 1"
            return mean_effect(near, "of wrong frames", measured)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, COUNT_AXES))

    def updates(self) -> tuple[Point, ...]:
        """Points of "the count is right more often with the masked update", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            name = f"{at['threshold']:g}/{at['learning_rate']:g}"
            masked, unmasked = (self.values(f"{kind}/{name}", "right") for kind in ("masked", "unmasked"))
            measured = "count right, masked - unmasked update, detector as printed, GM-PHD table 1"
            return paired_effect(masked, unmasked, "% of frames", measured, 100.0)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, UPDATE_AXES))

    def particles(self) -> tuple[Effect, ...]:
        """Effects of "the particle filter costs more and counts worse", on the same detections."""

        def compare(first: str, second: str, field: str, unit: str, measured: str, scale: float) -> Effect:
            return paired_effect(self.values(first, field), self.values(second, field), unit, measured, scale)

        return (
            compare(MIXTURE, PARTICLES, "right", "% of frames", "count right, GM-PHD - particle PHD", 100.0),
            compare(PARTICLES, MIXTURE, "seconds", "ms", "filter per frame, particle PHD - GM-PHD", 1e3),
        )


def _filtered(at: Mapping[str, Value]) -> str:
    return f"{at['detector']}/{at['threshold']:g}/{at['birth_weight']:g}"


def _rendered(seed: int) -> Arrays:
    return play(sequences.rendered(seed, script=sequences.SCRIPT))


def event_effects(good: Array, happened: Array) -> tuple[Effect, ...]:
    """Share of the events of each kind that were handled, with Wilson's interval over events.

    Args:
        good: Handled events by sequence and kind. Shape (sequences, 4).
        happened: All events. Shape (sequences, 4).
    """
    effects = []
    for number, kind in enumerate(KINDS):
        interval = wilson_interval(int(good[:, number].sum()), max(int(happened[:, number].sum()), 1))
        effects.append(effect_of(interval, "of events", kind, int((happened[:, number] > 0).sum()) or 1))
    return tuple(effects)


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


def shipped(points: Sequence[Point], **at: Value) -> tuple[Effect, ...]:
    """Effects of the point with the given values."""
    return next(point.effects for point in points if all(point.at[name] == value for name, value in at.items()))
