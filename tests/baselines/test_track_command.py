"""`servotrack track`: tracks, film and scores of real files; what ends a run early loses nothing."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.track_command import disk_space
from servotrack.baselines.track_command.claim import claim_folder
from servotrack.baselines.track_command.command import OUTPUTS
from servotrack.baselines.track_command.inputs import FileInput, PixelInput
from servotrack.baselines.track_command.painter import BoxPainter
from servotrack.baselines.track_command.run import film_name, track
from servotrack.baselines.track_command.scores import score_tracks
from servotrack.baselines.track_command.timed import TimedTracker
from servotrack.baselines.track_command.tracks_file import TracksFile
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import RecordedTracks, SequenceError
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.metrics import Track
from servotrack.estimators.rfs.sets import SetEstimate

FRAMES, SIZE = 12, (128, 96)
BOX = np.array([16.0, 24.0, 16.0, 40.0])
STEP = np.array([4.0, 0.0, 0.0, 0.0])


class Brightness:
    """Finds what is bright, and remembers what its background was made of."""

    def __init__(self) -> None:
        self.learned = 0

    def initial(self, frames: Any) -> int:
        self.learned = len(frames) if isinstance(frames, list) else 1
        return 0

    def step(self, state: int, frame: np.ndarray) -> tuple[int, Detections]:
        box = cv2.boundingRect((frame[..., 0] > 128).astype(np.uint8))
        return state + 1, detections_from_boxes([box] if box[2] else [])


class Following:
    """Reports every detection under the label of its row."""

    def initial(self, detections: Detections) -> int:
        return 0

    def step(self, state: int, detections: Detections) -> tuple[int, SetEstimate]:
        return state + 1, estimate_of(detections.boxes)


def following() -> TimedTracker:
    return TimedTracker(Following(), 10.0)


def estimate_of(boxes: np.ndarray) -> SetEstimate:
    k = len(boxes)
    none = np.zeros(0, np.int64)
    return SetEstimate(
        np.asarray(boxes, dtype=np.float64).reshape(k, 4), np.arange(1, k + 1), np.ones(k), np.zeros((k, 4, 4)),
        np.array(float(k)), none, np.zeros((0, 4)), np.zeros(0),
    )  # fmt: skip


def write_video(path: Path, count: int = FRAMES) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    rng = np.random.default_rng(0)
    for k in range(count):
        frame = rng.integers(0, 40, (SIZE[1], SIZE[0], 3), np.uint8)
        left, top, width, height = (BOX + k % 24 * STEP).astype(int)
        frame[top : top + height, left : left + width] = 255
        writer.write(frame)
    writer.release()
    return path


def truth_of(count: int = FRAMES) -> RecordedTracks:
    steps = np.arange(count)
    return RecordedTracks(np.array([1]), [Track(steps, BOX + steps[:, None] * STEP)], [np.ones(count)])


def film_frames(path: Path) -> int:
    capture, count = cv2.VideoCapture(str(path)), 0
    while capture.read()[0]:
        count += 1
    return count


def test_tracks_are_in_the_sources_px_whatever_size_the_detector_works_at(tmp_path):
    detector = Brightness()
    source = PixelInput(write_video(tmp_path / "v.avi"), detector, (64, 48), background=4)
    run = track(source, following(), tmp_path / "out", BoxPainter((128, 96), truth_of()))
    assert detector.learned == 4
    assert run.frames == list(range(FRAMES)) and run.stopped == "" and run.rate > 0
    found = read_tracks(tmp_path / "out" / "tracks.txt")
    np.testing.assert_allclose(found.tracks[0].states, truth_of().tracks[0].states, atol=2.0)
    assert film_frames(tmp_path / "out" / film_name()) == FRAMES
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [film_name(), "tracks.txt"]
    scores = score_tracks(truth_of(), found, run.frames, "iou")
    assert (scores.count_accuracy, scores.mota, scores.idf1, scores.identity_switches) == (1.0, 1.0, 1.0, 0)
    assert scores.ospa < 0.1


def test_first_pass_that_needs_too_much_memory_is_refused(tmp_path):
    path = write_video(tmp_path / "v.avi")
    with pytest.raises(
        ValueError, match=r"background of 12 frames of 16384x16384 px needs 9\.0 GiB, the limit is 4; set"
    ):
        PixelInput(path, Brightness(), (16384, 16384), background=10**12)
    assert PixelInput(path, Brightness(), (16384, 16384), background=0).length == FRAMES


def test_start_count_and_stride_keep_the_sources_numbers(tmp_path):
    source = PixelInput(write_video(tmp_path / "v.avi"), Brightness(), "source", start=2, count=3, stride=4)
    assert (source.length, source.frame_rate) == (3, 2.5)
    run = track(source, following(), tmp_path / "out")
    assert run.frames == [2, 6, 10]
    found = read_tracks(tmp_path / "out" / "tracks.txt")
    assert found.tracks[0].steps.tolist() == [2, 6, 10]
    scores = score_tracks(truth_of(), found, run.frames)
    assert (scores.frames, scores.mota) == (3, 1.0)


def test_detections_of_a_sequence_without_images_are_tracked(tmp_path):
    (tmp_path / "det").mkdir()
    (tmp_path / "det" / "det.txt").write_text("2,-1,1,2,3,4,0.5\n5,-1,2,2,3,4,0.5\n")
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nseqLength=4000000000\nframeRate=8\nimWidth=64\nimHeight=48\n")
    source = FileInput(tmp_path)
    assert source.length == 5 and source.source_size == (64, 48)
    run = track(source, following(), tmp_path / "out", BoxPainter((64, 48)))
    assert run.rows == 2 and film_frames(tmp_path / "out" / film_name()) == 5
    assert read_tracks(tmp_path / "out" / "tracks.txt").tracks[0].steps.tolist() == [1, 4]
    with pytest.raises(SequenceError, match=r"holds no det/det\.txt"):
        FileInput(tmp_path / "det")
    with pytest.raises(SequenceError, match="no detections from frame 9 on"):
        FileInput(tmp_path, start=9)


@pytest.mark.parametrize("background", [0, 40])
def test_broken_source_keeps_what_was_tracked(tmp_path, background):
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(6):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((64, 64, 3), 255 if k < 5 else 0, np.uint8))
    (folder / "4.png").write_bytes(b"broken")
    source = PixelInput(folder, Brightness(), background=background)
    run = track(source, following(), tmp_path / "out", BoxPainter((64, 64)))
    assert run.frames == [0, 1, 2, 3] and "4.png cannot be decoded as an image" in run.stopped and run.error is not None
    assert read_tracks(tmp_path / "out" / "tracks.txt").length == 4
    assert film_frames(tmp_path / "out" / film_name()) == 4


def test_nothing_tracked_leaves_an_earlier_file_alone(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "tracks.txt").write_text("an earlier run's")
    (tmp_path / "f").mkdir()
    cv2.imwrite(str(tmp_path / "f" / "1.png"), np.zeros((64, 64, 3), np.uint8))
    source = PixelInput(tmp_path / "f", Brightness())
    (tmp_path / "f" / "1.png").write_bytes(b"broken")
    with pytest.raises(SequenceError, match="cannot be decoded as an image"):
        track(source, following(), out)
    assert [p.name for p in out.iterdir()] == ["tracks.txt"] and "earlier" in (out / "tracks.txt").read_text()


class FullDisk:
    """A file on a disk with room for so many bytes."""

    def __init__(self, file: Any, room: int) -> None:
        self._file, self._room = file, room

    def write(self, content: bytes) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = self._file.write(content[: self._room])
        self._room -= written
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def test_full_disk_keeps_whole_frames(tmp_path, monkeypatch):
    with pytest.raises(OSError, match="No space left"), TracksFile(tmp_path / "tracks.txt") as tracks:
        tracks._file = FullDisk(tracks._file, 200)  # type: ignore[assignment]
        for frame in range(1, 10):
            tracks.write(frame, estimate_of([BOX, BOX + 1]))
    found = read_tracks(tmp_path / "tracks.txt")
    assert [len(t.steps) for t in found.tracks] == [2, 2] and tracks.rows == 4


def test_run_ends_before_the_disk_is_full(tmp_path, monkeypatch):
    free = [1 << 30, 1 << 30, 1 << 20]
    usage = disk_space.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(disk_space.shutil, "disk_usage", lambda _: usage._replace(free=free.pop(0)))
    source = PixelInput(write_video(tmp_path / "v.avi", 40), Brightness())
    run = track(source, following(), tmp_path / "out", BoxPainter(SIZE))
    assert len(run.frames) == 16 and "No space left on device (1024 KiB free)" in run.stopped
    assert read_tracks(tmp_path / "out" / "tracks.txt").length == 16
    assert film_frames(tmp_path / "out" / film_name()) == 16


def test_film_that_does_not_play_is_removed_with_a_warning(tmp_path, monkeypatch):
    source = PixelInput(write_video(tmp_path / "v.avi"), Brightness())
    film = tmp_path / "out" / film_name()
    from servotrack.baselines.track_command import run as module

    keep = module._keep_film
    monkeypatch.setattr(module, "_keep_film", lambda f, r: (film.write_bytes(b"half a film"), keep(f, r)))
    run = track(source, following(), tmp_path / "out", BoxPainter(SIZE))
    assert "could not be finished" in run.warnings[0] and not film.exists()
    assert [path.name for path in run.files] == ["tracks.txt"]


def test_folder_that_cannot_be_written_is_named_before_anything_is_decoded(tmp_path):
    (tmp_path / "out").write_text("a file")
    source = PixelInput(write_video(tmp_path / "v.avi"), Brightness())
    with pytest.raises(ResultsError, match="out is a file, not a results folder"):
        track(source, following(), tmp_path / "out")
    with pytest.raises(ResultsError, match="is not writable"):
        track(source, following(), Path("/proc/nowhere"))


@pytest.fixture
def interrupts():
    """Python's own handler, which processes that are started in the background do not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts")
