"""Readers and writers of MOTChallenge files: tracks, detections, seqinfo.ini, and the folder of a sequence."""

from __future__ import annotations

import configparser
import io
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.envs.track.files.bounded import parse_number, read_bounded
from servotrack.envs.track.files.recorded import FRAME_RATES, MAX_ROWS, RecordedTracks, SequenceError, TrackRows
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.types import Array, Labels

MAX_TEXT = 1 << 30
"""Largest accepted size of a file of rows, bytes."""
_MAX_LINE = 4096
_MAX_INI = 65536
_INI_REMEDY = "it cannot be a seqinfo.ini; check the path"
_TEXT_REMEDY = "split the file"
_MAX_SIDE = 1e6
_MAX_LENGTH = 1e12
_TRACK_COLUMNS = 6
_FLAG, _CLASS, _VISIBILITY = 6, 7, 8
_DISTRACTORS = (2.0, 7.0, 8.0, 12.0)
_OTHER_CLASSES = (3.0, 4.0, 5.0, 6.0, 9.0, 10.0, 11.0, 13.0)
_WITH_VISIBILITY = 9
"""Number of columns of rows with visibility (MOT16 and later). Rows of ten columns end in three coordinates."""


class SequenceInfo(NamedTuple):
    """Content of seqinfo.ini; None for missing entries.

    Attributes:
        name: Name of the sequence.
        images: Folder of the images, relative to that of the sequence.
        frame_rate: Frames per second.
        length: Claimed number of frames.
        width, height: Size of the images, px.
    """

    name: str
    images: str = "img1"
    frame_rate: float | None = None
    length: int | None = None
    width: int | None = None
    height: int | None = None


class MotFolder(NamedTuple):
    """Parts of a MOTChallenge sequence; None for missing parts.

    Attributes:
        info: Content of seqinfo.ini; without that file, the name of the folder and defaults.
        images: Folder of images.
        detections: Path of det/det.txt.
        truth: Path of gt/gt.txt.
    """

    info: SequenceInfo
    images: Path | None
    detections: Path | None
    truth: Path | None


def find_mot_folder(path: str | Path) -> MotFolder | None:
    """Return the parts of a MOTChallenge sequence; None if the path is not the folder of one.

    A folder is a MOTChallenge sequence if it contains seqinfo.ini, det/det.txt, gt/gt.txt or the image folder.

    Raises:
        SequenceError: If seqinfo.ini is invalid, or the folder cannot be looked up.
    """
    folder = Path(path)
    seqinfo = folder / "seqinfo.ini"
    try:
        described = seqinfo.is_file()
        info = read_seqinfo(seqinfo) if described else SequenceInfo(folder.resolve().name)
        images = folder / info.images if (folder / info.images).is_dir() else None
        detections, truth = (
            file if file.is_file() else None for file in (folder / "det" / "det.txt", folder / "gt" / "gt.txt")
        )
    except OSError as error:
        raise SequenceError(f"{folder} cannot be read ({error.strerror}); check its permissions") from error
    if not (described or detections or truth or images):
        return None
    return MotFolder(info, images, detections, truth)


def read_mot_tracks(path: str | Path) -> RecordedTracks:
    """Read the tracks of a gt.txt or of the results of a tracker. Rows with flag (or confidence) 0 are ignored.

    In rows of nine columns the eighth is the class: 1 is a pedestrian. People on vehicles, static people, distractors
    and reflections (2, 7, 8, 12) get the visible share 0, and other classes are ignored.

    Args:
        path: File with rows of frame (from 1), id, left, top, width, height, and optionally flag, class and visibility.
            At most 1 GiB, 10 million lines, and 5000 boxes in a frame.

    Returns:
        Tracks of all identities.

    Raises:
        SequenceError: If the file is missing, too large or not text, a row is invalid, or an id is twice in a frame.
    """
    file = Path(path)
    rows = TrackRows(file)
    for line, values in mot_rows(rows):
        frame, identity, left, top, width, height = values[:_TRACK_COLUMNS]
        step, name = _whole(rows, line, "frame", frame) - 1, _whole(rows, line, "id", identity)
        flag = values[_FLAG] if len(values) > _FLAG else 1.0
        if not math.isfinite(flag):
            raise rows.fail(line, f"flag or confidence must be finite, got {flag:g}")
        if flag == 0.0:
            continue
        visible = values[_VISIBILITY] if len(values) == _WITH_VISIBILITY else 1.0
        kind = values[_CLASS] if len(values) == _WITH_VISIBILITY else 1.0
        if kind in _OTHER_CLASSES:
            continue
        if kind in _DISTRACTORS:
            visible = 0.0
        rows.add(line, step, name, (left, top, width, height), 1.0 if visible == -1.0 else visible)
    return rows.finish()


