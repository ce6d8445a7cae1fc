"""Damaged files for the readers: mutations of valid files, and checks of what a reader returned for them."""

from __future__ import annotations

import csv
import io
import random
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder

import cv2
import numpy as np

from servotrack.envs.track.files.caviar import read_caviar
from servotrack.envs.track.files.labeled import LabeledTruth, read_labeled
from servotrack.envs.track.files.mot_files import read_mot_detections, read_mot_tracks, read_seqinfo
from servotrack.envs.track.files.points import PointScans, read_points
from servotrack.envs.track.files.recorded import RecordedTracks
from servotrack.estimators.metrics.benchmarks import LabeledBoxes

GT = b"1,2,10,20,30,40,1,1,0.5\n1,7,0,0,5.5,6,1,1,1\n3,2,12,21,30,40,1,1,0.25\n2,9,1,1,1,1,0,8,1\n"
DETECTIONS = b"1,-1,291.557,192.468,39.494,119.227,0.995128,-1,-1,-1\n4,-1,5,6,7,8,-0.5,-1,-1,-1\n4,-1,1e1,6,7,8\n"
CVML = b"""<?xml version="1.0" encoding="UTF-8"?>
<dataset name="Walk">
 <frame number="0">
  <objectlist>
   <object id="4"><orientation>90</orientation><box xc="10.5" yc="20" w="3" h="8"/><appearance>visible</appearance>
    <hypothesislist><hypothesis id="1"><movement>walking</movement></hypothesis></hypothesislist></object>
  </objectlist>
  <grouplist><group id="0"><box xc="1" yc="1" w="1" h="1"/><members>4</members></group></grouplist>
 </frame>
 <frame number="2"><objectlist>
   <object id="4"><box h="8" w="3" xc="12" yc="20"/></object><object id="0"><box xc="5" yc="5" w="2" h="2"/></object>
 </objectlist><grouplist></grouplist></frame>
</dataset>
"""
POINTS = b"""time,x,y,cov_xx,cov_xy,cov_yy,id
0,1.5,2,4,1,5,a
0,-30,4e1,4,0,4,b
1.5,2,2.5,4,1,5,a
2,,,,,,
3.25,3,3,4,0.5,5,"a b"
"""
SEQINFO = b"[Sequence]\nname=Toy\nimDir=img1\nframeRate=25\nseqLength=3\nimWidth=64\nimHeight=48\nimExt=.jpg\n"

KITTI = b"""0 2 Pedestrian 0 0 -1.79 296.74 161.75 455.22 292.37 2.0 1.82 4.43 -4.55 1.86 13.41 -2.12
0 -1 DontCare -1 -1 -10 219.31 188.49 245.50 218.56 -1000 -1000 -1000 -10 -1 -1 -1
1 2 Pedestrian 0 3 -1.7 300.0 161.75 460.5 292.37 2.0 1.82 4.43 -4.55 1.86 13.41 -2.12
1 0 Cyclist 1 0 -1.7 10 20 30.5 60
"""

_TOKENS = (
    b"nan",
    b"-inf",
    b"1e400",
    b"1e-400",
    b"-0.0",
    b"9" * 30,
    b"9007199254740993",
    b"0x10",
    b"1_0",
    b"+1",
    b".5",
    b"5.",
    b"1e5",
    b"--1",
    b"",
    b" ",
    b"\t",
    b"\r",
    b"\r\n",
    b"\n",
    b"\n\n",
    b"\x0b",
    b"\x0c",
    b"\x00",
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    "\u0661".encode(),
    "\u00a0".encode(),
    "\u2028".encode(),
    b"\xed\xa0\x80",
    b"\xc0\x80",
    b"#",
    b";",
    b"%(a)s",
    b"\"'",
    b"1,1,1,1,1,1,1",
    b"<!ENTITY a 'b'>",
    b"<!DOCTYPE a>",
    b"&#49;",
    b"&lt;",
    b"<![CDATA[1]]>",
    b"<?a b?>",
    b"<!-- -->",
    b"<a>",
    b"</frame>",
    b"<frame number='1'>",
    b"<object id='1'>",
    b"<box xc='1' yc='1' w='1' h='1'/>",
    b"encoding='utf-16'",
    b"[Sequence]",
    b"..",
    b"/",
    b"99999999",
    b"-1",
)
_ENCODINGS = ("utf-16", "utf-16-be", "utf-32", "utf-8-sig", "latin-1", "utf-7", "cp037")


