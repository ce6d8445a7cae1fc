"""Search and calibration of the default tracker of people, on a sequence that the test makes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servotrack.baselines.tuning.people_calibration import calibration_error, fit_odds, judge
from servotrack.baselines.tuning.people_search import Kind, candidates, comparison, default_values, objective
from servotrack.baselines.tuning.people_sequences import (
    PeopleSequence,
    at_half_rate,
    read_sequence,
    reversed_in_time,
    score,
)
from servotrack.envs.track.files.mot_files import SequenceInfo, mot_row, truth_row, write_seqinfo
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.boxes import RawDetections
from servotrack.estimators.boxes.person import person_probabilities


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> PeopleSequence:
    """Two walkers with good scores among false detections with bad ones."""
    folder: Path = tmp_path_factory.mktemp("walk")
    (folder / "det").mkdir()
    (folder / "gt").mkdir()
    rng = np.random.default_rng(0)
    truth, detections = [], []
    for k in range(60):
        boxes = [[50.0 + 3.0 * k, 100.0, 30.0, 90.0], [400.0 - 3.0 * k, 120.0, 32.0, 96.0]]
        truth += [truth_row(k + 1, i + 1, box, True, 1.0) for i, box in enumerate(boxes)]
        false = [[*rng.uniform([0.0, 200.0], [600.0, 380.0]), 30.0, 90.0] for _ in range(2)]
        detections += [mot_row(k + 1, -1, box, rng.uniform(0.9, 0.99)) for box in boxes]
        detections += [mot_row(k + 1, -1, box, rng.uniform(0.3, 0.7)) for box in false]
    (folder / "gt" / "gt.txt").write_text("".join(truth))
    (folder / "det" / "det.txt").write_text("".join(detections))
    write_seqinfo(folder / "seqinfo.ini", SequenceInfo("walk", "img1", 20.0, 60, 640, 480))
    read = read_sequence(str(folder))
    assert read_sequence(f"walk={folder}/det/det.txt,{folder}/gt/gt.txt,20").frames[7].boxes.shape == (4, 4)
    return read


def test_a_sequence_and_its_variants_have_the_same_people(sequence: PeopleSequence) -> None:
    assert (sequence.name, sequence.frame_rate, sequence.frame_size) == ("walk", 20.0, (640, 480))
    assert len(sequence.frames) == 60
    half, back = at_half_rate(sequence), reversed_in_time(sequence)
    assert (len(half.frames), half.frame_rate) == (30, 10.0)
    assert np.array_equal(half.truth[0].states, sequence.truth[0].states[::2])
    assert np.array_equal(back.truth[0].states[::-1], sequence.truth[0].states)
    found = [score(RawDetections(), one).misses for one in (sequence, half, back)]
    assert found == [0, 0, 0]
    with pytest.raises(SequenceError, match="NAME=DETECTIONS,TRUTH,RATE"):
        read_sequence("walk=a,b")


def test_the_default_beats_kalman_and_hungarian_among_false_detections(sequence: PeopleSequence) -> None:
    kinds = [Kind("walk", [sequence])]
    table = comparison(kinds, ["pmb", "kalman-hungarian"])
    hota = [float(row[1].split(" / ")[0]) for row in table.rows]
    assert table.headings == ["tracker", "walk", "mean"]
    assert hota[0] >= hota[1] > 50.0


def test_candidates_begin_with_the_default_and_the_worst_sequence_counts() -> None:
    settings = candidates(5, 1.0, seed=3)
    assert settings[0] == default_values()
    assert all(one != settings[0] for one in settings[1:])
    assert settings == candidates(5, 1.0, seed=3)
    even, uneven = np.full((2, 3), 1.0), np.array([[3.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
    assert even.mean() == uneven.mean()
    assert objective(even) > objective(uneven)


def test_stated_probabilities_are_compared_with_frequencies(sequence: PeopleSequence) -> None:
    stated = np.array([0.95, 0.95, 0.95, 0.95, 0.15, 0.15])
    assert calibration_error(stated, np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), np.ones(6)) == pytest.approx(
        (4 * 0.2 + 2 * 0.15) / 6
    )
    judged = judge(sequence)
    assert judged.person.sum() >= 110
    odds = fit_odds([judged, judged])
    chance = person_probabilities(odds, judged.evidence)
    assert chance[judged.person].mean() > 0.9
    assert chance[~judged.person].mean() < 0.3
