"""Box of the alternatives that Wu and Hu (2010) argue against: another update of the background, particles."""

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
from servotrack.baselines.papers.claims import effect_of, paired_effect
from servotrack.baselines.papers.gm_phd_video.alternatives import UnmaskedBackground, particle_filter
from servotrack.baselines.papers.gm_phd_video.events import KINDS, WINDOW, find_events, handled, regions_of_people
from servotrack.baselines.papers.gm_phd_video.experiment import COUNTED_FRAMES, Progressing, count_right
from servotrack.baselines.papers.parts import Arrays, shown_parts_of_seeds
from servotrack.estimators.boxes import BoxSetFilter
from servotrack.estimators.types import Array

PAPER_NAME = "gm_phd_video"
UPDATE_AXES = ("threshold", "learning_rate")
TWO, ONE = "two people", "one target"
"""What two people are while they are one region, by the names of the assumption `merged`."""
SEQUENCES = 10
"""Rendered sequences of the box; each gives all its points."""
DETECTORS = {"printed": "masked-paper", "ours": "masked"}
OURS, PARTICLES, MIXTURE = "ours", "particles", "mixture"


def _update_detectors() -> dict[str, Detector]:
    found: dict[str, Detector] = {}
    for at in box_points(PAPER_NAME, UPDATE_AXES):
        masked: Any = create_detector(DETECTORS["printed"], None, **at)
        name = f"{at['threshold']:g}/{at['learning_rate']:g}"
        found |= {f"masked/{name}": masked, f"unmasked/{name}": UnmaskedBackground(masked)}
    return found


def _alternatives(size: tuple[int, int]) -> tuple[dict[str, Detector], dict[str, tuple[str, BoxTracker]]]:
    """Detectors by name, and trackers by name, each with the name of its detector."""
    detectors = _update_detectors()
    printed = BoxSetFilter(phd_as_printed())
    trackers: dict[str, tuple[str, BoxTracker]] = {name: (name, printed) for name in detectors}
    detectors[OURS] = create_detector(DETECTORS["ours"], threshold=25.0)
    return detectors, {**trackers, MIXTURE: (OURS, printed), PARTICLES: (OURS, particle_filter(size))}


def play(
    sequence: sequences.Sequence, detectors: Mapping[str, Detector], trackers: Mapping[str, tuple[str, BoxTracker]]
) -> Arrays:
    """Run detectors and trackers over a sequence.

    Args:
        sequence: Sequence.
        detectors: Detectors by name.
        trackers: Trackers by name, each with the name of its detector.

    Returns:
        By tracker its median time per frame, s; by tracker and reading of `merged` the share of frames with the right
        count, the people reported too many per frame, the number of events of each kind that it handled, and where
        wrong counts lie. Beside them the events of each kind.
    """
    states: dict[str, Any] = {}
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


class AlternativesBox:
    """Results of the alternatives at all points, computed or read.

    Args:
        folder: Folder of the finished parts.
        progress: Progress display that gets a bar.
        count: Number of rendered sequences.
    """

    def __init__(self, folder: Path, progress: Progress, count: int = SEQUENCES) -> None:
        points = box_points(PAPER_NAME, UPDATE_AXES)
        self._rows = shown_parts_of_seeds(progress, "box of assumptions", folder, count, _rendered, points=points)

    def _values(self, tracker: str, field: str) -> Array:
        return np.array([row[f"{tracker}|{field}"] for row in self._rows], np.float64)

    def updates(self) -> tuple[Point, ...]:
        """Points of "the count is right more often with the masked update", %."""

        def effect(at: Mapping[str, Value]) -> Effect:
            name = f"{at['threshold']:g}/{at['learning_rate']:g}"
            masked, unmasked = (self._values(f"{kind}/{name}", f"right|{TWO}") for kind in ("masked", "unmasked"))
            measured = "count right, masked - unmasked update, detector as printed, GM-PHD table 1"
            return paired_effect(masked, unmasked, "% of frames", measured, 100.0)

        return tuple(Point(at, (effect(at),)) for at in box_points(PAPER_NAME, UPDATE_AXES))

    def particles(self) -> tuple[Effect, ...]:
        """Effects of "the particle filter costs more and counts worse", on the same detections."""
        right, times = (
            {name: self._values(name, field) for name in (MIXTURE, PARTICLES)} for field in (f"right|{TWO}", "seconds")
        )
        return (
            paired_effect(right[MIXTURE], right[PARTICLES], "% of frames", "count right, GM-PHD - particle PHD", 100.0),
            paired_effect(times[PARTICLES], times[MIXTURE], "ms", "filter per frame, particle PHD - GM-PHD", 1e3),
        )


def _rendered(seed: int) -> Arrays:
    sequence = sequences.rendered(seed, script=sequences.SCRIPT)
    return play(sequence, *_alternatives(sequence.size))


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
