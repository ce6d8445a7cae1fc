"""Reader of ground truth with the classes, flags and ignored regions of benchmarks: MOTChallenge, DanceTrack, KITTI."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.files.bounded import is_folder, parse_number, read_bounded
from servotrack.envs.track.files.caviar import read_caviar
from servotrack.envs.track.files.mot_files import MAX_TEXT, find_mot_folder, mot_rows
from servotrack.envs.track.files.recorded import RecordedTracks, SequenceError, TrackRows
from servotrack.estimators.metrics.benchmarks import KITTI_CLASSES, LabeledBoxes, plain_boxes
from servotrack.estimators.types import Array, Labels

_FLAG, _CLASS = 6, 7
_MOT_CLASSES = range(1, 14)
_KITTI_COLUMNS = (10, 18)
"""Smallest and largest number of columns of KITTI's labels that are read: up to the box, and with a score."""
_MAX_OCCLUSION, _MAX_TRUNCATION = 2, 0
_MAX_KITTI_LINE = 4096
_DONT_CARE = KITTI_CLASSES["dontcare"]


class LabeledTruth(NamedTuple):
    """Ground truth of a sequence.

    Attributes:
        boxes: Boxes of all classes, flagged ones included.
        regions: Regions in which answers are ignored; their ids mean nothing.
        benchmark: Name in `BENCHMARKS` of the rules that fit the file.
    """

    boxes: LabeledBoxes
    regions: LabeledBoxes
    benchmark: str


def read_labeled(path: str | Path) -> LabeledTruth:
    """Read the ground truth of a sequence with everything that decides how it is scored.

    The file's own form tells the benchmark: CAVIAR's XML and gt.txt without classes are scored as MOT15, gt.txt with
    classes from 1 to 13 as MOT17, or as MOT20 if the sequence's name begins so, and KITTI's labels by the pedestrians.

    Args:
        path: File, or folder of a MOTChallenge sequence, whose gt/gt.txt is read.

    Raises:
        SequenceError: If the file is missing, has another format or contains an invalid row.
    """
    file = Path(path)
    if is_folder(file):
        file = file / "gt" / "gt.txt"
    if file.suffix.lower() == ".xml":
        return LabeledTruth(boxes_of(read_caviar(file)), _no_boxes(), "mot15")
    if _is_kitti(file):
        return _read_kitti(file)
    boxes, classified = _read_mot(file)
    if not classified:
        return LabeledTruth(boxes._replace(classes=np.ones_like(boxes.classes)), _no_boxes(), "mot15")
    sequence = find_mot_folder(file.parent.parent)
    name = file.parent.parent.name if sequence is None else sequence.info.name
    return LabeledTruth(boxes, _no_boxes(), "mot20" if name.upper().startswith("MOT20") else "mot17")


def boxes_of(tracks: RecordedTracks) -> LabeledBoxes:
    """Return the boxes of recorded tracks; all are of class 1 and count."""
    if not len(tracks.ids):
        return _no_boxes()
    steps = np.concatenate([track.steps for track in tracks.tracks])
    ids = np.repeat(tracks.ids, [len(track.steps) for track in tracks.tracks])
    return plain_boxes(steps, ids, np.concatenate([track.states for track in tracks.tracks]))


def _no_boxes() -> LabeledBoxes:
    none = np.zeros(0, np.int64)
    return plain_boxes(none, none, np.zeros((0, 4)))


def _read_mot(file: Path) -> tuple[LabeledBoxes, bool]:
    """Return the boxes of a gt.txt, and True if it has classes. Without them column 8 is a coordinate, -1."""
    rows = TrackRows(file)
    kinds, flags = [], []
    for line, values in mot_rows(rows):
        frame, identity = values[0], values[1]
        if not (frame.is_integer() and identity.is_integer()):
            raise rows.fail(line, f"frame and id must be whole numbers, got {frame:g} and {identity:g}")
        kinds.append(values[_CLASS] if len(values) > _CLASS else -1.0)
        flag = values[_FLAG] if len(values) > _FLAG else 1.0
        if not np.isfinite(flag):
            raise rows.fail(line, f"flag or confidence must be finite, got {flag:g}")
        flags.append(int(flag) != 0)
        rows.add(line, int(frame) - 1, int(identity), (values[2], values[3], values[4], values[5]), 1.0)
    steps, ids, boxes = _listed(rows)
    classes = np.array(kinds, dtype=np.float64)
    classified = bool(len(classes) and np.isin(classes, _MOT_CLASSES).all())
    kept = classes.astype(np.int64) if classified else np.ones(len(steps), np.int64)
    return LabeledBoxes(steps, ids, boxes, kept, np.array(flags, dtype=np.bool_)), classified


