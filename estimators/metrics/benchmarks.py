"""Scoring rules of public benchmarks: which boxes of the truth count, and which answers are left out.

The rules are those of MOTChallenge and KITTI tracking as their reference implementation, `trackeval` 1.3, has them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.estimators.metrics.joined import Joined
from servotrack.estimators.metrics.sequence import EPSILON, TrackSequence
from servotrack.estimators.types import Array, Labels, Mask


class LabeledBoxes(NamedTuple):
    """Boxes of a sequence with what benchmarks say of them, in the order of the file.

    Attributes:
        steps: Frames, shape (n,), int.
        ids: Identities, at most once in a frame, shape (n,), int.
        boxes: Left, top, width, height, shape (n, 4), px.
        classes: Classes, numbered as the benchmark does, shape (n,), int.
        counted: False for boxes that a flag excludes: flag 0 of MOTChallenge, occluded or truncated ones of KITTI.
            Shape (n,), bool.
    """

    steps: Labels
    ids: Labels
    boxes: Array
    classes: Labels
    counted: Mask

    def part(self, mask: Mask) -> LabeledBoxes:
        """Return the boxes where a mask of shape (n,) is true."""
        return LabeledBoxes(self.steps[mask], self.ids[mask], self.boxes[mask], self.classes[mask], self.counted[mask])


def plain_boxes(steps: Labels, ids: Labels, boxes: Array, kind: int = 1) -> LabeledBoxes:
    """Return boxes of one class that all count."""
    count = len(steps)
    return LabeledBoxes(steps, ids, boxes, np.full(count, kind, np.int64), np.ones(count, np.bool_))


@dataclass(frozen=True)
class Benchmark:
    """Rules of a benchmark.

    Attributes:
        name: Name for tables.
        scored: Class that counts; None: there are no classes.
        distractors: Classes that are like the scored one. Answers that match one of them are left out.
        classes: All classes that may occur; empty: no check.
        all_classes_match: True if answers are matched to objects of all classes; False for those of the scored class
            and its distractors.
        uncounted_match: True if answers that match a box that a flag excludes are left out, too.
        least_height: Answers without a match that are at most this high are left out, px.
        ignores_regions: True if answers without a match in ignored regions are left out.
        match: Smallest similarity at which an answer belongs to an object that does not count.
        region_share: Share of an answer inside an ignored region above which it is left out.
    """

    name: str
    scored: int | None = 1
    distractors: frozenset[int] = frozenset()
    classes: frozenset[int] = frozenset()
    all_classes_match: bool = True
    uncounted_match: bool = False
    least_height: float | None = None
    ignores_regions: bool = False
    match: float = 0.5
    region_share: float = 0.5


KITTI_CLASSES: Mapping[str, int] = {
    "car": 1, "van": 2, "truck": 3, "pedestrian": 4, "person": 5, "person_sitting": 5, "cyclist": 6, "tram": 7,
    "misc": 8, "dontcare": 9,
}  # fmt: skip
"""Classes of KITTI by name in small letters. TrackEval calls people who sit `person`."""
_MOT_CLASSES = frozenset(range(1, 14))
_MOT17_DISTRACTORS = frozenset({2, 7, 8, 12})
"""Person on vehicle, static person, distractor, reflection."""


def _kitti(name: str, scored: int, distractor: int) -> Benchmark:
    return Benchmark(
        name,
        scored,
        frozenset({distractor}),
        all_classes_match=False,
        uncounted_match=True,
        least_height=25.0,
        ignores_regions=True,
    )


BENCHMARKS: Mapping[str, Benchmark] = {
    "mot15": Benchmark("MOT15", None),
    "mot16": Benchmark("MOT16", 1, _MOT17_DISTRACTORS, _MOT_CLASSES),
    "mot17": Benchmark("MOT17", 1, _MOT17_DISTRACTORS, _MOT_CLASSES),
    "mot20": Benchmark("MOT20", 1, _MOT17_DISTRACTORS | {6}, _MOT_CLASSES),
    "dancetrack": Benchmark("DanceTrack", 1, _MOT17_DISTRACTORS, _MOT_CLASSES),
    "kitti-pedestrian": _kitti("KITTI pedestrian", 4, 5),
    "kitti-car": _kitti("KITTI car", 1, 2),
}
"""Rules by name. Those of DanceTrack, which has no distractors, are MOT17's."""


def box_similarities(first: Array, second: Array) -> Array:
    """Intersection over union of boxes, rounded as in the reference implementation.

    Args:
        first: Left, top, width, height, shape (n, 4).
        second: The same, shape (k, 4).

    Returns:
        Shape (n, k), 0 for boxes without area.
    """
    a, b = _corners(first), _corners(second)
    overlap = _overlap(a, b)
    areas = _areas(a)[:, None], _areas(b)[None, :]
    union = areas[0] + areas[1] - overlap
    some = (areas[0] > EPSILON) & (areas[1] > EPSILON) & (union > EPSILON)
    return np.divide(overlap, union, out=np.zeros_like(overlap), where=some)


