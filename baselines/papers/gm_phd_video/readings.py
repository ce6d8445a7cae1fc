"""Readings of Wu and Hu (2010) where its text leaves the filter open, and the counts and events that are right.

What a filter reports is judged twice: while two people are one region they are two people, or one target.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from rich.progress import Progress

from servotrack.baselines.agents.people.catalog import BoxTracker, Detector, create_detector
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.boxes import Effect, Point, Value, box_points
from servotrack.baselines.papers.claims import mean_effect, paired_effect
from servotrack.baselines.papers.gm_phd_video.alternatives import with_births, without_pruning
from servotrack.baselines.papers.gm_phd_video.box import DETECTORS, ONE, PAPER_NAME, SEQUENCES, TWO, event_effects, play
from servotrack.baselines.papers.gm_phd_video.events import KINDS, WINDOW
from servotrack.baselines.papers.parts import Arrays, shown_parts_of_seeds
from servotrack.estimators.boxes import RawDetections
from servotrack.estimators.types import Array

RUN_AXES = ("detector", "threshold", "birth_weight")
"""Assumptions that a run of the filter depends on; `merged` only changes what is right."""
COUNT_AXES = (*RUN_AXES, "merged")
DETECTOR_AXES, PRUNING_AXES = ("threshold", "merged"), ("detector", "merged")
UNFILTERED, UNPRUNED = "no filter", "not pruned"


def _detectors() -> dict[str, Detector]:
    return {
        f"{at['detector']}/{at['threshold']:g}": create_detector(
            DETECTORS[str(at["detector"])], threshold=at["threshold"]
        )
        for at in box_points(PAPER_NAME, RUN_AXES[:2])
    }


def trackers() -> dict[str, tuple[str, BoxTracker]]:
    """Return the trackers of the box by name, each with the name of its detector."""
    found: dict[str, tuple[str, BoxTracker]] = {}
    for at in box_points(PAPER_NAME, RUN_AXES):
        detector = f"{at['detector']}/{at['threshold']:g}"
        found[f"{detector}/{UNFILTERED}"] = (detector, RawDetections())
        found[f"{detector}/{at['birth_weight']:g}"] = (detector, with_births(float(at["birth_weight"])))
    for name in DETECTORS:
        found[f"{name}/25/{UNPRUNED}"] = (f"{name}/25", without_pruning())
    return found


def read(sequence: sequences.Sequence) -> Arrays:
    """Run all detectors and trackers of the box over a sequence, see `play`."""
    return play(sequence, _detectors(), trackers())


def _rendered(seed: int) -> Arrays:
    return read(sequences.rendered(seed, script=sequences.SCRIPT))


class ReadingsBox:
    """Results at all points, computed or read.

    Args:
        folder: Folder of the finished parts.
        progress: Progress display that gets a bar.
        count: Number of rendered sequences.
    """

    def __init__(self, folder: Path, progress: Progress, count: int = SEQUENCES) -> None:
        points = box_points(PAPER_NAME, RUN_AXES)
        self._rows = shown_parts_of_seeds(progress, "readings", folder, count, _rendered, points=points)

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


def _filtered(at: Mapping[str, Value]) -> str:
    return f"{at['detector']}/{at['threshold']:g}/{at['birth_weight']:g}"