def mutated(rng: random.Random, content: bytes) -> bytes:
    """Return a valid file with a few of its bytes, tokens and lines changed, cut, repeated or moved."""
    if rng.random() < 0.02:
        return rng.randbytes(rng.randrange(300))
    if rng.random() < 0.02:
        return content.decode("ascii").encode(rng.choice(_ENCODINGS))
    if rng.random() < 0.02:
        return content.replace(b"\n", rng.choice([b"\r\n", b"\r", b"\n\n", b" \n", b"\x00\n", b""]))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        content = _MUTATIONS[rng.randrange(len(_MUTATIONS))](rng, content)
    return content


def _bytes(rng: random.Random, content: bytes) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.randbytes(rng.randint(1, 3)) + content[at + rng.randint(0, 3) :]


def _digit(rng: random.Random, content: bytes) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.choice(b"0123456789.,-+eE").to_bytes(1, "big") + content[at + rng.randint(0, 1) :]


def _token(rng: random.Random, content: bytes) -> bytes:
    pieces = re.split(rb"([,\s=\"<>]+)", content)
    pieces[rng.randrange(len(pieces))] = rng.choice(_TOKENS)
    return b"".join(pieces)


def _inserted(rng: random.Random, content: bytes) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.choice(_TOKENS) + content[at:]


def _removed(rng: random.Random, content: bytes) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + content[at + rng.randint(1, 20) :]


def _truncated(rng: random.Random, content: bytes) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _lines(rng: random.Random, content: bytes) -> bytes:
    lines = content.splitlines(keepends=True) or [b""]
    first, second = rng.randrange(len(lines)), rng.randrange(len(lines))
    change = rng.randrange(4)
    if change == 0:
        lines[first], lines[second] = lines[second], lines[first]
    elif change == 1:
        lines.insert(first, lines[second])
    elif change == 2:
        del lines[first]
    else:
        lines[first] = lines[first] * rng.choice((2, 50))
    return b"".join(lines)


_MUTATIONS: tuple[Callable[[random.Random, bytes], bytes], ...] = (
    _bytes, _digit, _digit, _token, _token, _inserted, _removed, _truncated, _lines,
)  # fmt: skip


def check_tracks(content: bytes, found: RecordedTracks) -> None:
    """Check the tracks of a file against a plain second reading of its rows, number by number."""
    rows = sorted(
        (row[1], row[0] - 1, *row[2:6], _visible(row))
        for row in _rows(content)
        if (len(row) < 7 or row[6] != 0) and not (len(row) == 9 and row[7] in (3, 4, 5, 6, 9, 10, 11, 13))
    )
    assert _listed(found) == rows


def _visible(row: list[float]) -> float:
    if len(row) == 9 and row[7] in (2, 7, 8, 12):
        return 0.0
    return 1.0 if len(row) != 9 or row[8] == -1 else row[8]


def check_detections(content: bytes, found: Any) -> None:
    """Check detections against a plain second reading, in the order of the file within a frame."""
    rows = [(row[0] - 1, *row[2:6], row[6] if len(row) > 6 else 1.0) for row in _rows(content)]
    rows.sort(key=lambda row: row[0])
    listed = [
        (step, *box, confidence)
        for step, one in found.items()
        for box, confidence in zip(one.boxes.tolist(), one.confidences.tolist(), strict=True)
    ]
    assert listed == rows and len(found) == len({row[0] for row in rows})


def check_cvml(content: bytes, found: RecordedTracks) -> None:
    """Check the tracks of a CVML file against its document. CVML has no namespaces: a colon is part of a name."""
    root = expatbuilder.parseString(content, namespaces=False).documentElement
    assert root.tagName == "dataset"
    rows = []
    for frame in _inside(root, "frame"):
        for item in (item for listed in _inside(frame, "objectlist") for item in _inside(listed, "object")):
            (box,) = _inside(item, "box")
            xc, yc, width, height = (_plain(box.getAttribute(key)) for key in ("xc", "yc", "w", "h"))
            identity, step = _plain(item.getAttribute("id")), _plain(frame.getAttribute("number"))
            rows.append((identity, step, xc - width / 2, yc - height / 2, width, height, 1.0))
    assert _listed(found) == sorted(rows)


def _inside(element: Any, name: str) -> list[Any]:
    """Child elements with a name."""
    return [child for child in element.childNodes if getattr(child, "tagName", None) == name]


