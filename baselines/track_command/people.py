"""Tracks of one frame, as arrays and for other packages, and the files that they can be written to."""

from __future__ import annotations

import csv
import importlib
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.baselines.reporting.files import atomic_path
from servotrack.envs.track.files.mot_files import mot_row
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Image, Labels

COLUMNS = ("frame", "time", "id", "left", "top", "width", "height", "existence")
"""Columns of tables of tracks. Frames count from 0; times in s; boxes in px of the source."""


@dataclass(frozen=True)
class Tracks:
    """People in one frame.

    Attributes:
        frame: Number of the frame, from 0.
        time: Time since frame 0, s.
        ids: Identities, from 1 in the order of their first report, shape (k,), int.
        boxes: Left, top, width, height, shape (k, 4), px of the source.
        existence: Probability that each is a person, shape (k,).
        image: The frame, RGB, uint8, shape (H, W, 3); None if there is none.
        estimate: Everything that the tracker says, with the people that it holds without reporting them, for
            `people_count`, `ZoneCount` and `LineCount`; None for tracks that were read from a file.
    """

    frame: int
    time: float
    ids: Labels
    boxes: Array
    existence: Array
    image: Image | None = field(default=None, repr=False)
    estimate: SetEstimate | None = field(default=None, repr=False)

    def __len__(self) -> int:
        """Return the number of people."""
        return len(self.ids)

    @property
    def corners(self) -> Array:
        """Left, top, right, bottom, shape (k, 4), px."""
        return np.concatenate([self.boxes[:, :2], self.boxes[:, :2] + self.boxes[:, 2:]], axis=1)

    def to_numpy(self) -> Array:
        """Return the columns `COLUMNS`, shape (k, 8)."""
        count = len(self)
        parts = [np.full(count, self.frame), np.full(count, self.time), self.ids, self.boxes, self.existence]
        return np.column_stack([np.asarray(part, np.float64).reshape(count, -1) for part in parts])

    def to_supervision(self) -> Any:
        """Return `supervision.Detections` with `tracker_id`.

        Raises:
            ImportError: The package supervision is not installed.
        """
        return _package("supervision").Detections(
            xyxy=self.corners.astype(np.float32),
            confidence=self.existence.astype(np.float32),
            class_id=np.zeros(len(self), np.int64),
            tracker_id=self.ids.copy(),
        )

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with the columns `COLUMNS`.

        Raises:
            ImportError: The package pandas is not installed.
        """
        table = _package("pandas").DataFrame(self.to_numpy(), columns=list(COLUMNS))
        return table.astype({"frame": "int64", "id": "int64"})

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield one dictionary with the keys `COLUMNS` for each person."""
        for identity, box, existence in zip(
            self.ids.tolist(), self.boxes.tolist(), self.existence.tolist(), strict=True
        ):
            values = (self.frame, round(self.time, 6), identity, *(round(side, 3) for side in box), round(existence, 4))
            yield dict(zip(COLUMNS, values, strict=True))


def write_tracks(tracks: Iterable[Tracks], path: str | Path, size: tuple[int, int] | None = None) -> int:
    """Write tracks to a file, whole or not at all.

    Args:
        tracks: Tracks frame by frame, for example those of `servotrack.track`.
        path: File; the suffix chooses the format: .csv, .jsonl (one person a line), .txt (MOTChallenge, frames from
            1) or .json (COCO with `track_id`).
        size: Width and height of the frames for COCO, px; None if unknown.

    Returns:
        Number of boxes.

    Raises:
        ValueError: Another suffix.
        ResultsError: The file cannot be written.
    """
    path = Path(path)
    write = WRITERS.get(path.suffix.lower())
    if write is None:
        raise ValueError(f"path must end in {', '.join(WRITERS)}, got {str(path)!r}")
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        return write(tracks, file, size)


def _write_csv(tracks: Iterable[Tracks], file: io.TextIOBase, size: tuple[int, int] | None) -> int:
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    rows = [row for one in tracks for row in one.rows()]
    writer.writerows(rows)
    return len(rows)


def _write_json_lines(tracks: Iterable[Tracks], file: io.TextIOBase, size: tuple[int, int] | None) -> int:
    return sum(1 for one in tracks for row in one.rows() if file.write(json.dumps(row) + "\n"))


def _write_mot(tracks: Iterable[Tracks], file: io.TextIOBase, size: tuple[int, int] | None) -> int:
    return sum(
        1
        for one in tracks
        for identity, box, existence in zip(one.ids.tolist(), one.boxes, one.existence.tolist(), strict=True)
        if file.write(mot_row(one.frame + 1, identity, box, existence))
    )


def _write_coco(tracks: Iterable[Tracks], file: io.TextIOBase, size: tuple[int, int] | None) -> int:
    images: list[dict[str, Any]] = []
    people: list[dict[str, Any]] = []
    for one in tracks:
        image: dict[str, Any] = {"id": one.frame, "frame_id": one.frame, "file_name": f"{one.frame + 1:06}.jpg"}
        images.append(image if size is None else image | {"width": size[0], "height": size[1]})
        for row in one.rows():
            box = [row[name] for name in ("left", "top", "width", "height")]
            people.append(
                {
                    "id": len(people) + 1, "image_id": one.frame, "category_id": 1, "track_id": row["id"], "bbox": box,
                    "area": round(box[2] * box[3], 3), "iscrowd": 0, "score": row["existence"],
                }
            )  # fmt: skip
    document = {"images": images, "annotations": people, "categories": [{"id": 1, "name": "person"}]}
    file.write(json.dumps(document) + "\n")
    return len(people)


WRITERS: Mapping[str, Callable[[Iterable[Tracks], Any, tuple[int, int] | None], int]] = {
    ".csv": _write_csv,
    ".jsonl": _write_json_lines,
    ".txt": _write_mot,
    ".json": _write_coco,
}
"""Writer of each format by the suffix of the file."""


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} is not installed: pip install {name}") from error
