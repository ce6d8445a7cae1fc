"""Films: whole or not at all, with every frame that was passed."""

import resource
from pathlib import Path

import cv2
import numpy as np
import pytest

from servotrack.baselines.reporting import film as film_module
from servotrack.baselines.reporting.film import CODECS, Film, FilmError, browser_suffix, write_film
from servotrack.baselines.reporting.h264 import H264Writer, has_h264


def picture(k: int, width: int = 64, height: int = 48) -> np.ndarray:
    noise = np.random.default_rng(k).integers(-15, 16, (height, width, 1))
    return np.uint8(np.clip(noise + 40 + 15 * k + np.array([30, 0, -30]), 0, 255))


def frames_of(path: Path) -> list[np.ndarray]:
    capture, found = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        found.append(read[1][..., ::-1])
    capture.release()
    return found


@pytest.mark.parametrize("suffix", CODECS)
@pytest.mark.parametrize("size", [(64, 48), (65, 48), (64, 47), (17, 17)])
def test_every_frame_is_kept_and_odd_sides_lose_no_pixels(tmp_path, suffix, size):
    path = tmp_path / f"film{suffix}"
    assert write_film((picture(k, *size) for k in range(9)), path, 10.0) == 9
    found = frames_of(path)
    assert [round((float(image.mean()) - 40) / 15) for image in found] == list(range(9))
    width, height = size
    assert found[0].shape == (height + height % 2, width + width % 2, 3)
    assert found[0][..., 0].mean() > found[0][..., 2].mean() + 20  # red first
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (picture(0, 64, 50), "frame 2 has 64x50 px, the first one 64x48; draw all frames in one size"),
        (picture(0, 48, 64), "frame 2 has 48x64 px, the first one 64x48"),
        (picture(0)[..., 0], r"frame 2 must be an RGB image, uint8, shape \(H, W, 3\), got uint8, shape \(48, 64\)"),
        (np.zeros((48, 64, 4), np.uint8), r"frame 2 must be an RGB image.* got uint8, shape \(48, 64, 4\)"),
        (picture(0) / 255.0, "frame 2 must be an RGB image.* got float64"),
        (np.full((48, 64, 3), np.nan), "frame 2 must be an RGB image.* got float64"),
        (picture(0).astype(np.uint16), "frame 2 must be an RGB image.* got uint16"),
        (picture(0).tolist(), "frame 2 must be an RGB image.* got list"),
        (None, "frame 2 must be an RGB image.* got NoneType"),
    ],
)
def test_frame_of_another_kind_is_named_and_leaves_an_earlier_film(tmp_path, wrong, message):
    path = tmp_path / "film.avi"
    write_film([picture(0)], path, 10.0)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=message):
        write_film([picture(0), picture(1), wrong, picture(3)], path, 10.0)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["film.avi"]


@pytest.mark.parametrize("suffix", CODECS)
@pytest.mark.parametrize("size", [(1, 1), (4, 4), (15, 64), (64, 8), (8191, 16), (16, 20_000)])
def test_size_that_encoders_fail_at_is_refused(tmp_path, suffix, size):
    with pytest.raises(FilmError, match=rf"frames of {size[0]}x{size[1]} px cannot be filmed: .* 16 to 8190 px"):
        write_film([np.zeros((size[1], size[0], 3), np.uint8)], tmp_path / f"film{suffix}", 10.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_frame_rate_out_of_range_is_named(tmp_path, rate):
    with pytest.raises(ValueError, match=r"rate must lie in \[0.1, 1000\] frames per second, got"):
        Film(tmp_path / "film.mp4", rate)


def test_film_without_frames_is_refused_and_writes_nothing(tmp_path):
    with pytest.raises(ValueError, match="frames must hold at least one frame, got none"):
        write_film(iter(()), tmp_path / "film.mp4", 10.0)
    assert not list(tmp_path.iterdir())


def test_error_of_the_frames_leaves_no_half_film(tmp_path):
    def frames():
        yield from (picture(k) for k in range(5))
        raise RuntimeError("the environment broke down")

    with pytest.raises(RuntimeError, match="broke down"):
        write_film(frames(), tmp_path / "film.webm", 10.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", CODECS)
def test_film_that_could_not_be_written_in_full_is_removed(tmp_path, suffix):
    """OpenCV says nothing when a write fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
    try:
        with pytest.raises(FilmError, match=rf"film\{suffix} could not be (written: \d+ of 60 frames|finished)"):
            write_film((np.random.default_rng(k).integers(0, 256, (96, 128, 3), np.uint8) for k in range(60)),
                       tmp_path / f"film{suffix}", 10.0)  # fmt: skip
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not has_h264() or not Path("/dev/full").exists(), reason="needs PyAV and a full device")
def test_a_full_disk_crashes_no_encoder():
    writer = H264Writer(Path("/dev/full"), 10.0, (64, 48))
    with pytest.raises(OSError, match="No space left"):
        for k in range(100):
            writer.write(picture(k, 320, 240))
    for _ in range(2):
        with pytest.raises(OSError, match="No space left"):
            writer.write(picture(0))
    with pytest.raises(OSError, match="No space left"):
        writer.release()
    writer.release()


def test_name_of_a_folder_is_no_address(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_film([picture(0)], Path("file:out") / "film.mp4", 10.0)
    assert len(frames_of(tmp_path / "file:out" / "film.mp4")) == 1
    assert [item.name for item in tmp_path.iterdir()] == ["file:out"]


def test_film_that_browsers_play_has_its_index_first(tmp_path):
    pytest.importorskip("av")
    assert browser_suffix() == ".mp4"
    write_film((picture(k) for k in range(5)), tmp_path / "film.mp4", 29.97)
    content = (tmp_path / "film.mp4").read_bytes()
    # H.264 in MP4, and playable before all of it has come.
    assert b"avc1" in content and content.index(b"moov") < content.index(b"mdat")
    assert cv2.VideoCapture(str(tmp_path / "film.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(29.97, abs=1e-3)


def test_without_pyav_films_for_browsers_are_webm(tmp_path, monkeypatch):
    monkeypatch.setattr(film_module, "has_h264", lambda: False)
    assert browser_suffix() == ".webm"
    write_film((picture(k) for k in range(3)), tmp_path / "film.mp4", 10.0)
    assert len(frames_of(tmp_path / "film.mp4")) == 3