def read_mot_detections(path: str | Path) -> MotDetections:
    """Read the detections of a det.txt.

    Args:
        path: File with rows of frame (from 1), -1, left, top, width, height, confidence (default 1). At most 1 GiB,
            10 million lines, and 5000 boxes in a frame.

    Returns:
        Detections by step (frame from 0), in increasing order; frames without detections are missing.

    Raises:
        SequenceError: If the file is missing, too large or not text, or a row is invalid.
    """
    rows = TrackRows(Path(path))
    for line, values in mot_rows(rows):
        step = _whole(rows, line, "frame", values[0]) - 1
        # The identity column, -1, has no meaning.
        confidence = values[_FLAG] if len(values) > _FLAG else 1.0
        rows.add_detection(line, step, (values[2], values[3], values[4], values[5]), confidence)
    return MotDetections(*rows.by_frame())


class MotDetections(Mapping[int, Detections]):
    """Detections by step. They are made on access: one object per frame would need fifty times the memory.

    Args:
        frames: Frames with detections, from 0, increasing, shape (f,).
        bounds: Index of the first row of each frame, then the number of rows, shape (f + 1,).
        rows: Left, top, width, height, px, and confidence, shape (n, 5).
    """

    def __init__(self, frames: Labels, bounds: Labels, rows: Array) -> None:
        self._frames, self._bounds, self._rows = frames, bounds, rows

    @property
    def boxes(self) -> Array:
        """All boxes, shape (n, 4)."""
        return self._rows[:, :4]

    def scaled(self, width: float, height: float) -> MotDetections:
        """Return the detections with horizontal numbers times `width` and vertical ones times `height`."""
        return MotDetections(self._frames, self._bounds, self._rows * [width, height, width, height, 1.0])

    def __getitem__(self, frame: int) -> Detections:
        at = int(np.searchsorted(self._frames, frame))
        if at == len(self._frames) or self._frames[at] != frame:
            raise KeyError(frame)
        rows = self._rows[self._bounds[at] : self._bounds[at + 1]]
        return detections_from_boxes(rows[:, :4], rows[:, 4])

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames.tolist())

    def __len__(self) -> int:
        return len(self._frames)