def benchmark_sequence(
    truth: LabeledBoxes,
    found: LabeledBoxes,
    benchmark: Benchmark,
    regions: LabeledBoxes | None = None,
    similarities: Callable[[Array, Array], Array] = box_similarities,
) -> TrackSequence:
    """Apply the rules of a benchmark, and compute the similarities of what is left at each step.

    Args:
        truth: True boxes of all classes.
        found: Answers of a tracker. Their classes matter where the benchmark scores one class of several.
        benchmark: The rules.
        regions: Regions in which unmatched answers are left out.
        similarities: Function of true boxes (n, 4) and answers (k, 4) that returns similarities (n, k) from 0 to 1.

    Returns:
        Input of `clear_mot`, `identity_scores` and `hota_scores`.

    Raises:
        ValueError: The truth has a class that the benchmark does not know.
    """
    if benchmark.classes:
        unknown = sorted(set(np.unique(truth.classes).tolist()) - benchmark.classes)
        if unknown:
            raise ValueError(
                f"classes of the truth must be those of {benchmark.name}, 1 to {max(benchmark.classes)}, got "
                f"{unknown[0]}; choose another benchmark, such as mot15 for truth without classes"
            )
    if benchmark.scored is not None and not benchmark.all_classes_match:
        wanted = [benchmark.scored, *benchmark.distractors]
        truth = truth.part(np.isin(truth.classes, wanted))
        found = found.part(found.classes == benchmark.scored)
    counts = truth.counted & (True if benchmark.scored is None else truth.classes == benchmark.scored)
    true_names, found_names = np.unique(truth.ids[counts]), np.unique(found.ids)
    sizes, rows, columns, pairs = [], Joined(np.intp), Joined(np.intp), Joined(np.float64)
    for there, here, zones in _by_step(truth, found, regions):
        similarity = similarities(truth.boxes[there], found.boxes[here])
        zone_boxes = None if regions is None else regions.boxes[zones]
        kept = _kept_answers(truth, there, found.boxes[here], similarity, benchmark, zone_boxes)
        counted = counts[there]
        sizes.append((int(counted.sum()), int(kept.sum())))
        rows.append(np.searchsorted(true_names, truth.ids[there][counted]))
        columns.append(np.searchsorted(found_names, found.ids[here][kept]))
        pairs.append(similarity[np.ix_(counted, kept)].ravel())
    return TrackSequence.of(
        np.array(sizes, np.int64).reshape(-1, 2),
        rows.array(),
        columns.array(),
        pairs.array(),
        len(true_names),
        len(found_names),
    )


def _by_step(
    truth: LabeledBoxes, found: LabeledBoxes, regions: LabeledBoxes | None
) -> list[tuple[Labels, Labels, Labels]]:
    """Return the rows of true boxes, answers and regions of every step at which there is a box or an answer."""
    steps = np.unique(np.concatenate([truth.steps, found.steps]))
    parts = []
    for boxes in (truth, found, regions):
        if boxes is None:
            parts.append([np.zeros(0, np.int64)] * len(steps))
            continue
        # A stable sort keeps the order of the file within a frame.
        order = np.argsort(boxes.steps, kind="stable")
        sorted_steps = boxes.steps[order]
        begin, end = np.searchsorted(sorted_steps, steps), np.searchsorted(sorted_steps, steps, side="right")
        parts.append([order[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True)])
    return list(zip(*parts, strict=True))


def _kept_answers(
    truth: LabeledBoxes,
    there: Labels,
    answers: Array,
    similarity: Array,
    benchmark: Benchmark,
    zones: Array | None,
) -> Mask:
    """Return the answers that are scored, shape (k,)."""
    kept = np.ones(len(answers), np.bool_)
    if benchmark.scored is None:
        return kept
    unmatched = kept.copy()
    if similarity.size:
        eligible = np.where(similarity < benchmark.match - EPSILON, 0.0, similarity)
        rows, columns = linear_sum_assignment(eligible, maximize=True)
        matched = eligible[rows, columns] > EPSILON
        rows, columns = there[rows[matched]], columns[matched]
        unmatched[columns] = False
        excused = np.isin(truth.classes[rows], list(benchmark.distractors))
        if benchmark.uncounted_match:
            excused |= ~truth.counted[rows]
        kept[columns[excused]] = False
    if benchmark.least_height is not None:
        corners = _corners(answers)
        kept &= ~(unmatched & (corners[:, 3] - corners[:, 1] <= benchmark.least_height + EPSILON))
    if benchmark.ignores_regions and zones is not None and len(zones):
        kept &= ~(unmatched & _inside(answers, zones, benchmark.region_share))
    return kept


def _inside(answers: Array, zones: Array, least: float) -> Mask:
    """Return the answers of which more than a share lies in one of the regions, shape (k,)."""
    corners = _corners(answers)
    overlap, areas = _overlap(corners, _corners(zones)), _areas(corners)[:, None]
    share = np.divide(overlap, areas, out=np.zeros_like(overlap), where=areas > EPSILON)
    return np.asarray((share > least + EPSILON).any(axis=1), np.bool_)


def _corners(boxes: Array) -> Array:
    return np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)


def _areas(corners: Array) -> Array:
    return (corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1])


def _overlap(a: Array, b: Array) -> Array:
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    sides = np.maximum(high - low, 0.0)
    return sides[..., 0] * sides[..., 1]
