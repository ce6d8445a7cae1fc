"""`servotrack.track`, `servotrack.Tracker` and the files of tracks: one line for a video, one call for a frame."""

from __future__ import annotations

import csv
import functools
import http.server
import json
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rich.console import Console

import servotrack
from servotrack.baselines.track_command.api import as_detections
from servotrack.baselines.track_command.command import TrackRequest, folder_name, run_command
from servotrack.baselines.track_command.notices import NewNotes
from servotrack.baselines.track_command.opening import SourceRequest
from servotrack.baselines.track_command.timed import TimedTracker, takes
from servotrack.envs.track.files.frames import open_frames
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.boxes import KalmanHungarian
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.rfs.sets import SetEstimate

BOX = np.array([16.0, 24.0, 16.0, 40.0])
RIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def write_walk(path: Path, count: int = 30) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (128, 96))
    rng = np.random.default_rng(0)
    for k in range(count):
        frame = rng.integers(0, 30, (96, 128, 3), np.uint8)
        left = 8 + 3 * k
        if k >= 5:
            frame[24:64, left : left + 16] = 220
        writer.write(frame)
    writer.release()
    return path


def test_one_line_tracks_a_video(tmp_path):
    path = write_walk(tmp_path / "v.avi")
    found = list(servotrack.track(path, tracker="kalman-hungarian", background=5))
    assert [tracks.frame for tracks in found] == list(range(30))
    assert [tracks.time for tracks in found] == pytest.approx([k / 10 for k in range(30)])
    seen = [tracks for tracks in found if len(tracks)]
    assert len(seen) > 15 and {tracks.ids.tolist()[0] for tracks in seen} == {1}
    last = seen[-1]
    assert np.abs(last.boxes[0] - [8 + 3 * last.frame, 24, 16, 40]).max() < 8
    assert last.image.shape == (96, 128, 3) and last.to_numpy().shape == (1, 8)
    np.testing.assert_allclose(last.corners[:, 2:], last.boxes[:, :2] + last.boxes[:, 2:])


def test_a_source_too_short_for_its_background_is_said(tmp_path):
    with pytest.warns(UserWarning, match=r"for the background span 1\.7 s"):
        list(servotrack.track(write_walk(tmp_path / "v.avi", 17)))
    with warnings.catch_warnings(record=True) as said:
        list(servotrack.track(tmp_path / "v.avi", background=0))
    assert not any("for the background" in str(one.message) for one in said)


def test_the_command_and_the_loop_agree(tmp_path):
    path = write_walk(tmp_path / "v.avi")
    request = TrackRequest(
        SourceRequest(str(path), background=5), tmp_path / "out", video=False, formats=("csv", "coco")
    )
    assert run_command(request, Console(quiet=True)) == 0
    found = list(servotrack.track(path, background=5))
    assert servotrack.write_tracks(found, tmp_path / "loop.txt") > 0
    assert (tmp_path / "loop.txt").read_text() == (tmp_path / "out" / "tracks.txt").read_text()
    assert json.loads((tmp_path / "out" / "tracks.json").read_text())["images"][3] == {
        "id": 3, "frame_id": 3, "file_name": "000004.jpg", "width": 128, "height": 96,
    }  # fmt: skip


def test_every_format_holds_the_same_rows(tmp_path):
    tracker = servotrack.Tracker("no-filter")
    found = [tracker.update([[5.0 * k, 1, 2, 3, 0.5], [50, 60, 7, 8, 0.25]], time=0.1 * k) for k in range(3)]
    counts = {
        name: servotrack.write_tracks(found, tmp_path / name, (100, 80))
        for name in ("a.csv", "a.jsonl", "a.json", "a.txt")
    }
    assert set(counts.values()) == {6}
    with (tmp_path / "a.csv").open() as file:
        table = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert lines == table == [row for tracks in found for row in tracks.rows()]
    coco = json.loads((tmp_path / "a.json").read_text())
    assert [(one["image_id"], one["track_id"], *one["bbox"]) for one in coco["annotations"]] == [
        (row["frame"], row["id"], row["left"], row["top"], row["width"], row["height"]) for row in table
    ]
    recorded = read_tracks(tmp_path / "a.txt")
    assert sum(len(track.steps) for track in recorded.tracks) == 6
    with pytest.raises(ValueError, match=r"path must end in \.csv, \.jsonl, \.txt, \.json, got 'a\.xml'"):
        servotrack.write_tracks(found, "a.xml")