def test_signal_is_taken_between_two_frames(tmp_path):
    source = PixelInput(write_video(tmp_path / "v.avi"), Brightness())
    seen: list[int] = []

    def interrupt() -> None:
        seen.append(1)
        if len(seen) == 5:
            os.kill(os.getpid(), signal.SIGINT)

    run = track(source, following(), tmp_path / "out", BoxPainter(SIZE), on_frame=interrupt)
    assert run.signal == signal.SIGINT and run.stopped == "interrupted" and run.frames == list(range(5))
    assert film_frames(tmp_path / "out" / film_name()) == 5
    with pytest.raises(KeyboardInterrupt):  # outside, it acts as ever
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)


def test_centroid_rule_measures_in_heights(tmp_path):
    truth = truth_of(4)
    off = BOX + np.array([0.0, 0.55 * BOX[3], 0.0, 0.0])
    found = RecordedTracks(np.array([5]), [Track(np.arange(4), off + np.arange(4)[:, None] * STEP)], [np.ones(4)])
    assert score_tracks(truth, found, range(4), "centroid").mota == 1.0
    assert score_tracks(truth, found, range(4), "iou").mota == -1.0
    with pytest.raises(ValueError, match="match must be one of iou, centroid, got 'area'"):
        score_tracks(truth, found, range(4), "area")


