"""Readers and writers of MOTChallenge files: tracks, detections, seqinfo.ini, and the folder of a sequence."""

from __future__ import annotations

import configparser
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.envs.track.files.recorded import RecordedTracks, SequenceError, TrackRows, check_file
from servotrack.estimators.detect.detections import Detections, detections_from_boxes

_MAX_LINE = 4096
_MAX_INI = 65536
_TRACK_COLUMNS = 6
_FLAG, _VISIBILITY = 6, 8
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
    """Return the parts of a MOTChallenge sequence; None if the folder is not one.

    A folder is a MOTChallenge sequence if it contains seqinfo.ini, det/det.txt, gt/gt.txt or the image folder.

    Raises:
        SequenceError: If seqinfo.ini is invalid.
    """
    folder = Path(path)
    seqinfo, detections, truth = folder / "seqinfo.ini", folder / "det" / "det.txt", folder / "gt" / "gt.txt"
    info = read_seqinfo(seqinfo) if seqinfo.is_file() else SequenceInfo(folder.resolve().name)
    images = folder / info.images
    if not (seqinfo.is_file() or detections.is_file() or truth.is_file() or images.is_dir()):
        return None
    return MotFolder(
        info,
        images if images.is_dir() else None,
        detections if detections.is_file() else None,
        truth if truth.is_file() else None,
    )


def read_mot_tracks(path: str | Path) -> RecordedTracks:
    """Read the tracks of a gt.txt or of the results of a tracker. Rows with flag (or confidence) 0 are ignored.

    Args:
        path: File with rows of frame (from 1), id, left, top, width, height, and optionally flag, class and visibility.

    Returns:
        Tracks of all identities.

    Raises:
        SequenceError: If the file is missing or not text, a row is invalid, or an id is twice in a frame.
    """
    file = Path(path)
    rows = TrackRows(file)
    for line, values in _rows(rows):
        frame, identity, left, top, width, height = values[:_TRACK_COLUMNS]
        step, name = _whole(rows, line, "frame", frame) - 1, _whole(rows, line, "id", identity)
        flag = values[_FLAG] if len(values) > _FLAG else 1.0
        if not math.isfinite(flag):
            raise rows.fail(line, f"flag or confidence must be finite, got {flag:g}")
        if flag == 0.0:
            continue
        visible = values[_VISIBILITY] if len(values) == _WITH_VISIBILITY else 1.0
        rows.add(line, step, name, (left, top, width, height), 1.0 if visible == -1.0 else visible)
    return rows.finish()


def read_mot_detections(path: str | Path) -> dict[int, Detections]:
    """Read the detections of a det.txt.

    Args:
        path: File with rows of frame (from 1), -1, left, top, width, height, confidence (default 1).

    Returns:
        Detections by step (frame from 0); frames without detections are missing.

    Raises:
        SequenceError: If the file is missing or not text, or a row is invalid.
    """
    file = Path(path)
    rows = TrackRows(file)
    found: dict[int, list[tuple[float, ...]]] = {}
    for line, values in _rows(rows):
        step = _whole(rows, line, "frame", values[0]) - 1
        confidence = values[_FLAG] if len(values) > _FLAG else 1.0
        if not math.isfinite(confidence):
            raise rows.fail(line, f"confidence must be finite, got {confidence:g}")
        # The row passes the same checks as that of a track; the identity column, -1, has no meaning.
        rows.add(line, step, 0, (values[2], values[3], values[4], values[5]), 1.0)
        found.setdefault(step, []).append((*values[2:6], confidence))
    arrays = {step: np.array(boxes) for step, boxes in found.items()}
    return {step: detections_from_boxes(boxes[:, :4], boxes[:, 4]) for step, boxes in sorted(arrays.items())}


def read_seqinfo(path: str | Path) -> SequenceInfo:
    """Read seqinfo.ini.

    Raises:
        SequenceError: If the file is missing, has another format, or names an image folder outside the sequence.
    """
    file = check_file(Path(path))
    parser = configparser.ConfigParser(interpolation=None)
    try:
        with file.open("rb") as handle:
            content = handle.read(_MAX_INI + 1)
        if len(content) > _MAX_INI:
            raise SequenceError(f"{file} is larger than {_MAX_INI} bytes and cannot be a seqinfo.ini; check the path")
        parser.read_string(content.decode("utf-8-sig"), source=str(file))
        section = parser["Sequence"]
    except (configparser.Error, UnicodeDecodeError, KeyError, OSError) as error:
        reason = " ".join(str(error).split())
        raise SequenceError(f"{file} must have a section [Sequence] with lines key=value ({reason})") from error
    images = section.get("imDir", "img1").strip()
    if not images or "\0" in images or Path(images).is_absolute() or ".." in Path(images).parts:
        raise SequenceError(f"{file}: imDir must be a folder inside that of the sequence, got {images!r}")
    length, width, height = (_number(file, section, key) for key in ("seqLength", "imWidth", "imHeight"))
    return SequenceInfo(
        section.get("name", file.parent.name).strip(),
        images,
        _number(file, section, "frameRate"),
        None if length is None else int(length),
        None if width is None else int(width),
        None if height is None else int(height),
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


def _rows(rows: TrackRows) -> Iterator[tuple[int, list[float]]]:
    """Yield line number and values of every row that is not blank. The length of lines is limited, to limit memory."""
    path = check_file(rows.path)
    try:
        with path.open("rb") as handle:
            line = 0
            while content := handle.readline(_MAX_LINE + 1):
                line += 1
                if len(content) > _MAX_LINE:
                    raise rows.fail(
                        line, f"lines must be shorter than {_MAX_LINE} bytes; the file is not in MOTChallenge format"
                    )
                if line == 1:
                    content = content.removeprefix(b"\xef\xbb\xbf")
                if content.strip():
                    yield line, _numbers_of(rows, line, content)
    except OSError as error:
        raise SequenceError(f"{path} cannot be read ({error.strerror}); check its permissions") from error


def _numbers_of(rows: TrackRows, line: int, content: bytes) -> list[float]:
    parts = content.strip().rstrip(b",").split(b",") if b"," in content else content.split()
    try:
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


def _number(path: Path, section: configparser.SectionProxy, key: str) -> float | None:
    text = section.get(key)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and 0.0 < value <= 1e12):
        raise SequenceError(f"{path}: {key} must be a positive number, got {text!r}; correct the line or delete it")
    return value