def test_boxes_of_other_packages_are_taken():
    corners = np.array([[10.0, 20, 30, 60], [50, 60, 70, 90]])
    theirs = SimpleNamespace(xyxy=corners, confidence=np.array([0.9, 0.4]))
    found = as_detections(theirs)
    np.testing.assert_array_equal(found.boxes, [[10, 20, 20, 40], [50, 60, 20, 30]])
    assert found.confidences.tolist() == [0.9, 0.4]
    same = as_detections(np.column_stack([found.boxes, found.confidences]))
    np.testing.assert_array_equal(same.boxes, found.boxes)
    assert same.confidences.tolist() == [0.9, 0.4] and as_detections(found) is found
    assert len(as_detections([]).boxes) == len(as_detections(np.zeros((0, 5))).boxes) == 0
    assert as_detections(found.boxes, features=np.eye(2)).features.shape == (2, 2)
    for wrong, message in (([[1, 2, 3]], r"shape \(k, 4\)"), ([[1, 2, 3, np.nan]], "must be finite")):
        with pytest.raises(ValueError, match=message):
            as_detections(wrong)
    with pytest.raises(ValueError, match=r"features must be finite with shape \(2, F\), got \(1, 2\)"):
        as_detections(found.boxes, features=np.ones((1, 2)))


def test_results_for_other_packages(monkeypatch):
    tracks = servotrack.Tracker("no-filter").update([[1.0, 2, 3, 4]])
    supervision = SimpleNamespace(Detections=lambda **values: values)
    monkeypatch.setitem(sys.modules, "supervision", supervision)
    assert tracks.to_supervision()["xyxy"].tolist() == [[1, 2, 4, 6]]
    assert tracks.to_supervision()["tracker_id"].tolist() == [1]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pandas is not installed: pip install pandas"):
        tracks.to_pandas()


class Huge:
    """Reports detections under the labels 2^40, 2^40 + 7, ..., and notes how often it was stepped."""

    def __init__(self) -> None:
        self.steps = 0

    def initial(self, detections: Detections) -> int:
        return 0

    def step(self, state: int, detections: Detections) -> tuple[int, SetEstimate]:
        self.steps += 1
        k = len(detections.boxes)
        none = np.zeros(0, np.int64)
        return state, SetEstimate(
            detections.boxes, 2**40 + 7 * np.arange(k), np.ones(k), np.zeros((k, 4, 4)), np.array(float(k)), none,
            np.zeros((0, 4)), np.zeros(0),
        )  # fmt: skip


class Clocked(Huge):
    """The same with time."""

    def step(self, state: int, detections: Detections, dt: float | None = None) -> tuple[int, SetEstimate]:
        self.passed = dt
        return super().step(state, detections)


def test_identities_are_small_numbers():
    timed = TimedTracker(Huge(), 10.0)
    assert timed.step(detections_from_boxes([BOX, BOX + 50])).labels.tolist() == [1, 2]
    assert timed.step(detections_from_boxes([BOX])).labels.tolist() == [1]
    tracker = servotrack.Tracker("gm-phd-paper")
    ids = [tracker.update([BOX + 3 * k * RIGHT]).ids.tolist() for k in range(20)]
    assert max(identity for one in ids for identity in one) <= 20