def read_seqinfo(path: str | Path) -> SequenceInfo:
    """Read seqinfo.ini.

    Raises:
        SequenceError: If the file is missing, has another format, or names an image folder outside the sequence.
    """
    file = Path(path)
    content = read_bounded(file, _MAX_INI, _INI_REMEDY)
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(content.decode("utf-8-sig"), source=str(file))
        section = parser["Sequence"]
    except (configparser.Error, UnicodeDecodeError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise SequenceError(f"{file} must have a section [Sequence] with lines key=value ({reason})") from error
    images = section.get("imDir", "img1").strip()
    if not images or "\0" in images or Path(images).is_absolute() or ".." in Path(images).parts:
        raise SequenceError(f"{file}: imDir must be a folder inside that of the sequence, got {images!r}")
    return SequenceInfo(
        section.get("name", file.parent.name).strip(),
        images,
        _number(file, section, "frameRate", *FRAME_RATES),
        _whole_number(file, section, "seqLength", _MAX_LENGTH),
        _whole_number(file, section, "imWidth", _MAX_SIDE),
        _whole_number(file, section, "imHeight", _MAX_SIDE),
    )


def mot_row(frame: int, identity: int, box: ArrayLike, confidence: float = 1.0) -> str:
    """Return one line of the results of a tracker, with its line break.

    Args:
        frame: Frame number, from 1.
        identity: Identity, at least 1.
        box: Left, top, width, height, px; written with two decimals.
        confidence: Confidence, written in column 7; the 3-D coordinates after it are -1.
    """
    left, top, width, height = np.asarray(box, dtype=np.float64).tolist()
    return f"{frame},{identity},{left:.2f},{top:.2f},{width:.2f},{height:.2f},{confidence:.3g},-1,-1,-1\n"


def truth_row(frame: int, identity: int, box: ArrayLike, counts: bool, visibility: float) -> str:
    """Return one line of a gt.txt in nine columns, with its line break. The class is 1, pedestrian.

    Args:
        frame: Frame number, from 1.
        identity: Identity, at least 1.
        box: Left, top, width, height, px; written with two decimals.
        counts: True if the box is scored, False if it is ignored.
        visibility: Visible share, 0 to 1.
    """
    left, top, width, height = np.asarray(box, dtype=np.float64).tolist()
    return f"{frame},{identity},{left:.2f},{top:.2f},{width:.2f},{height:.2f},{int(counts)},1,{visibility:.3f}\n"


def write_seqinfo(path: str | Path, info: SequenceInfo) -> None:
    """Write a seqinfo.ini that `read_seqinfo` reads.

    Args:
        path: File to write.
        info: Content; no entry may be None.
    """
    parser = configparser.ConfigParser()
    # Keys keep their capitals, which other readers of these files expect.
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser["Sequence"] = {
        "name": info.name,
        "imDir": info.images,
        "frameRate": f"{info.frame_rate:g}",
        "seqLength": str(info.length),
        "imWidth": str(info.width),
        "imHeight": str(info.height),
        "imExt": ".jpg",
    }
    with Path(path).open("w", encoding="utf-8") as file:
        parser.write(file, space_around_delimiters=False)


def mot_rows(rows: TrackRows) -> Iterator[tuple[int, list[float]]]:
    """Yield line number and values of every row of a file that is not blank. The length of lines is limited."""
    stream = io.BytesIO(read_bounded(rows.path, MAX_TEXT, _TEXT_REMEDY))
    line = 0
    while content := stream.readline(_MAX_LINE + 1):
        line += 1
        if line > MAX_ROWS:
            raise rows.fail(line, f"a file must hold at most {MAX_ROWS} lines; {_TEXT_REMEDY}")
        if len(content) > _MAX_LINE:
            raise rows.fail(
                line, f"lines must be shorter than {_MAX_LINE} bytes; the file is not in MOTChallenge format"
            )
        if line == 1:
            content = content.removeprefix(b"\xef\xbb\xbf")
        if content.strip():
            yield line, _numbers_of(rows, line, content)


def _numbers_of(rows: TrackRows, line: int, content: bytes) -> list[float]:
    row = content.strip()
    parts = row.rstrip(b",").split(b",") if b"," in row else row.split()
    try:
        # Two rows in one line, of a file without line feeds, would lose the second; Python's parser takes 1_0 for 10.
        if b"\r" in row or b"_" in row:
            raise ValueError
        values = [float(part) for part in parts]
    except ValueError:
        shown = content.strip()[:60].decode("ascii", "backslashreplace")
        raise rows.fail(line, f"rows must contain numbers separated by commas, got {shown!r}") from None
    if len(values) < _TRACK_COLUMNS:
        raise rows.fail(
            line, f"rows must contain at least frame, id, left, top, width, height, got {len(values)} number(s)"
        )
    return values


def _whole(rows: TrackRows, line: int, name: str, value: float) -> int:
    if not value.is_integer():  # False for NaN and infinity, too
        raise rows.fail(line, f"{name} must be a whole number, got {value:g}")
    return int(value)


def _number(path: Path, section: configparser.SectionProxy, key: str, lowest: float, highest: float) -> float | None:
    text = section.get(key)
    if text is None:
        return None
    try:
        value = parse_number(text)
    except ValueError:
        value = math.nan
    if not lowest <= value <= highest:
        raise SequenceError(
            f"{path}: {key} must be a positive number from {lowest:g} to {highest:g}, got {text[:40]!r}; "
            "correct the line or delete it"
        )
    return value


def _whole_number(path: Path, section: configparser.SectionProxy, key: str, highest: float) -> int | None:
    value = _number(path, section, key, 1.0, highest)
    if value is not None and not value.is_integer():
        raise SequenceError(f"{path}: {key} must be a whole number, got {value:g}; correct the line or delete it")
    return None if value is None else int(value)
