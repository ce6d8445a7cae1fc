"""Frames of every kind of source, and errors of damaged ones."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from servotrack.envs.track.files import decoders
from servotrack.envs.track.files.frames import open_frames
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.files.video_process import NumberedCapture

SIZE = (64, 48)


def picture(k: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Return an RGB frame whose gray level is its number; the texture keeps compressed frames from being tiny."""
    noise = np.random.default_rng(k).integers(-20, 21, (size[1], size[0], 1))
    return np.uint8(np.clip(noise + 30 + 6 * k + np.array([20, 0, -20]), 0, 255))


def number(image: np.ndarray) -> int:
    assert image[..., 0].mean() > image[..., 2].mean() + 20  # red first
    return round((float(image.mean()) - 30) / 6)


def write_video(path: Path, count: int = 30, codec: str = "MJPG", size: tuple[int, int] = SIZE) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10, size)
    assert writer.isOpened()
    for k in range(count):
        writer.write(picture(k, size)[..., ::-1])
    writer.release()
    return path


def write_images(folder: Path, images: dict[str, np.ndarray]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        assert cv2.imwrite(str(folder / name), image if image.ndim == 2 else image[..., ::-1])
    return folder


@pytest.mark.parametrize(("name", "codec"), [("v.avi", "MJPG"), ("v.mp4", "mp4v")])
def test_video_gives_rgb_frames_in_order_every_time(tmp_path, name, codec):
    source = open_frames(write_video(tmp_path / name, codec=codec))
    assert (source.source_size, source.size, source.frame_rate, source.length) == (SIZE, SIZE, 10.0, 30)
    for _ in range(2):
        found = list(source)
        assert [number(image) for image in found] == list(range(30))
        assert found[0].shape == (48, 64, 3) and found[0].dtype == np.uint8
    assert source.warning == ""


def test_start_count_and_stride_choose_frames(tmp_path):
    path = write_video(tmp_path / "v.avi")
    assert [number(i) for i in open_frames(path, start=4, count=5, stride=3)] == [4, 7, 10, 13, 16]
    assert [number(i) for i in open_frames(path, start=25)] == [25, 26, 27, 28, 29]
    with pytest.raises(SequenceError, match=r"ends after 30 frame\(s\), before the first wanted one; start was 30"):
        list(open_frames(path, start=30))


def test_resizing_keeps_the_shape_where_one_side_is_given(tmp_path):
    path = write_video(tmp_path / "v.avi", 3)
    assert next(iter(open_frames(path, width=32))).shape == (24, 32, 3)
    assert next(iter(open_frames(path, height=96))).shape == (96, 128, 3)
    assert next(iter(open_frames(path, width=40, height=40))).shape == (40, 40, 3)


@pytest.mark.parametrize(
    "argument", [{"width": 4}, {"height": 1e6}, {"start": -1}, {"count": 0}, {"stride": 0.5}, {"start": True}]
)
def test_arguments_out_of_range_are_named(tmp_path, argument):
    with pytest.raises(ValueError, match=f"^{next(iter(argument))} must be a whole number"):
        open_frames(tmp_path, **argument)


def test_images_come_in_the_order_of_their_numbers(tmp_path):
    names = ["frame10.png", "frame9.png", "frame1.PNG", "notes.txt"]
    write_images(tmp_path, {name: picture(int(name[5:-4])) for name in names[:3]})
    (tmp_path / names[3]).write_text("not an image")
    source = open_frames(tmp_path)
    assert [number(image) for image in source] == [1, 9, 10]
    # Numbers 2 to 8 are missing.
    assert (source.length, source.frame_rate) == (10, None)


def test_mot_folder_takes_its_images_and_rate(tmp_path):
    write_images(tmp_path / "pictures", {f"{k:06}.png": picture(k) for k in (1, 2)})
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nname=Toy\nimDir=pictures\nframeRate=14\nseqLength=99\n")
    source = open_frames(tmp_path)
    assert (source.name, source.frame_rate, source.length) == ("Toy", 14.0, 2)
    assert [number(image) for image in source] == [1, 2]
    (tmp_path / "pictures").rename(tmp_path / "elsewhere")
    with pytest.raises(SequenceError, match="without images: it has no folder pictures"):
        open_frames(tmp_path)


def test_gray_sixteen_bit_and_alpha_become_rgb(tmp_path):
    gray = picture(20)[..., 0]
    deep = np.repeat(gray[..., None], 3, axis=2).astype(np.uint16) * 256 + 255
    write_images(tmp_path / "s", {"1.png": gray, "2.png": gray.astype(np.uint16) * 256 + 77, "3.png": deep})
    cv2.imwrite(str(tmp_path / "s" / "4.png"), np.repeat(gray[..., None], 4, axis=2))
    for image in open_frames(tmp_path / "s"):
        np.testing.assert_array_equal(image, np.repeat(gray[..., None], 3, axis=2))


def test_change_of_size_ends_with_an_error_that_names_the_image(tmp_path):
    write_images(tmp_path, {"1.png": picture(1), "2.png": picture(2), "3.png": picture(3, (32, 32))})
    got = []
    with pytest.raises(SequenceError, match=r"frame 2 \(3\.png\): it has 32x32 px, the first one 64x48"):
        for image in open_frames(tmp_path, width=32):
            got.append(number(image))
    assert got == [1, 2]


def test_damaged_image_is_named(tmp_path):
    write_images(tmp_path, {"1.png": picture(1), "2.png": picture(2)})
    (tmp_path / "2.png").write_bytes(b"no image")
    got = []
    with pytest.raises(SequenceError, match=r"2\.png cannot be decoded as an image"):
        for image in open_frames(tmp_path):
            got.append(number(image))
    assert got == [1]


@pytest.mark.parametrize("claimed", [100_000, 7])
def test_frame_count_that_lies_changes_no_frame(tmp_path, claimed):
    path = write_video(tmp_path / "v.avi")
    content = bytearray(path.read_bytes())
    for chunk, offset in ((b"avih", 16), (b"strh", 32)):
        at = content.index(chunk) + 8 + offset
        content[at : at + 4] = struct.pack("<I", claimed)
    path.write_bytes(content)
    source = open_frames(path)
    assert [number(image) for image in source] == list(range(30))
    assert ("though 100000 are claimed" in source.warning) == (claimed > 30)


def test_truncated_video_keeps_what_can_be_decoded_and_says_where_it_ended(tmp_path):
    path = write_video(tmp_path / "v.avi")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = open_frames(path)
    got = [number(image) for image in source]
    # The last one may be half a frame.
    assert 5 < len(got) < 25 and got[:-1] == list(range(len(got) - 1))
    assert source.warning.startswith(f"{path}: no frame can be decoded after frame {len(got) - 1}, though 30 are")


def test_mp4_without_an_index_is_no_video(tmp_path):
    path = write_video(tmp_path / "v.mp4", codec="mp4v")
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(SequenceError, match=r"v\.mp4 cannot be decoded: .*truncated"):
        open_frames(path)


def test_sources_that_are_none_are_named(tmp_path):
    (tmp_path / "text.avi").write_text("hello " * 999)
    (tmp_path / "empty.avi").touch()
    write_video(tmp_path / "none.avi", 0)
    (tmp_path / "folder").mkdir()
    for name, message in {
        "text.avi": "cannot be decoded: not a video",
        "empty.avi": "empty.avi is empty",
        "none.avi": "holds no frame that can be decoded",
        "folder": "^[^ ]*folder holds no images",
        "nowhere.avi": "does not exist: give a video file",
        "nul\0": "cannot be a path|does not exist",
    }.items():
        with pytest.raises(SequenceError, match=message):
            open_frames(tmp_path / name)
    with pytest.raises(SequenceError, match="camera 97 cannot be opened"):
        open_frames("97")


PLAYLISTS = {
    "concat": "ffconcat version 1.0\nfile other.avi\n",
    "hls": "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nother.avi\n#EXT-X-ENDLIST\n",
    "dash": '<?xml version="1.0"?><MPD><Period><AdaptationSet><Representation><BaseURL>other.avi</BaseURL>'
    "</Representation></AdaptationSet></Period></MPD>",
    "sdp": "v=0\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
    "asx": '<asx version="3.0"><entry><ref href="other.avi"/></entry></asx>',
}


@pytest.mark.parametrize("kind", PLAYLISTS)
@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".m3u8"])
def test_playlist_opens_no_other_file(tmp_path, kind, suffix):
    write_video(tmp_path / "other.avi", 3)
    path = tmp_path / f"evil{suffix}"
    path.write_text(PLAYLISTS[kind])
    with pytest.raises(SequenceError, match=r"not a video in a known container .* begins with b.* Playlists"):
        open_frames(path)