def check_labels(content: bytes, found: LabeledTruth) -> None:
    """Check KITTI's labels, or a gt.txt with its flags, against a plain second reading of its rows."""
    if found.benchmark != "kitti-pedestrian":
        rows = [(row[1], row[0] - 1, *row[2:6], len(row) < 7 or int(row[6]) != 0) for row in _labeled_rows(content)]
        assert _labels(found.boxes) == sorted(rows) and not len(found.regions.steps)
        return
    rows, regions = [], []
    for line in content.decode("ascii", "backslashreplace").split("\n"):
        words = line.split()
        if not words:
            continue
        step, identity, truncated, occluded = (_plain(words[k]) for k in (0, 1, 3, 4))
        left, top, right, bottom = (_plain(word) for word in words[6:10])
        box = (left, top, right - left, bottom - top)
        if words[2].lower() == "dontcare":
            regions.append((step, *box))
        elif identity >= 0:
            rows.append((identity, step, *box, int(occluded) <= 2 and int(truncated) <= 0))
    assert _labels(found.boxes) == sorted(rows)
    assert sorted((row[1], *row[2:6]) for row in _labels(found.regions)) == sorted(regions)


def _labels(boxes: LabeledBoxes) -> list[tuple[float, ...]]:
    listed = zip(boxes.ids.tolist(), boxes.steps.tolist(), boxes.boxes.tolist(), boxes.counted.tolist(), strict=True)
    return sorted((name, step, *box, counted) for name, step, box, counted in listed)


def _labeled_rows(content: bytes) -> list[list[float]]:
    """Return the numbers of each row; columns behind the flag may hold anything that is a number."""
    lines = content.removeprefix(b"\xef\xbb\xbf").decode("ascii").split("\n")
    kept = [line for line in (line.strip(" \t\r\x0b\x0c") for line in lines) if line]
    assert not any("\r" in line for line in kept)
    parts = [line.rstrip(",").split(",") if "," in line else line.split() for line in kept]
    return [[_plain(part) if k < 7 and k != 1 else float(part) for k, part in enumerate(row)] for row in parts]


def check_seqinfo(content: bytes, found: Any) -> None:
    """Check that each number stands in the file, and that images lie inside the folder."""
    assert not Path(found.images).is_absolute() and ".." not in Path(found.images).parts
    text = content.decode("utf-8-sig")
    section = re.split(r"^\s*\[.+\]", text[text.index("[Sequence]") + 10 :], flags=re.MULTILINE)[0]
    for key, value in (("frameRate", found.frame_rate), ("seqLength", found.length), ("imWidth", found.width)):
        if value is None:
            # An indented line belongs to the value above it.
            assert not re.search(rf"^{key}\s*[=:]", section, re.MULTILINE | re.IGNORECASE)
        else:
            spelled = re.findall(rf"^\s*{key}\s*[=:]\s*(.*?)\s*$", section, re.MULTILINE | re.IGNORECASE)
            assert any(_plain(one) == value for one in spelled if _NUMBER.fullmatch(one))


def check_points(content: bytes, found: PointScans) -> None:
    """Check that every row is in the scan of its time, and that covariances and identities are those of the file."""
    text = content.decode("utf-8-sig")
    begin = re.split(r"[\r\n]", text, maxsplit=1)[0]
    mark = next((one for one in ",;\t" if one in begin), ",")
    rows = list(csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=mark))
    if mark != ",":
        rows = [[re.sub(r"^([ \t]*[+-]?\d*),(\d+)", r"\1.\2", cell) for cell in row] for row in rows]
    rows = [row for row in rows if any(cell.strip(" \t") for cell in row)]
    head = [cell.strip(" \t").lower() for cell in rows[0]]
    at = {name: head.index(name) for name in head}
    time = next(at[name] for name in ("time", "timestamp", "basedatetime", "t") if name in at)
    axes = [at[name] for name in ("x", "y", "z") if name in at]
    names = [at[name] for name in ("id", "label", "track", "target", "mmsi") if name in at][:1]
    # Of rows that repeat time, position and identity one is kept.
    kept: dict[tuple[float | str, ...], list[str]] = {}
    for row in rows[1:]:
        if any(row[k].strip(" \t").lower() not in ("", "nan", "na", "n/a", "null", "none") for k in axes):
            place = (float(row[k]) for k in axes)
            kept.setdefault((float(row[time]), *place, *(row[k].strip(" \t") for k in names)), row)
    placed = sorted(kept.values(), key=lambda row: float(row[time]))
    assert sorted({float(row[time]) for row in rows[1:]}) == found.times.tolist()
    seen = np.repeat(found.times, [len(scan) for scan in found.scans]).tolist()
    places = np.concatenate(found.scans).tolist()
    assert [[float(row[time]), *(float(row[k]) for k in axes)] for row in placed] == [
        [t, *place] for t, place in zip(seen, places, strict=True)
    ]
    assert np.abs(places).max() <= 1e9
    if "cov_xx" in at:
        assert found.covariances is not None
        upper = np.concatenate(found.covariances)
        assert [float(row[at["cov_xy"]]) for row in placed] == upper[:, 0, 1].tolist()
        assert (np.linalg.eigvalsh(upper) > 0.0).all()
    if found.identities is not None:
        assert [row[names[0]].strip(" \t") for row in placed] == [name for scan in found.identities for name in scan]


