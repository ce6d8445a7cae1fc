"""`servotrack track recording.wav` and the readers of recordings."""

from __future__ import annotations

import csv
import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile
from typer.testing import CliRunner

from servotrack.__main__ import app
from servotrack.baselines.track_command import swellex96
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.files.recordings import read_bearing_truth, read_positions, read_recording, read_sio

sys.path.insert(0, str(Path(__file__).parents[1] / "estimators"))
from hydrophones import recording

RATE, SECONDS = 1600, 24
ANGLE = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
PLACES = 4.0 * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])
PATH = 60.0 + np.arange(SECONDS)


@pytest.fixture(scope="module")
def sound() -> np.ndarray:
    x = recording(np.random.default_rng(0), PLACES, RATE, SECONDS, [(PATH, 0.6, None)])
    return np.clip(2000.0 * x, -32768, 32767).astype(np.int16)


@pytest.fixture
def files(tmp_path: Path, sound: np.ndarray) -> Path:
    wavfile.write(tmp_path / "sound.wav", RATE, sound)
    np.savetxt(tmp_path / "positions.csv", PLACES, delimiter=",", header="x,y", comments="")
    rows = [f"{k + 0.5},ship,{bearing}" for k, bearing in enumerate(PATH)]
    (tmp_path / "truth.csv").write_text("time,id,bearing\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return tmp_path


def track(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["track", *map(str, arguments)])
    return result.exit_code, " ".join((result.output + str(result.exception or "")).split())


def write_sio(path: Path, x: np.ndarray, order: str = ">", record: int = 512) -> None:
    """Write samples as an SIO file: a record of header, then records of one channel after the other."""
    inside = record // x.dtype.itemsize
    turns = -(-len(x) // inside)
    padded = np.zeros((turns * inside, x.shape[1]), x.dtype)
    padded[: len(x)] = x
    blocks = padded.reshape(turns, inside, -1).transpose(0, 2, 1)
    real = int(x.dtype.kind == "f")
    numbers = (1, turns * x.shape[1], record, x.shape[1], x.dtype.itemsize, real, len(x), 32677)
    head = struct.pack(f"{order}8I", *numbers) + b"test".ljust(24) + b"comment".ljust(72)
    path.write_bytes(head.ljust(record, b"\0") + blocks.astype(x.dtype.newbyteorder(order)).tobytes())


@pytest.mark.parametrize("beamformer", ["conventional", "mvdr"])
def test_a_recording_is_tracked_and_scored(files: Path, beamformer: str) -> None:
    out = files / "out"
    code, text = track(
        files / "sound.wav", "--array", files / "positions.csv", "--band", "100,280", "--truth", files / "truth.csv",
        "--out", out, "--beamformer", beamformer,
    )  # fmt: skip
    assert code == 0, text
    with (out / "tracks.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["label"] for row in rows} == {"1"}
    for row in rows:
        true = np.interp(float(row["time"]), np.arange(SECONDS) + 0.5, PATH)
        assert abs(float(row["bearing"]) - true) < 5.0
    assert json.loads((out / "scores.json").read_text())["scores"]["ospa"] < 3.0
    assert (out / "tracks.png").stat().st_size > 10_000 and "1 tracks" in text
    # A second run without a truth takes the scores away.
    assert track(files / "sound.wav", "--array", files / "positions.csv", "--band", "100,280", "--out", out)[0] == 0
    assert not (out / "scores.json").exists()


def test_numpy_and_sio_give_the_same_samples(tmp_path: Path, sound: np.ndarray) -> None:
    np.save(tmp_path / "sound.npy", sound)
    for order in "><":
        for x in (sound, sound.astype(np.float32), sound.astype(np.int32)):
            write_sio(tmp_path / "sound.sio", x[:1000], order)
            assert np.array_equal(read_sio(tmp_path / "sound.sio"), x[:1000])
    assert np.array_equal(read_recording(tmp_path / "sound.npy", 1600.0).samples, sound)
    write_sio(tmp_path / "sound.sio", sound)
    assert read_recording(tmp_path / "sound.sio", 1600.0).rate == 1600.0


def test_swellex96_reads_its_files(tmp_path: Path, sound: np.ndarray) -> None:
    write_sio(tmp_path / "hla.sio", sound)
    lines = ["element\tx (m)\ty (m)", *(f"{i + 1}\t{x:.6f}\t{y:.6f}" for i, (x, y) in enumerate(PLACES))]
    (tmp_path / "positions.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    places = swellex96.read_table(tmp_path / "positions.txt")
    np.testing.assert_allclose(places, PLACES, atol=1e-6)
    np.testing.assert_allclose(swellex96.read_table(tmp_path / "positions.txt", (3, 2)), PLACES[:, ::-1], atol=1e-6)
    arguments = [tmp_path / "hla.sio", tmp_path / "positions.txt", "--rate", RATE, "--band", "100,280"]
    swellex96.main([*map(str, arguments), "--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "tracks.csv").read_text().count("\n") > 15
    with pytest.raises(SystemExit):
        swellex96.main([*map(str, arguments), "--columns", "2", "--out", str(tmp_path / "out")])


@pytest.mark.parametrize("text", ["", "1 2\n2 3\n", "a b c\n", "1 0 0\n"])
def test_swellex96_names_bad_tables(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.txt").write_text(text, encoding="utf-8")
    with pytest.raises(SequenceError, match=r"p\.txt"):
        swellex96.read_table(tmp_path / "p.txt")


def test_bad_recordings_are_named(files: Path, sound: np.ndarray) -> None:
    whole = (files / "sound.wav").read_bytes()
    cases = {
        "missing.wav": (None, "does not exist"),
        "empty.wav": (b"", "is empty"),
        "cut.wav": (whole[: len(whole) // 2], "truncated|can be read"),
        "head.wav": (whole[:30], "truncated|can be read"),
        "text.wav": (b"time,x,y\n0,1,2\n", "is no WAV file"),
        "text.npy": (b"hello", "whole and without objects"),
        "text.sio": (b"hello" * 100, "number 32677 at byte 28"),
    }
    for name, (content, message) in cases.items():
        if content is not None:
            (files / name).write_bytes(content)
        with pytest.raises(SequenceError, match=message):
            read_recording(files / name, 1600.0)
    write_sio(files / "cut.sio", sound)
    (files / "cut.sio").write_bytes((files / "cut.sio").read_bytes()[:-600])
    with pytest.raises(SequenceError, match="is truncated: its header names"):
        read_sio(files / "cut.sio")
    np.save(files / "objects.npy", np.array([{}], object))
    np.save(files / "cube.npy", np.zeros((2, 2, 2)))
    np.save(files / "none.npy", np.zeros((0, 12)))
    for name, message in (("objects", "whole and without objects"), ("cube", r"\(2, 2, 2\)"), ("none", "no samples")):
        with pytest.raises(SequenceError, match=message):
            read_recording(files / f"{name}.npy", 1600.0)
    np.save(files / "sound.npy", sound)
    with pytest.raises(SequenceError, match="give it with --rate"):
        read_recording(files / "sound.npy")
    with pytest.raises(SequenceError, match="positive sampling frequency, got 0 Hz"):
        read_recording(files / "sound.npy", 0.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must name the columns x, y"),
        ("a,b\n1,2\n", "got a,b"),
        ("x,y\n1,2\n", "at least two elements, got 1"),
        ("x,y\n1,2\n3,?\n", r"row 3: y must be a finite number, got '\?'"),
        ("x,y\n1,2\n3\n", "row 3 must have 2 columns"),
    ],
)
def test_bad_positions_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "p.csv").write_text(text, encoding="utf-8")
    with pytest.raises(SequenceError, match=message):
        read_positions(tmp_path / "p.csv")


def test_truth_is_linear_and_passes_zero(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("time,id,bearing\n0,a,350\n10,a,10\n4,b,90\n", encoding="utf-8")
    truth = read_bearing_truth(path, np.array([2.0, 4.0, 12.0]))
    assert truth.known.tolist() == [True, True, False]
    np.testing.assert_allclose(truth.bearings[0, :2], [354.0, 358.0])
    assert np.isnan(truth.bearings[1, 0]) and truth.bearings[1, 1] == 90.0
    with pytest.raises(SequenceError, match="must overlap"):
        read_bearing_truth(path, np.array([20.0, 30.0]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "needs --array positions.csv and --band LOW,HIGH"),
        (["--band", "100"], "needs --array"),
        (["--array", "positions.csv", "--band", "100"], "band must be LOW,HIGH in Hz"),
        (["--array", "positions.csv", "--band", "100,900"], "half the sampling frequency"),
        (["--array", "positions.csv", "--band", "100,280", "--beamformer", "x"], "beamformer must be one of"),
        (["--array", "positions.csv", "--band", "100,280", "--offline"], "--offline is for frames"),
        (["--array", "truth.csv", "--band", "100,280"], "must name the columns x, y"),
    ],
)
def test_bad_options_are_named(files: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], message: str) -> None:
    monkeypatch.chdir(files)
    code, text = track("sound.wav", *options)
    assert code != 0 and message in text


def test_options_of_sound_are_refused_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("time,x,y\n0,0,0\n1,1,1\n", encoding="utf-8")
    code, text = track(tmp_path / "points.csv", "--band", "100,200")
    assert code != 0 and "--band is for recordings" in text
