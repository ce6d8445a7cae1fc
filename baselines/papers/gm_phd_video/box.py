"""Box of open assumptions of Wu and Hu (2010)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from servotrack.baselines.agents.people.catalog import BoxTracker, Detector, create_detector, phd_as_printed
from servotrack.baselines.evaluation.statistics import wilson_interval
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.boxes import Effect, Point, Value, box_points
from servotrack.baselines.papers.claims import effect_of, mean_effect, paired_effect
from servotrack.baselines.papers.gm_phd_video.alternatives import (
    UnmaskedBackground,
    particle_filter,
    with_births,
    without_pruning,
)
from servotrack.baselines.papers.gm_phd_video.events import KINDS, WINDOW, find_events, handled, regions_of_people
from servotrack.baselines.papers.gm_phd_video.experiment import COUNTED_FRAMES, Progressing, count_right
from servotrack.baselines.papers.parts import Arrays, parts_of_seeds
from servotrack.estimators.boxes import BoxSetFilter, RawDetections
from servotrack.estimators.types import Array

PAPER_NAME = "gm_phd_video"
RUN_AXES = ("detector", "threshold", "birth_weight")
"""Assumptions that a run of the filter depends on; `merged` only changes what is right."""
UPDATE_RUN_AXES = ("threshold", "learning_rate")
COUNT_AXES, UPDATE_AXES = (*RUN_AXES, "merged"), (*UPDATE_RUN_AXES, "merged")
DETECTOR_AXES, PRUNING_AXES = ("threshold", "merged"), ("detector", "merged")
TWO, ONE = "two people", "one target"
"""What two people are while they are one region, by the names of the assumption `merged`."""
SEQUENCES = 10
"""Rendered sequences of the box; each gives all its points."""
DETECTORS = {"printed": "masked-paper", "ours": "masked"}
UNFILTERED, UNPRUNED, PARTICLES, MIXTURE = "no filter", "not pruned", "particles", "mixture"


def _count_detectors() -> dict[str, Detector]:
    found: dict[str, Detector] = {}
    for at in box_points(PAPER_NAME, RUN_AXES):
        name = f"{at['detector']}/{at['threshold']:g}"
        found.setdefault(name, create_detector(DETECTORS[str(at["detector"])], threshold=at["threshold"]))
    return found


def _update_detectors() -> dict[str, Detector]:
    found: dict[str, Detector] = {}
    for at in box_points(PAPER_NAME, UPDATE_RUN_AXES):
        masked: Any = create_detector(DETECTORS["printed"], None, **at)
        name = f"{at['threshold']:g}/{at['learning_rate']:g}"
        found |= {f"masked/{name}": masked, f"unmasked/{name}": UnmaskedBackground(masked)}
    return found


def _trackers(size: tuple[int, int]) -> dict[str, tuple[str, BoxTracker]]:
    """Trackers by name, each with the name of its detector."""
    found: dict[str, tuple[str, BoxTracker]] = {}
    for at in box_points(PAPER_NAME, RUN_AXES):
        detector = f"{at['detector']}/{at['threshold']:g}"
        found[f"{detector}/{UNFILTERED}"] = (detector, RawDetections())
        found[f"{detector}/{at['birth_weight']:g}"] = (detector, with_births(float(at["birth_weight"])))
    for name in _update_detectors():
        found[name] = (name, BoxSetFilter(phd_as_printed()))
    for name in DETECTORS:
        found[f"{name}/25/{UNPRUNED}"] = (f"{name}/25", without_pruning())
    shipped = "ours/25"
    found[MIXTURE] = (shipped, BoxSetFilter(phd_as_printed()))
    found[PARTICLES] = (shipped, particle_filter(size))
    return found


def play(sequence: sequences.Sequence) -> Arrays:
    """Run all detectors and trackers of the box over a sequence.

    Returns:
        By tracker its median time per frame, s; by tracker and reading of `merged` the share of frames with the right
        count, the people reported too many per frame, the number of events of each kind that it handled, and where
        wrong counts lie. Beside them the events of each kind.
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
    right = {TWO: sequence.numbers, ONE: regions_of_people(sequence.truth, sequence.numbers)}
    for name, run in runs.items():
        outcome = run.outcome(0.0)
        arrays[f"{name}|seconds"] = outcome.filter_seconds
        for merged, numbers in right.items():
            good = np.array(
                handled(events, sequence.truth, numbers, outcome.tracks, outcome.counts, identities_kept=merged == TWO),
                np.bool_,
            )
            wrong = outcome.counts != numbers
            extra = np.clip(outcome.counts - numbers, 0, None)[:COUNTED_FRAMES]
            arrays |= {
                f"{name}|right|{merged}": count_right(outcome, numbers),
                f"{name}|extra|{merged}": float(extra.mean()),
                f"{name}|handled|{merged}": np.bincount(kinds[good], minlength=len(KINDS)),
                f"{name}|near|{merged}": float(changes[: len(wrong)][wrong].mean()) if wrong.any() else np.nan,
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
        points = [box_points(PAPER_NAME, axes) for axes in (RUN_AXES, UPDATE_RUN_AXES)]
        self._rows = parts_of_seeds(folder, count, _rendered, lambda: progress.advance(bar), points=points)

    def values(self, tracker: str, field: str, merged: Value = TWO) -> Array:
        """Values of a tracker, one per sequence, under a reading of `merged`."""
        return np.array([row[f"{tracker}|{field}|{merged}"] for row in self._rows], np.float64)

    def seconds(self, tracker: str) -> Array:
        """Median times of a tracker per frame, one per sequence, s."""
        return np.array([row[f"{tracker}|seconds"] for row in self._rows], np.float64)

    def counts(self, reference: float) -> tuple[Point, ...]:
        """Points of "the count is right in more than a share of the frames", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            right = 100.0 * self.values(_filtered(at), "right", at["merged"])
            measured = f"count right - {100.0 * reference:.1f}, GM-PHD table 1"
            return paired_effect(right, np.full_like(right, 100.0 * reference), "% of frames", measured)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, COUNT_AXES))

    def filtering(self) -> tuple[Point, ...]:
        """Points of "the count is right more often with the filter than without", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            bare = f"{at['detector']}/{at['threshold']:g}/{UNFILTERED}"
            filtered, plain = (self.values(name, "right", at["merged"]) for name in (_filtered(at), bare))
            return paired_effect(filtered, plain, "% of frames", "count right, GM-PHD table 1 - no filter", 100.0)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, COUNT_AXES))

    def events(self) -> tuple[Point, ...]:
        """Points of "events of each kind are handled", share of the events, one effect per kind."""
        return tuple(
            Point(at, event_effects(self.values(_filtered(at), "handled", at["merged"]), self._happened))
            for at in box_points(PAPER_NAME, COUNT_AXES)
        )

    def after_occlusions(self) -> tuple[Point, ...]:
        """Points of "people who part are reported again, whatever their identities", share of the splits."""
        split = KINDS.index("split")
        return tuple(
            Point(at, (event_effects(self.values(_filtered(at), "handled", ONE), self._happened)[split],))
            for at in box_points(PAPER_NAME, RUN_AXES)
        )

    @property
    def _happened(self) -> Array:
        return np.array([row["happened"] for row in self._rows], np.float64)

    def detections(self) -> tuple[Point, ...]:
        """Points of "the printed detector alone finds the right number", share of the frames."""

        def effect(at: Mapping[str, Value]) -> Effect:
            found = self.values(f"printed/{at['threshold']:g}/{UNFILTERED}", "right", at["merged"])
            return mean_effect(found, "of frames", "number of regions right, detector as printed")

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, DETECTOR_AXES))

    def pruning(self) -> tuple[Point, ...]:
        """Points of "with T = 0.2 a step takes less time and fewer people are reported too many"."""

        def effects(at: Mapping[str, Value]) -> tuple[Effect, ...]:
            pruned, kept = (f"{at['detector']}/25/{name}" for name in ("0.05", UNPRUNED))
            times = self.seconds(pruned), self.seconds(kept)
            extra = self.values(pruned, "extra", at["merged"]), self.values(kept, "extra", at["merged"])
            return (
                paired_effect(*times, "ms", "filter per frame, T = 0.2 - T = 1e-5", 1e3),
                paired_effect(*extra, "people", "reported too many per frame, T = 0.2 - T = 1e-5"),
            )

        return tuple(Point(at, effects(at)) for at in box_points(PAPER_NAME, PRUNING_AXES))

    def changes(self) -> tuple[Point, ...]:
        """Points of "wrong counts lie near appearances and disappearances", share of the wrong frames."""

        def effect(at: Mapping[str, Value]) -> Effect:
            near = self.values(_filtered(at), "near", at["merged"])
            near = near[np.isfinite(near)]
            measured = f"within {WINDOW} frames of an appearance or disappearance, GM-PHD table 1"
            return mean_effect(near, "of wrong frames", measured)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, COUNT_AXES))

    def updates(self) -> tuple[Point, ...]:
        """Points of "the count is right more often with the masked update", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            name = f"{at['threshold']:g}/{at['learning_rate']:g}"
            masked, unmasked = (self.values(f"{kind}/{name}", "right", at["merged"]) for kind in ("masked", "unmasked"))
            measured = "count right, masked - unmasked update, detector as printed, GM-PHD table 1"
            return paired_effect(masked, unmasked, "% of frames", measured, 100.0)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, UPDATE_AXES))

    def particles(self) -> tuple[Effect, ...]:
        """Effects of "the particle filter costs more and counts worse", on the same detections."""
        right = self.values(MIXTURE, "right"), self.values(PARTICLES, "right")
        times = self.seconds(PARTICLES), self.seconds(MIXTURE)
        return (
            paired_effect(*right, "% of frames", "count right, GM-PHD - particle PHD", 100.0),
            paired_effect(*times, "ms", "filter per frame, particle PHD - GM-PHD", 1e3),
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