def test_ffmpeg_itself_opens_no_playlist_and_keeps_the_options_of_the_user(tmp_path, monkeypatch):
    """The second line of defense, for files that would pass the check of their first bytes."""
    write_video(tmp_path / "other.avi", 3)
    path = tmp_path / "evil.mp4"
    path.write_text(PLAYLISTS["concat"])
    monkeypatch.setattr(decoders, "check_container", lambda path: None)
    for options in (None, "safe;0|format_whitelist;concat,avi", "input_format;concat"):
        if options is not None:
            monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", options)
        with pytest.raises(SequenceError, match=r"evil\.mp4 cannot be decoded"):
            open_frames(path)
        assert os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS") == options


def with_external_data(content: bytes, target: Path) -> bytes:
    """Return an mp4 whose data reference is an alias of another file."""
    name = str(target).encode()
    alias = bytes(11 + 27 + 12) + bytes([min(len(name), 63)]) + name[:63].ljust(63, b"\0") + bytes(16)
    alias += struct.pack(">hh", -1, -1) + bytes(16)
    alias += struct.pack(">hh", 2, len(name)) + name + bytes(len(name) % 2) + struct.pack(">hh", -1, 0)
    entry = struct.pack(">I4sI", 12 + len(alias), b"alis", 0) + alias
    reference = struct.pack(">I4sII", 16 + len(entry), b"dref", 0, 1) + entry
    at = content.index(b"dref") - 4
    (size,) = struct.unpack(">I", content[at : at + 4])
    changed = bytearray(content)
    for box in (b"moov", b"trak", b"mdia", b"minf", b"dinf"):
        start = content.index(box) - 4
        (length,) = struct.unpack(">I", content[start : start + 4])
        changed[start : start + 4] = struct.pack(">I", length + len(reference) - size)
    changed[at : at + size] = reference
    return bytes(changed)