def _listed(rows: TrackRows) -> tuple[Labels, Labels, Array]:
    # Raises if an id is twice in a frame.
    rows.finish()
    return rows.listed()


def _is_kitti(file: Path) -> bool:
    """Return True if the third word of the first line is a class of KITTI."""
    content = read_bounded(file, MAX_TEXT, "split the file")
    words = content[:_MAX_KITTI_LINE].split(b"\n", 1)[0].split()
    return len(words) > 2 and words[2].decode("ascii", "replace").lower() in KITTI_CLASSES


def _read_kitti(file: Path) -> LabeledTruth:
    """Read KITTI's label_02: frame, id, class, truncated, occluded, alpha, left, top, right, bottom, ..."""
    rows, zones = TrackRows(file), TrackRows(file)
    kinds, counted = [], []
    for line, text in enumerate(read_bounded(file, MAX_TEXT, "split the file").split(b"\n"), start=1):
        if not text.strip():
            continue
        step, identity, kind, truncated, occluded, box = _kitti_row(rows, line, text)
        if kind == _DONT_CARE:
            zones.add_detection(line, step, box, 1.0)
        elif identity >= 0:
            rows.add(line, step, identity, box, 1.0)
            kinds.append(kind)
            counted.append(occluded <= _MAX_OCCLUSION and truncated <= _MAX_TRUNCATION)
    steps, ids, boxes = _listed(rows)
    labeled = LabeledBoxes(steps, ids, boxes, np.array(kinds, np.int64), np.array(counted, np.bool_))
    return LabeledTruth(labeled, plain_boxes(*zones.listed(), kind=_DONT_CARE), "kitti-pedestrian")


def _kitti_row(
    rows: TrackRows, line: int, text: bytes
) -> tuple[int, int, int, int, int, tuple[float, float, float, float]]:
    words = text[:_MAX_KITTI_LINE].decode("ascii", "backslashreplace").split()
    if not _KITTI_COLUMNS[0] <= len(words) <= _KITTI_COLUMNS[1] or len(text) > _MAX_KITTI_LINE:
        raise rows.fail(line, f"labels of KITTI must have 10 to 18 columns, got {len(words)}")
    kind = KITTI_CLASSES.get(words[2].lower())
    if kind is None:
        raise rows.fail(line, f"class must be one of {', '.join(KITTI_CLASSES)}, got {words[2][:40]!r}")
    try:
        frame, identity, truncated, occluded = (parse_number(words[k]) for k in (0, 1, 3, 4))
        left, top, right, bottom = (parse_number(word) for word in words[6:10])
        step, name = int(frame), int(identity)
        levels = int(truncated), int(occluded)
    except (ValueError, OverflowError):
        raise rows.fail(line, f"columns must be numbers, got {' '.join(words)[:60]!r}") from None
    if (step, name) != (frame, identity):
        raise rows.fail(line, f"frame and id must be whole numbers, got {frame:g} and {identity:g}")
    return step, name, kind, *levels, (left, top, right - left, bottom - top)


def truth_tracks(truth: LabeledTruth, scored: int | None) -> RecordedTracks:
    """Return the tracks of the boxes that count.

    Args:
        truth: The truth.
        scored: Class that counts; None for all.

    Raises:
        SequenceError: As `TrackRows.add`.
    """
    boxes = truth.boxes
    wanted = boxes.counted & (True if scored is None else boxes.classes == scored)
    rows = TrackRows(Path("truth"))
    for k in np.flatnonzero(wanted).tolist():
        left, top, width, height = boxes.boxes[k].tolist()
        rows.add(k, int(boxes.steps[k]), int(boxes.ids[k]), (left, top, width, height), 1.0)
    return rows.finish()


__all__ = ["LabeledTruth", "SequenceError", "boxes_of", "read_labeled", "truth_tracks"]