READERS: dict[str, tuple[Callable[[Path], Any], bytes, Callable[[bytes, Any], None]]] = {
    "gt.txt": (read_mot_tracks, GT, check_tracks),
    "det.txt": (read_mot_detections, DETECTIONS, check_detections),
    "truth.xml": (read_caviar, CVML, check_cvml),
    "labels.txt": (read_labeled, KITTI, check_labels),
    "flags.txt": (read_labeled, GT, check_labels),
    "seqinfo.ini": (read_seqinfo, SEQINFO, check_seqinfo),
    "points.csv": (read_points, POINTS, check_points),
}

_USED = (0, 2, 3, 4, 5, 6)
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def _plain(text: str) -> float:
    text = text.strip(" \t\n\r\x0b\x0c")
    assert _NUMBER.fullmatch(text), text
    return float(text)


def _rows(content: bytes) -> list[list[float]]:
    """Return the numbers of each row. Columns that no reader uses, and ignored rows, may hold NaN and infinity."""
    lines = content.removeprefix(b"\xef\xbb\xbf").decode("ascii").split("\n")
    kept = [line.strip(" \t\r\x0b\x0c") for line in lines]
    kept = [line for line in kept if line]
    assert not any("\r" in line for line in kept)
    parts = [line.rstrip(",").split(",") if "," in line else line.split() for line in kept]
    return [
        [_plain(part) if k in _USED and not _ignored(row) else float(part) for k, part in enumerate(row)]
        for row in parts
    ]


def _ignored(row: list[str]) -> bool:
    other = len(row) == 9 and float(row[7]) in (3, 4, 5, 6, 9, 10, 11, 13)
    return other or (len(row) > 6 and float(row[6]) == 0.0)


def _listed(found: RecordedTracks) -> list[tuple[float, ...]]:
    return [
        (identity, step, *box, visible)
        for identity, track, shares in zip(found.ids.tolist(), found.tracks, found.visibilities, strict=True)
        for step, box, visible in zip(track.steps.tolist(), track.states.tolist(), shares.tolist(), strict=True)
    ]


def films(folder: Path) -> list[Path]:
    """Return small videos of every container that OpenCV writes here."""
    made = []
    for name, codec in (("a.avi", "MJPG"), ("b.mp4", "mp4v"), ("c.webm", "VP80"), ("d.ts", "MPG2"), ("e.mpg", "MPG2"),
                        ("f.mkv", "MJPG"), ("g.ogv", "THEO"), ("h.flv", "FLV1"), ("i.wmv", "WMV2")):  # fmt: skip
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*codec), 25, (32, 32))
        for k in range(4):
            writer.write(np.uint8(np.random.default_rng(k).integers(0, 255, (32, 32, 3))))
        writer.release()
        if writer.isOpened() or (folder / name).is_file():
            made.append(folder / name)
    return made


def pictures(folder: Path) -> list[Path]:
    """Return small images of every format that image folders hold."""
    image = np.uint8(np.random.default_rng(0).integers(0, 255, (12, 16, 3)))
    made = [folder / f"p.{suffix}" for suffix in ("png", "jpg", "bmp", "tif", "ppm", "webp")]
    for path in made:
        assert cv2.imwrite(str(path), image)
    return made


def damaged(rng: random.Random, content: bytes) -> bytes:
    """Return a binary file with a few bytes, sizes or pieces changed, cut or repeated."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 2, 4, 16))):
        # Headers are at both ends.
        at = min(int(rng.choice((rng.random(), rng.random() ** 4, 1 - rng.random() ** 4)) * len(changed)), len(changed))
        kind = rng.randrange(6)
        if kind == 0:
            changed[at : at + 1] = rng.randbytes(1)
        elif kind == 1:
            value = rng.choice((0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 65536, 16384))
            changed[at : at + 4] = struct.pack(rng.choice((">I", "<I")), value)
        elif kind == 2:
            changed[at : at + 1] = bytes([changed[at] ^ (1 << rng.randrange(8))]) if at < len(changed) else b"\0"
        elif kind == 3:
            del changed[at : at + rng.choice((1, 4, 64))]
        elif kind == 4:
            changed[at:at] = changed[at : at + rng.choice((4, 64, 1024))]
        elif rng.random() < 0.2:
            del changed[at:]
    return bytes(changed)