def test_mp4_reads_no_data_of_another_file(tmp_path, monkeypatch):
    other = write_video(tmp_path / "other.mp4", 3, codec="mp4v")
    path = tmp_path / "evil.mp4"
    path.write_bytes(with_external_data(write_video(tmp_path / "own.mp4", 3, codec="mp4v").read_bytes(), other))
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "enable_drefs;1|use_absolute_path;1")
    # This is an attack: OpenCV alone plays the other file.
    assert cv2.VideoCapture(str(path), cv2.CAP_FFMPEG).read()[0]
    with pytest.raises(SequenceError, match=r"evil\.mp4 holds no frame that can be decoded"):
        open_frames(path)


@pytest.mark.parametrize(("suffix", "codec"), [(".avi", "MJPG"), (".mp4", "mp4v"), (".mov", "mp4v"), (".mkv", "MJPG"),
                                               (".webm", "VP80"), (".ts", "MPG2"), (".mpg", "MPG2"), (".wmv", "WMV2"),
                                               (".flv", "FLV1"), (".ogv", "THEO"), (".m4v", "mp4v")])  # fmt: skip
def test_containers_that_users_have_are_read(tmp_path, suffix, codec):
    path = tmp_path / f"v{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25, SIZE)
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {codec} into {suffix} here")
    for k in range(5):
        writer.write(picture(k)[..., ::-1])
    writer.release()
    assert [number(image) for image in open_frames(path)] == list(range(5))


def test_transport_stream_that_was_cut_inside_a_packet_is_read(tmp_path):
    path = tmp_path / "v.ts"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MPG2"), 25, SIZE)
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write MPEG-2 here")
    for k in range(30):
        writer.write(picture(k)[..., ::-1])
    writer.release()
    path.write_bytes(path.read_bytes()[100:])
    assert len(list(open_frames(path))) > 0


def test_image_as_a_source_is_refused_and_opens_no_neighbors(tmp_path):
    write_images(tmp_path, {f"p{k}.{suffix}": picture(k) for k in (1, 2) for suffix in ("png", "jpg", "bmp", "tif")})
    for suffix in ("png", "jpg", "bmp", "tif"):
        with pytest.raises(SequenceError, match=f"p1.{suffix} is an image; give a video, or the folder"):
            open_frames(tmp_path / f"p1.{suffix}")


@pytest.mark.parametrize("name", ["a b.avi", "v%d.avi", "v%03d.avi", "[1]*?.avi", "été ☃.avi", "-o.avi", "a|b;c.avi",
                                  "file:x.avi", "concat:a.avi", "v1.avi"])  # fmt: skip
def test_names_have_no_meaning(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "v.avi", 4).rename(tmp_path / name)
    write_video(tmp_path / "v2.avi", 9)
    for source in (name, tmp_path / name):
        assert [number(image) for image in open_frames(source)] == list(range(4))


