"""Check of the structure of AVI files: they store no time stamps, so that a damaged chunk shifts all later frames."""

from __future__ import annotations

import os
import re
import struct
from pathlib import Path
from typing import BinaryIO

_HEADER = struct.Struct("<4sI")
_LIST = 12
"""Length of the header of a list, bytes."""
_VIDEO = re.compile(rb"[0-9]{2}d[bc]")
_IN_MOVIE = re.compile(rb"[0-9]{2}(?:d[bc]|wb|tx|pc|iv)|ix[0-9]{2}|JUNK|LIST|rec |idx1")
_MOST_CHUNKS = 10_000_000


def first_damaged_frame(path: Path) -> int | None:
    """Return the number of the first frame, from 0, at which the chunks of an AVI file do not follow each other.

    Frames from there on may have lower or higher numbers than in the file that was recorded, because decoders look for
    the next chunk and count on. None if the structure is sound, or the file is no AVI file.

    Args:
        path: Regular file.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(_LIST)
        if head[:4] != b"RIFF" or head[8:11] != b"AVI":
            return None
        frames, at = 0, _LIST
        for _ in range(_MOST_CHUNKS):
            name, length = _chunk(file, at)
            if not name:
                return None if at >= size - 1 else frames
            kind = file.read(4)
            if name == b"RIFF" or (name == b"LIST" and kind in (b"movi", b"rec ")):
                # Their content is a list of chunks itself.
                at += _LIST
                continue
            end = at + _HEADER.size + length
            if not (_IN_MOVIE.fullmatch(name) or name in (b"idx1", b"indx")) or end > size:
                # The end of a recording that was cut is said by its number of frames.
                return None if end > size and _IN_MOVIE.fullmatch(name) else frames
            frames += _VIDEO.fullmatch(name) is not None
            at = end + length % 2
    return None


def _chunk(file: BinaryIO, at: int) -> tuple[bytes, int]:
    file.seek(at)
    header = file.read(_HEADER.size)
    return _HEADER.unpack(header) if len(header) == _HEADER.size else (b"", 0)
