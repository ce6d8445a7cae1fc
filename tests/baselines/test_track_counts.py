"""Counts of `servotrack track`: zones and lines from text, the file, the film, and refusals."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from servotrack.__main__ import app
from servotrack.baselines.track_command.counts import COUNTS, Counter, check_places, parse_places
from servotrack.estimators.boxes import set_of_boxes
from servotrack.estimators.rfs.sets import SetEstimate

FRAMES, SIZE = 60, (128, 96)


def walker(k: int) -> SetEstimate:
    box = np.array([[2.0 * k, 20.0, 16.0, 40.0]])
    return set_of_boxes(box, np.zeros((1, 4, 4)), np.array([1]), np.array([0.9]))


def clip(folder: Path) -> Path:
    """Two bright people who walk to the right and one who walks to the left, on a dark ground."""
    path = folder / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    rng = np.random.default_rng(0)
    for k in range(FRAMES):
        frame = rng.integers(0, 30, (SIZE[1], SIZE[0], 3), np.uint8)
        for x, y in ((2 * k - 10, 8), (2 * k + 18, 52), (115 - 2 * k, 30)):
            cv2.rectangle(frame, (x, y), (x + 7, y + 20), (230, 230, 230), -1)
        writer.write(frame)
    writer.release()
    return path


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["track", *arguments])
    return done.exit_code, done.output + (str(done.exception) if done.exception else "")


def test_places_count_who_is_in_them_and_who_crosses() -> None:
    counter = Counter(parse_places(["left=0,0,60,0,60,96,0,96"], ["64,0,64,96"], missed=0.0))
    seen = []
    for k in range(50):
        seen.append({(name, what): count.expected for name, what, count in counter.step(k, walker(k))})
    assert seen[0]["left", "people"] == seen[0]["frame", "people"] == pytest.approx(0.9)
    assert seen[-1]["left", "people"] == 0.0
    assert seen[-1]["line 1", "forward"] + seen[-1]["line 1", "backward"] == pytest.approx(0.9)
    rows = {(row[0], row[1].split(",")[0]): row[2:] for row in counter.grid().rows}
    assert rows["left", "most people"] == ["0.9", "0 to 1"]
    assert rows["line 1", "backward"] == ["0.9", "0 to 1"]
    shares = Counter(parse_places([], ["64,0,64,96"], missed=1.0))
    for k in range(50):
        found = shares.step(k, walker(k))
    assert max(count.expected for place, _, count in found if place == "line 1") == pytest.approx(1.8)


@pytest.mark.parametrize(
    ("zones", "lines", "says"),
    [
        (["0,0,9,0"], [], "zone 1: corners"),
        (["0,0,9,0,9"], [], "--zone takes"),
        (["a,b,c"], [], "--zone takes"),
        (["0,0,nan,0,9,9"], [], "zone 1: corners"),
        ([], ["0,0,9,9,5,5"], "two points"),
        ([], ["3,3,3,3"], "line 1: start and end"),
        ([], ["a=0,0,9,9", "a=0,9,9,0"], "'a' twice"),
        (["a=0,0,9,0,9,9"], ["a=0,0,9,9"], "'a' twice"),
        (["frame=0,0,9,0,9,9"], [], "'frame' twice"),
        ([], ["x,y=0,0,9,9"], "printable"),
        ([], ["=0,0,9,9"], "printable"),
    ],
)
def test_places_that_cannot_be_are_refused(zones: list[str], lines: list[str], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        parse_places(zones, lines)


def test_a_place_outside_the_frame_is_refused() -> None:
    check_places(parse_places(["-5,-5,30,0,30,30"], ["0,0,128,96"]), SIZE)
    with pytest.raises(ValueError, match=r"door lies outside the frame of 128x96 px, its y is from 97 to 99"):
        check_places(parse_places([], ["door=0,97,9,99"]), SIZE)


def test_the_command_writes_counts_beside_the_tracks(tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, text = run(
        str(clip(tmp_path)), "--out", str(out), "--size", "source", "--line", "gate=64,96,64,0", "--missed", "0",
        "--zone", "0,0,64,0,64,96,0,96",
    )  # fmt: skip
    assert code == 0, text
    with (out / COUNTS).open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * FRAMES
    last = {(row["place"], row["count"]): (int(row["low"]), int(row["high"])) for row in rows[-4:]}
    assert last["gate", "forward"][0] <= 2 <= last["gate", "forward"][1]
    assert last["gate", "backward"][0] <= 1 <= last["gate", "backward"][1]
    assert "most people" in text and str(out / COUNTS) in text.replace("\n", "")
    code, text = run(str(tmp_path / "walk.avi"), "--out", str(out), "--no-video")
    assert code == 0 and not (out / COUNTS).exists(), text


def test_options_of_counts_are_refused_without_counts(tmp_path: Path) -> None:
    code, text = run(str(clip(tmp_path)), "--missed", "0.2")
    assert code != 0 and "--count" in text
    code, text = run(str(tmp_path / "walk.avi"), "--line", "500,0,500,9", "--out", str(tmp_path / "o"))
    assert code != 0 and "outside the frame" in text and not (tmp_path / "o").exists()