def test_pipes_devices_and_links_in_a_circle_are_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe.avi")
    (tmp_path / "endless.avi").symlink_to("/dev/zero")
    (tmp_path / "loop.avi").symlink_to("loop.avi")
    for name, message in {"pipe": "not a regular file", "endless": "not a regular file", "loop": "not exist"}.items():
        with pytest.raises(SequenceError, match=message):
            open_frames(tmp_path / f"{name}.avi")
    with pytest.raises(SequenceError, match=r"^source is empty: give"):
        open_frames("")
    for name in ("pipe", "endless"):
        folder = tmp_path / name
        folder.mkdir()
        (tmp_path / f"{name}.avi").rename(folder / "1.png")
        with pytest.raises(SequenceError, match=r"1\.png is not a regular file"):
            open_frames(folder)


def test_link_to_a_video_is_followed(tmp_path):
    (tmp_path / "link.avi").symlink_to(write_video(tmp_path / "v.avi", 3))
    assert len(list(open_frames(tmp_path / "link.avi"))) == 3


@pytest.mark.parametrize("rate", [(0, 1), (1, 0), (0, 0), (10**9, 1), (2**32 - 1, 1), (1, 2**32 - 1)])
def test_frame_rate_that_cannot_be_is_unknown(tmp_path, rate):
    content = bytearray(write_video(tmp_path / "v.avi", 3).read_bytes())
    at = content.index(b"strh") + 28
    content[at : at + 8] = struct.pack("<II", rate[1], rate[0])
    (tmp_path / "v.avi").write_bytes(content)
    source = open_frames(tmp_path / "v.avi")
    assert source.frame_rate is None or 0.1 <= source.frame_rate <= 1000.0
    assert len(list(source)) == 3


def test_single_frames_and_single_pixels_are_read(tmp_path):
    assert [number(image) for image in open_frames(write_video(tmp_path / "one.avi", 1))] == [0]
    source = open_frames(write_video(tmp_path / "tiny.avi", 3, size=(1, 1)))
    assert source.source_size == (1, 1) and len(list(source)) == 3


def test_frames_that_are_too_large_are_refused_before_they_are_decoded(tmp_path):
    with pytest.raises(SequenceError, match=r"wide\.avi: frames of 16400x16 px are too large, the limit is 16384"):
        open_frames(write_video(tmp_path / "wide.avi", 1, size=(16400, 16)))
    (tmp_path / "s").mkdir()
    # 900 million pixels in 3 KB, for every format whose header names the size.
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header
    png += struct.pack(">II", zlib.crc32(b"IHDR" + header), 3000) + b"IDAT" + bytes(3000)
    (tmp_path / "s" / "1.png").write_bytes(png)
    with pytest.raises(SequenceError, match=r"1\.png cannot be decoded: Image size \(900000000 pixels\) exceeds limit"):
        open_frames(tmp_path / "s")
    (tmp_path / "s" / "1.png").rename(tmp_path / "s" / "1.ppm")
    (tmp_path / "s" / "1.ppm").write_bytes(b"P6 17000 100 255\n" + bytes(100))
    with pytest.raises(SequenceError, match=r"1\.ppm: frames of 17000x100 px are too large, the limit is 16384"):
        open_frames(tmp_path / "s")


def test_image_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "1.png").open("wb") as file:
        file.truncate((1 << 30) + 1)
    with pytest.raises(SequenceError, match=r"1\.png has 1073741825 bytes, the limit is 1073741824"):
        open_frames(tmp_path)


class Stalling:
    """VideoCapture whose reads fail now and then, without frame rate and length."""

    def __init__(self, pauses: dict[int, int], frames: int = 6) -> None:
        self.pauses, self.frames, self.at = dict(pauses), frames, 0

    def get(self, which: int) -> float:
        return {cv2.CAP_PROP_FRAME_COUNT: -1.9e14}.get(which, float("nan"))

    def grab(self) -> bool:
        if self.pauses.get(self.at, 0) > 0:
            self.pauses[self.at] -= 1
            return False
        self.at += 1
        return self.at <= self.frames


def test_short_stalls_are_waited_out_and_long_ones_end_the_sequence():
    def grabbed(pauses: dict[int, int]) -> list[int]:
        capture = NumberedCapture(Stalling(pauses))
        assert capture.length is None and capture.rate is None
        return [frame.number for frame in iter(capture.grab, None)]

    assert grabbed({}) == list(range(6))
    # A read that failed was a frame that could not be decoded.
    assert grabbed({2: 4}) == [0, 1, 6, 7, 8, 9]
    assert grabbed({3: 1000}) == [0, 1, 2]