def test_trackers_are_told_the_time_or_given_empty_frames():
    plain, clocked = Huge(), Clocked()
    assert not takes(plain, "dt") and takes(clocked, "dt")
    nothing = detections_from_boxes([])
    for tracker in (plain, clocked):
        timed = TimedTracker(tracker, 10.0)
        for time in (5.0, 5.1, 5.4, 5.5):
            timed.step(nothing, time)
            if time == 5.4 and tracker is clocked:
                assert tracker.passed == pytest.approx(0.3)
    assert ((plain.steps, clocked.steps) == (6, 4) and clocked.passed is None) or clocked.passed == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"time must be a finite number and after .*, 5\.5, got 5\.5"):
        timed.step(nothing, 5.5)
    # Nothing is kept over minutes.
    TimedTracker(plain, 10.0).step(nothing, 0.0)
    before = plain.steps
    timed = TimedTracker(plain, 10.0)
    timed.step(nothing, 0.0)
    timed.step(nothing, 1e6)
    assert plain.steps - before <= 602


def test_dropped_frames_keep_the_identity():
    tracker = servotrack.Tracker("kalman-hungarian", frame_rate=10.0, frame_size=(400, 200))
    ids = [
        tracker.update([BOX + 3 * k * RIGHT], time=k / 10).ids.tolist()
        for k in range(60)
        if k not in (20, 21, 40, 41, 42)
    ]
    assert {tuple(one) for one in ids[5:]} == {(1,)}


def test_parameters_reach_the_tracker(tmp_path):
    tracker = servotrack.Tracker("kalman-hungarian", confirm=7)
    assert isinstance(tracker._timed.tracker, KalmanHungarian) and tracker._timed.tracker.confirm == 7
    with pytest.raises(ValueError, match="'confrim' leads nowhere"):
        servotrack.Tracker("kalman-hungarian", confrim=7)
    with pytest.raises(AttributeError, match="no attribute 'trakc'"):
        _ = servotrack.trakc


def command(monkeypatch, *arguments: str) -> int:
    from servotrack import __main__ as command_line

    monkeypatch.setattr(sys, "argv", ["servotrack", "track", *arguments])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    return ended.value.code or 0