def servotrack(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "servotrack", "track", *arguments],
        cwd=cwd, env={**os.environ, "COLUMNS": "200"}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        # A shell starts a background job with SIGINT ignored, which the tests themselves may be.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    """A folder with a long video and its truth."""
    folder = tmp_path_factory.mktemp("sequence")
    write_video(folder / "walk.avi")
    steps = np.arange(FRAMES)
    rows = [f"{k + 1},1,{','.join(str(x) for x in BOX + k * STEP)},1,1,1\n" for k in steps]
    (folder / "gt.txt").write_text("".join(rows))
    return folder


def test_command_writes_tracks_film_and_scores(sequence, tmp_path):
    process = servotrack(
        str(sequence / "walk.avi"), "--truth", str(sequence / "gt.txt"), "--match", "centroid", "--offline",
        "--out", "out", "--background", "0", cwd=tmp_path,
    )  # fmt: skip
    text, _ = process.communicate(timeout=120)
    assert process.returncode == 0, text
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"track.json", "tracks.txt", film_name(), "tracks_offline.txt", "scores.json", "scores.md"}
    record = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert set(record["scores"]) == {"pmb", "pmb, offline"} and record["match"] == "centroid"
    assert record["scores"]["pmb"]["frames"] == FRAMES
    assert "MOTA" in text and "frames/s" in text and "MOTA" in (tmp_path / "out" / "scores.md").read_text()


