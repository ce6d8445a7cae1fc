"""Recognition of video containers by their first bytes, before a decoder opens the file."""

from __future__ import annotations

import re
from pathlib import Path

from servotrack.envs.track.files.bounded import check_file
from servotrack.envs.track.files.recorded import SequenceError

DEMUXERS = (
    "mov",
    "avi",
    "matroska",
    "mpegts",
    "mpeg",
    "mpegvideo",
    "m4v",
    "h264",
    "hevc",
    "ogg",
    "flv",
    "asf",
    "gif",
    "ivf",
    "mjpeg",
    "mxf",
    "nut",
    "dv",
    "yuv4mpegpipe",
)
"""FFmpeg's names of the accepted formats. All of them keep their frames in one file."""
_CONTAINERS = re.compile(
    rb"""
    .{4}(?:ftyp|styp|moov|moof|mdat|free|skip|wide|pnot)  # MP4, MOV, 3GP
    | RIFF.{4}AVI
    | \x1aE\xdf\xa3                                       # Matroska, WebM
    | \0*\0\0\x01[^\0]                                    # MPEG program stream, or MPEG and H.26x without a container
    | OggS
    | FLV[\x01-\x08]
    | 0&\xb2u\x8ef\xcf\x11                                # ASF, WMV
    | GIF8[79]a
    | DKIF\0\0                                            # IVF
    | \x06\x0e\+4\x02\x05\x01\x01                         # MXF
    | nut/multimedia
    | \x1f\x07\0                                          # DV
    | YUV4MPEG2[ ]
    """,
    re.VERBOSE | re.DOTALL,
)
# A recording that was cut may begin inside a packet.
_TRANSPORT_STREAM = re.compile(rb".{0,208}?(?:G.{187}G.{187}G|G.{191}G.{191}G|G.{203}G.{203}G)", re.DOTALL)
_JPEG = b"\xff\xd8\xff"
_IMAGES = (_JPEG, b"\x89PNG", b"BM", b"II*\0", b"MM\0*", b"P1", b"P2", b"P3", b"P4", b"P5", b"P6")
_WEBP = re.compile(rb"RIFF.{4}WEBP", re.DOTALL)
_MOTION_JPEG_SUFFIXES = (".mjpeg", ".mjpg")
_HEAD = 1024
"""Number of bytes that are looked at."""


def check_container(path: Path) -> None:
    """Raise SequenceError unless a file begins as a video that keeps its frames in this one file.

    Playlists and scripts (concat, HLS, DASH, SDP) name other files or addresses, which FFmpeg would open; they are
    refused whatever their suffix.

    Args:
        path: File of any suffix.
    """
    try:
        with check_file(path).open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise SequenceError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    if not head:
        raise SequenceError(f"{path} is empty")
    if _CONTAINERS.match(head) or _TRANSPORT_STREAM.match(head):
        return
    if head.startswith(_JPEG) and path.suffix.lower() in _MOTION_JPEG_SUFFIXES:
        return
    if head.startswith(_IMAGES) or _WEBP.match(head):
        raise SequenceError(f"{path} is an image; give a video, or the folder that holds the images")
    raise SequenceError(
        f"{path} cannot be decoded: not a video in a known container (it begins with {head[:16]!r}; known are MP4, "
        "AVI, Matroska, MPEG, Ogg, FLV, ASF, GIF, IVF, MXF, NUT, DV, Y4M). Playlists and scripts that name other files "
        "are not opened; convert them to one file"
    )