def test_command_takes_several_sources_and_parameters(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("a.avi", "b.avi"):
        write_walk(tmp_path / name, 20)
    options = [
        "--no-video",
        "--background",
        "5",
        "--tracker",
        "kalman-hungarian",
        "--set",
        "confirm=2",
        "--tracks",
        "csv,jsonl",
    ]
    assert command(monkeypatch, "a.avi", "b.avi", "--out", "out", *options) == 0
    names = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert names == {f"{k}/{name}" for k in "ab" for name in ("track.json", "tracks.csv", "tracks.jsonl", "tracks.txt")}
    assert (tmp_path / "out/a/tracks.csv").read_text().startswith("frame,time,id,left,top,width,height,existence\n")
    capsys.readouterr()
    for wrong, message in (
        (["a.avi", "a.avi"], "sources must have different names"),
        (["a.avi", "--set", "confirm"], "--set takes NAME=NUMBER, got 'confirm'"),
        (["a.avi", "--set", "confirm=many"], "--set takes NAME=NUMBER"),
        (["a.avi", "--set", "confirm=1", "--set", "confirm=2"], "confirm is given twice"),
        (["a.avi", "--tracks", "xml"], "formats must be of csv, jsonl, coco, got 'xml'"),
        (["a.avi", "b.avi", "--truth", "t.txt"], "--truth is of one source"),
        (["ftp://host/a.avi"], "addresses begin with http, https, rtsp, rtsps"),
    ):
        assert command(monkeypatch, *wrong, "--no-video") == 2
        assert message in capsys.readouterr().err


@pytest.fixture
def web(tmp_path) -> Iterator[str]:
    """Address of a server of a folder."""
    write_walk(tmp_path / "v.avi", 12)
    (tmp_path / "list.m3u8").write_text("#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nv.avi\n#EXT-X-ENDLIST\n")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    handler.log_message = lambda *arguments: None  # type: ignore[attr-defined]
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_addresses_are_read_from_their_first_frame_and_no_other_scheme(web):
    frames = list(open_frames(f"{web}/v.avi").numbered())
    assert [frame.number for frame in frames] == list(range(12))
    assert [frame.number for frame in open_frames(f"{web}/v.avi", start=2, stride=4).numbered()] == [2, 6, 10]
    for address in (f"{web}/list.m3u8", f"{web}/nothing.avi", web.replace("http", "https")):
        with pytest.raises(SequenceError, match=r"127\.0\.0\.1.* cannot be opened: no answer, no video, or a playlist"):
            open_frames(address)
    with pytest.raises(SequenceError, match=r"^(?!.*secret).*cannot be opened"):
        open_frames(web.replace("http://", "rtsp://user:secret@") + "/v.avi?token=secret")
    with pytest.raises(SequenceError, match=r"source file://\.\.\. cannot be opened: addresses begin with http"):
        open_frames("file:///etc/passwd")


def test_names_of_results_hold_no_password():
    assert folder_name("rtsp://user:secret@camera.local:554/street/1?key=secret") == "camera.local-554-street-1"
    assert folder_name("clips/walk.avi") == "walk" and folder_name("3") == "3"


def test_notes_of_one_kind_are_said_once() -> None:
    new = NewNotes()
    assert new.of(["no frame rate"]) == ["no frame rate"]
    assert new.of(["no frame rate", "from frame 3 on: covers 43 % (1 frames)"]) == [
        "from frame 3 on: covers 43 % (1 frames)"
    ]
    assert new.of(["frames 3, 4 are missing", "no frame rate", "from frame 3 on: covers 51.5 % (20 frames)"]) == [
        "frames 3, 4 are missing"
    ]


def test_the_loop_warns_when_the_camera_moves(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    wide = sum(cv2.GaussianBlur(rng.normal(0.0, 100.0 * size, (144, 500, 3)), (0, 0), float(size)) for size in (3, 12))
    world = np.clip(120.0 + np.asarray(wide), 20, 220)
    for k in range(50):
        left = 3 * max(k - 10, 0)
        noisy = world[:, left : left + 192] + rng.normal(0.0, 3.0, (144, 192, 3))
        cv2.imwrite(str(tmp_path / f"{k:03}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
    with pytest.warns(UserWarning, match="the camera moves by about") as said:
        frames = list(servotrack.track(tmp_path, background=0))
    assert len(frames) == 50 and not any(len(frame) for frame in frames[40:])
    assert sum("camera moves" in str(warning.message) for warning in said) == 1


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        ({"detections": [["a", "b", "c", "d"]]}, "detections must be real numbers"),
        ({"detections": np.ones((1, 4), np.complex128)}, "detections must be real numbers"),
        ({"detections": [[1.0], [1.0, 2.0]]}, "detections"),
        ({"detections": SimpleNamespace(xyxy="abc")}, "detections.xyxy must be real numbers"),
        ({"detections": SimpleNamespace(xyxy=np.zeros(3))}, r"detections.xyxy must have shape \(k, 4\)"),
        ({"detections": [BOX], "features": [["a"]]}, "features must be real numbers"),
        ({"detections": [BOX], "confidences": [np.nan]}, "confidences must be finite"),
        ({"detections": [BOX], "time": "x"}, "time must be real numbers"),
        ({"detections": [BOX], "time": 0.5}, "time must be a finite number and after"),
        ({"detections": [BOX], "time": 9.0, "motion": np.zeros((2, 3))}, "motion must keep areas"),
    ],
)
def test_refused_frames_change_nothing(bad, name):
    trackers = [servotrack.Tracker(frame_rate=10.0) for _ in range(2)]
    for tracker in trackers:
        tracker.update([BOX], time=1.0)
    with pytest.raises(ValueError, match=name):
        trackers[0].update(**bad)
    found, wanted = (tracker.update([BOX], time=1.1) for tracker in trackers)
    assert (found.frame, found.time) == (wanted.frame, wanted.time)
    np.testing.assert_array_equal(found.existence, wanted.existence)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"frame_size": 5}, "frame_size"),
        ({"frame_size": (5, np.nan)}, "frame_size"),
        ({"birth": "many"}, "birth must be a number"),
        ({"frame_rate": np.nan}, "frame_rate"),
    ],
)
def test_parameters_of_a_tracker_are_checked(arguments, name):
    with pytest.raises(ValueError, match=name):
        servotrack.Tracker(**arguments)
