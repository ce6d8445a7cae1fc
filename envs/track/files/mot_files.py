"""MOTChallenge's files: rows of tracks and detections, seqinfo.ini, and the folder of a sequence."""

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
"""Rows of exactly nine columns (MOT16 and later) end in class and visibility; those of ten in three coordinates."""


class SequenceInfo(NamedTuple):
    """What seqinfo.ini tells; None where it does not.

    Attributes:
        name: Of the sequence.
        images: Folder of the images, inside that of the sequence.
        frame_rate: Frames per second.
        length: Claimed number of frames.
        width, height: Of the images, px.
    """

    name: str
    images: str = "img1"
    frame_rate: float | None = None
    length: int | None = None
    width: int | None = None
    height: int | None = None


class MotFolder(NamedTuple):
    """The parts of a MOTChallenge sequence; None for those that are not there.

    Attributes:
        info: As seqinfo.ini tells; without that file, the folder's name and defaults.
        images: Folder of images.
        detections: det/det.txt.
        truth: gt/gt.txt.
    """

    info: SequenceInfo
    images: Path | None
    detections: Path | None
    truth: Path | None


def find_mot_folder(path: str | Path) -> MotFolder | None:
    """The parts of a folder that is a MOTChallenge sequence; None where it is none.

    A folder is one if it holds seqinfo.ini, det/det.txt, gt/gt.txt or img1.

    Raises:
        SequenceError: A bad seqinfo.ini.
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
    """Tracks out of gt.txt, or of a tracker's results; rows with flag (or confidence) 0 do not count and are dropped.

    Args:
        path: Rows of frame (from 1), id, left, top, width, height, then perhaps flag, class and visibility.

    Raises:
        SequenceError: Missing, not text, a bad row, or an id twice in a frame.
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
    """Detections out of det.txt.

    Args:
        path: Rows of frame (from 1), -1, left, top, width, height, confidence; without a confidence it is 1.

    Returns:
        By step (frame from 0), only where there are any.

    Raises:
        SequenceError: Missing, not text, or a bad row.
    """
    file = Path(path)
    rows = TrackRows(file)
    found: dict[int, list[tuple[float, ...]]] = {}
    for line, values in _rows(rows):
        step = _whole(rows, line, "frame", values[0]) - 1
        confidence = values[_FLAG] if len(values) > _FLAG else 1.0
        if not math.isfinite(confidence):
            raise rows.fail(line, f"confidence must be finite, got {confidence:g}")
        # The row goes through the same checks as a track's; its identity, -1, means nothing.
        rows.add(line, step, 0, (values[2], values[3], values[4], values[5]), 1.0)
        found.setdefault(step, []).append((*values[2:6], confidence))
    arrays = {step: np.array(boxes) for step, boxes in found.items()}
    return {step: detections_from_boxes(boxes[:, :4], boxes[:, 4]) for step, boxes in sorted(arrays.items())}


def read_seqinfo(path: str | Path) -> SequenceInfo:
    """What seqinfo.ini tells.

    Raises:
        SequenceError: Missing, not of the format, or an image folder outside the sequence's own.
    """
    file = check_file(Path(path))
    parser = configparser.ConfigParser(interpolation=None)
    try:
        with file.open("rb") as handle:
            content = handle.read(_MAX_INI + 1)
        if len(content) > _MAX_INI:
            raise SequenceError(f"{file} is larger than {_MAX_INI} bytes: no seqinfo.ini; check the path")
        parser.read_string(content.decode("utf-8-sig"), source=str(file))
        section = parser["Sequence"]
    except (configparser.Error, UnicodeDecodeError, KeyError, OSError) as error:
        reason = " ".join(str(error).split())
        raise SequenceError(f"{file} must have a section [Sequence] with lines key=value ({reason})") from error
    images = section.get("imDir", "img1").strip()
    if not images or "\0" in images or Path(images).is_absolute() or ".." in Path(images).parts:
        raise SequenceError(f"{file}: imDir must be a folder inside the sequence's own, got {images!r}")
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
    """One line of a tracker's results, with its line break.

    Args:
        frame: From 1.
        identity: At least 1.
        box: Left, top, width, height, px; written to a hundredth.
        confidence: Written in column 7; the coordinates in space after it are -1.
    """
    left, top, width, height = np.asarray(box, dtype=np.float64).tolist()
    return f"{frame},{identity},{left:.2f},{top:.2f},{width:.2f},{height:.2f},{confidence:.3g},-1,-1,-1\n"


def truth_row(frame: int, identity: int, box: ArrayLike, counts: bool, visibility: float) -> str:
    """One line of a gt.txt in nine columns, with its line break; the class is 1, a pedestrian.

    Args:
        frame: From 1.
        identity: At least 1.
        box: Left, top, width, height, px; written to a hundredth.
        counts: Whether a tracker is to find it.
        visibility: From 0 to 1.
    """
    left, top, width, height = np.asarray(box, dtype=np.float64).tolist()
    return f"{frame},{identity},{left:.2f},{top:.2f},{width:.2f},{height:.2f},{int(counts)},1,{visibility:.3f}\n"


def write_seqinfo(path: str | Path, info: SequenceInfo) -> None:
    """Write a seqinfo.ini that `read_seqinfo` reads.

    Args:
        path: The file.
        info: What it tells; all of it.
    """
    parser = configparser.ConfigParser()
    # Keys keep their capitals, which other readers of these files want.
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
    """Line number and numbers of every row that is not blank; lines are bounded, so that memory is."""
    path = check_file(rows.path)
    try:
        with path.open("rb") as handle:
            line = 0
            while content := handle.readline(_MAX_LINE + 1):
                line += 1
                if len(content) > _MAX_LINE:
                    raise rows.fail(line, f"lines must be shorter than {_MAX_LINE} bytes; this is no file of rows")
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
        raise rows.fail(line, f"rows must hold numbers with commas between, got {shown!r}") from None
    if len(values) < _TRACK_COLUMNS:
        raise rows.fail(
            line, f"rows must hold at least frame, id, left, top, width, height, got {len(values)} number(s)"
        )
    return values


def _whole(rows: TrackRows, line: int, name: str, value: float) -> int:
    if not value.is_integer():  # also of NaN and infinity
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
        raise SequenceError(f"{path}: {key} must be a positive number, got {text!r}; mend the line or delete it")
    return value