def test_interrupt_in_the_middle_keeps_valid_files_and_says_so(tmp_path):
    write_video(tmp_path / "long.avi", 2000)
    process = servotrack("long.avi", "--out", "out", "--background", "0", cwd=tmp_path)
    growing = tmp_path / "out" / "tracks.txt.unfinished"
    deadline = time.monotonic() + 90.0
    while not (growing.exists() and growing.stat().st_size > 1500) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 130, text
    found = read_tracks(tmp_path / "out" / "tracks.txt")
    kept = film_frames(tmp_path / "out" / film_name())
    assert 20 < found.length <= kept < 2000
    assert f"stopped by SIGINT; {kept} frames are kept, up to frame {kept - 1}" in text
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["track.json", film_name(), "tracks.txt"]


def test_files_of_others_are_neither_replaced_nor_removed(sequence, tmp_path):
    theirs = {"scores.json": '{"piano": 3}', "tracks.txt": "a list of songs"}
    for name, text in theirs.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text(text)
        process = servotrack(str(sequence / "walk.avi"), "--out", str(folder), "--no-video", cwd=tmp_path)
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 2 and f"holds {name}, which no `servotrack track` wrote" in output, output
        assert [path.name for path in folder.iterdir()] == [name] and (folder / name).read_text() == text


def test_a_marked_folder_is_used_again(tmp_path):
    claim_folder(tmp_path, OUTPUTS, {"source": "a.avi"})
    claim_folder(tmp_path, OUTPUTS, {"source": "b.avi"})
    assert json.loads((tmp_path / "track.json").read_text())["source"] == "b.avi"
    (tmp_path / "track.json").write_text("{}")
    with pytest.raises(ResultsError, match=r"track\.json is not of `servotrack track`; choose another --out"):
        claim_folder(tmp_path, OUTPUTS, {})


def test_progress_goes_to_stderr(sequence, tmp_path, capsys, monkeypatch):
    from servotrack import __main__ as command_line

    monkeypatch.setattr(sys, "argv", ["servotrack", "track", str(sequence / "walk.avi"), "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    captured = capsys.readouterr()
    assert not ended.value.code and "12 frames" in captured.err
    assert captured.out.splitlines()[0].endswith("tracks.txt")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.avi"], "source 'nowhere.avi' does not exist"),
        (["empty.avi"], "empty.avi is empty"),
        (["walk.avi", "--detector", "maskd"], "did you mean 'masked'"),
        (["walk.avi", "--tracker", "pbm"], "did you mean 'pmb'"),
        (["walk.avi", "--size", "big"], "size must be WxH such as 384x288"),
        (["walk.avi", "--size", "4x4"], "size must have sides from 8 to 16384 px, got '4x4'"),
        (["walk.avi", "--match", "area"], "match must be one of iou, centroid, got 'area'"),
        (["walk.avi", "--truth", "bad.txt"], "bad.txt, line 2: boxes must be finite"),
        (["walk.avi", "--truth", "bomb.xml"], "bomb.xml, line 1: entities are not allowed"),
        (["walk.avi", "--detector", "file"], "holds no det/det.txt"),
        (["walk.avi", "--start", "99"], "ends after 12 frame(s), before the first wanted one; start was 99"),
        (["walk.avi", "--out", "bad.txt"], "bad.txt is a file"),
    ],
)
def test_mistakes_are_told_in_one_line(sequence, tmp_path, capsys, monkeypatch, arguments, message):
    from servotrack import __main__ as command_line

    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.avi").write_bytes((sequence / "walk.avi").read_bytes())
    (tmp_path / "empty.avi").touch()
    (tmp_path / "bad.txt").write_text("1,1,0,0,5,5,1\n2,1,nan,0,5,5,1\n")
    (tmp_path / "bomb.xml").write_text('<!DOCTYPE d [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><dataset>&b;</dataset>')
    monkeypatch.setattr(sys, "argv", ["servotrack", "track", "--out", "out", *arguments])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 2
    captured = capsys.readouterr()
    # A run that had begun leaves its bar above the line.
    line = captured.err.splitlines()[-1]
    assert line.startswith("servotrack: ") and message in line
    assert captured.err.count("\n") - captured.err.count(" frames ") == 1 and "Traceback" not in captured.err
