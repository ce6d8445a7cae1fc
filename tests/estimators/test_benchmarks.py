"""Scores by the rules of MOTChallenge and KITTI, against the reference implementation reading the same files."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest

from servotrack.baselines.track_command.scores import score_tracks
from servotrack.envs.track.files.labeled import read_labeled
from servotrack.envs.track.files.read import read_tracks
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.metrics import (
    BENCHMARKS,
    LabeledBoxes,
    benchmark_sequence,
    plain_boxes,
    sequence_scores,
)

pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning", "ignore:.*unclosed file")
DATA = Path(__file__).parents[3] / "shared" / "data"
SEQUENCES = ["TUD-Campus", "ADL-Rundle-6", "ETH-Sunnyday", "KITTI-13", "Venice-2"]
MOT = {"mot15": "MOT15", "mot16": "MOT16", "mot17": "MOT17", "mot20": "MOT20", "dancetrack": "MOT17"}
KITTI_NAMES = ["Pedestrian", "Person", "Car", "Van"]


def random_scene(seed: int) -> tuple[list[tuple], list[tuple], int]:
    """Return rows (frame, id, box, class, flag) of truth, rows (frame, id, box) of a tracker, and the length."""
    rng = np.random.default_rng(seed)
    length, people = int(rng.integers(1, 25)), int(rng.integers(0, 9))
    truth, found = [], []
    kinds = rng.choice([1, 1, 1, 2, 3, 6, 7, 8, 10, 12, 13], people)
    places, speeds = rng.uniform(0, 200, (people, 2)), rng.normal(0, 3, (people, 2))
    sizes = rng.uniform(15, 60, (people, 2))
    for frame in range(length):
        for k in rng.permutation(people).tolist():
            if rng.random() < 0.15:
                continue
            box = np.concatenate([places[k] + frame * speeds[k], sizes[k]])
            truth.append((frame, k + 1, box, int(kinds[k]), int(rng.random() < 0.85)))
            if rng.random() < 0.8:
                found.append((frame, 10 * k + 3 + frame // 12, box + rng.normal(0, 3, 4)))
        for k in range(int(rng.integers(0, 3))):
            found.append((frame, 1000 + k, rng.uniform([0, 0, 5, 5], [200, 200, 60, 60])))
    return truth, found, length


def _written(box: np.ndarray) -> str:
    return ",".join(repr(float(value)) for value in box)


def write_mot(folder: Path, truth: list[tuple], found: list[tuple], length: int) -> None:
    (folder / "gt").mkdir(parents=True, exist_ok=True)
    text = [
        f"{t + 1},{i},{','.join(map(repr, map(float, box)))},{flag},{kind},1.0\n" for t, i, box, kind, flag in truth
    ]
    (folder / "gt" / "gt.txt").write_text("".join(text))
    text = [f"{t + 1},{i},{_written(box)},1,-1,-1,-1\n" for t, i, box in found]
    (folder / "found.txt").write_text("".join(text))


def scores_of_reference(data: object, kind: str) -> dict[str, float]:
    with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
        metrics = pytest.importorskip("trackeval.metrics")
        data = data.get_preprocessed_seq_data(data.get_raw_seq_data("tracker", "s"), kind)
        clear = metrics.CLEAR({"PRINT_CONFIG": False}).eval_sequence(data)
        identity = metrics.Identity({"PRINT_CONFIG": False}).eval_sequence(data)
        hota = metrics.HOTA().eval_sequence(data)
    return {
        "mota": clear["MOTA"],
        "idf1": identity["IDF1"],
        "hota": float(np.mean(hota["HOTA"])),
        "identity_switches": clear["IDSW"],
        "false_positives": clear["CLR_FP"],
        "misses": clear["CLR_FN"],
    }


def mot_reference(folder: Path, gt: Path, found: Path, length: int, benchmark: str) -> dict[str, float]:
    datasets = pytest.importorskip("trackeval.datasets")
    tracks = folder / "trackers" / "tracker" / "data"
    tracks.mkdir(parents=True, exist_ok=True)
    (tracks / "s.txt").write_bytes(found.read_bytes())
    (folder / "truth" / "s" / "gt").mkdir(parents=True, exist_ok=True)
    (folder / "truth" / "s" / "gt" / "gt.txt").write_bytes(gt.read_bytes())
    config = {
        "GT_FOLDER": str(folder / "truth"), "TRACKERS_FOLDER": str(folder / "trackers"), "BENCHMARK": benchmark,
        "SEQ_INFO": {"s": length}, "SKIP_SPLIT_FOL": True, "PRINT_CONFIG": False, "TRACKERS_TO_EVAL": ["tracker"],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        return scores_of_reference(datasets.MotChallenge2DBox(config), "pedestrian")


def ours(truth_path: Path, found_path: Path, length: int, benchmark: str | None) -> dict[str, float]:
    found = read_tracks(found_path)
    return score_tracks(read_labeled(truth_path), found, range(max(length, 1)), benchmark=benchmark)._asdict()


def check_equal(mine: dict[str, float], reference: dict[str, float]) -> None:
    assert {name: mine[name] for name in reference} == pytest.approx(reference, abs=1e-9)


def check_random_mot(seed: int, benchmark: str, folder: Path) -> None:
    truth, found, length = random_scene(seed)
    if not truth or not found:
        return
    write_mot(folder, truth, found, length)
    gt, answers = folder / "gt" / "gt.txt", folder / "found.txt"
    check_equal(ours(gt, answers, length, benchmark), mot_reference(folder, gt, answers, length, MOT[benchmark]))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("benchmark", MOT)
def test_random_sequences_score_as_in_the_reference(tmp_path, seed, benchmark):
    check_random_mot(seed, benchmark, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("benchmark", MOT)
def test_many_random_sequences_score_as_in_the_reference(tmp_path, benchmark):
    for seed in range(100, 400):
        check_random_mot(seed, benchmark, tmp_path)


def write_kitti(folder: Path, seed: int) -> int:
    """Write truth and results in KITTI's format, with regions that are ignored; return the length."""
    rng = np.random.default_rng(seed)
    truth, found, length = random_scene(seed)
    kinds = [KITTI_NAMES[k] for k in rng.choice(4, 12, p=[0.5, 0.15, 0.25, 0.1])]
    lines, answers = [], []
    for t, i, box, _, _ in truth:
        levels = int(rng.choice([0, 0, 0, 0, 1])), int(rng.choice([0, 0, 1, 2, 3]))
        lines.append((t, i, kinds[i], *levels, box))
    for t in range(length):
        for _ in range(int(rng.integers(0, 3))):
            lines.append((t, -1, "DontCare", -1, -1, rng.uniform([0, 0, 30, 30], [200, 200, 120, 120])))
    for t, i, box in found:
        answers.append((t, i, "Car" if i < 1000 and kinds[i // 10] in ("Car", "Van") else "Pedestrian", 0, 0, box))

    def text(rows: list[tuple], rest: str) -> str:
        corners = [(row, [*row[5][:2], *(row[5][:2] + row[5][2:])]) for row in rows]
        return "".join(
            f"{r[0]} {r[1]} {r[2]} {r[3]} {r[4]} -10 {' '.join(map(repr, map(float, c)))} 1 1 1 0 0 0 0{rest}\n"
            for r, c in corners
        )

    (folder / "truth" / "label_02").mkdir(parents=True, exist_ok=True)
    (folder / "trackers" / "tracker" / "data").mkdir(parents=True, exist_ok=True)
    (folder / "truth" / "label_02" / "s.txt").write_text(text(lines, ""))
    (folder / "trackers" / "tracker" / "data" / "s.txt").write_text(text(answers, " 0.9"))
    (folder / "truth" / "evaluate_tracking.seqmap.training").write_text(
        f"s empty 000000 {length:06}\nt empty 000000 {length:06}\n"
    )
    (folder / "truth" / "label_02" / "t.txt").write_text("")
    (folder / "trackers" / "tracker" / "data" / "t.txt").write_text("")
    return length


def check_random_kitti(seed: int, kind: str, folder: Path) -> None:
    datasets = pytest.importorskip("trackeval.datasets")
    length = write_kitti(folder, seed)
    config = {
        "GT_FOLDER": str(folder / "truth"), "TRACKERS_FOLDER": str(folder / "trackers"), "CLASSES_TO_EVAL": [kind],
        "PRINT_CONFIG": False, "TRACKERS_TO_EVAL": ["tracker"],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        reference = scores_of_reference(datasets.Kitti2DBox(config), kind)
    truth = read_labeled(folder / "truth" / "label_02" / "s.txt")
    found = read_labeled(folder / "trackers" / "tracker" / "data" / "s.txt").boxes
    assert truth.benchmark == "kitti-pedestrian"
    check_equal(score_tracks(truth, found, range(length), benchmark=f"kitti-{kind}")._asdict(), reference)


def random_kitti_seeds(first: int, count: int) -> list[int]:
    return [seed for seed in range(first, first + 2 * count) if all(random_scene(seed)[:2])][:count]


@pytest.mark.parametrize("seed", random_kitti_seeds(0, 12))
@pytest.mark.parametrize("kind", ["pedestrian", "car"])
def test_random_kitti_sequences_score_as_in_the_reference(tmp_path, seed, kind):
    check_random_kitti(seed, kind, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pedestrian", "car"])
def test_many_random_kitti_sequences_score_as_in_the_reference(tmp_path, kind):
    for seed in random_kitti_seeds(100, 300):
        check_random_kitti(seed, kind, tmp_path)


def test_random_scenes_hold_what_the_rules_are_about():
    """Rules that never apply would be equal for nothing."""
    differ = set()
    for seed in range(12):
        truth, found, _ = random_scene(seed)
        if truth and found:
            labeled = LabeledBoxes(*(np.array(column) for column in zip(*truth, strict=True)))
            labeled = labeled._replace(counted=labeled.counted.astype(bool))
            answers = plain_boxes(*(np.array(column) for column in zip(*found, strict=True)))
            one, two, three = (
                sequence_scores(benchmark_sequence(labeled, answers, BENCHMARKS[name]))
                for name in ("mot15", "mot17", "mot20")
            )
            differ |= {"classes"} if one != two else set()
            differ |= {"vehicles"} if two != three else set()
    assert differ == {"classes", "vehicles"}


@pytest.mark.skipif(not DATA.is_dir(), reason="recordings of others, not part of the project")
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("benchmark", [None, "mot17", "mot20"])
def test_recorded_sequences_score_as_in_the_reference(tmp_path, name, benchmark):
    """The detections, linked at random; for rules with classes those are drawn, as in TUD-Campus with distractors."""
    rng = np.random.default_rng(0)
    rows = [line.split(",") for line in (DATA / name / "gt" / "gt.txt").read_text().split()]
    if benchmark is not None:
        kinds = {row[1]: str(rng.choice([1, 1, 8, 3, 6, 7])) for row in rows}
        rows = [[*row[:7], kinds[row[1]], "1"] for row in rows]
    (tmp_path / "gt.txt").write_text("".join(",".join(row) + "\n" for row in rows))
    length = max(int(row[0]) for row in rows)
    kept = []
    for line in (DATA / name / "det" / "det.txt").read_text().split():
        frame, _, *rest = line.split(",")
        if int(frame) <= length:
            kept.append([frame, str(len(kept) % 40 + 40 * int(frame)), *rest[:4], "1", "-1", "-1", "-1"])
    for row in kept:
        # Tracks of ten frames.
        row[1] = str(int(row[1]) % 40 + 40 * (int(row[0]) // 10))
    seen: set[tuple[str, str]] = set()
    kept = [row for row in kept if not ((row[0], row[1]) in seen or seen.add((row[0], row[1])))]
    (tmp_path / "found.txt").write_text("".join(",".join(row) + "\n" for row in kept))
    gt, found = tmp_path / "gt.txt", tmp_path / "found.txt"
    reference = mot_reference(tmp_path, gt, found, length, MOT[benchmark or "mot15"])
    check_equal(ours(gt, found, length, benchmark), reference)
    assert reference["misses"] > 0 and reference["identity_switches"] > 0


def test_answers_on_distractors_neither_help_nor_hurt(tmp_path):
    walker = [(t, 1, np.array([10.0 + t, 20.0, 20.0, 50.0]), 1, 1) for t in range(10)]
    static = [(t, 2, np.array([100.0, 20.0, 20.0, 50.0]), 7, 1) for t in range(10)]
    car = [(t, 3, np.array([200.0, 20.0, 60.0, 50.0]), 3, 1) for t in range(10)]
    found = [(t, i, box) for t, i, box, _, _ in [*walker, *static, *car]]
    write_mot(tmp_path, [*walker, *static, *car], found, 10)
    scores = ours(tmp_path, tmp_path / "found.txt", 10, None)
    # The car is no distractor.
    assert (scores["misses"], scores["false_positives"], scores["mota"]) == (0, 10, 0.0)
    assert ours(tmp_path, tmp_path / "found.txt", 10, "mot15")["mota"] == 1.0


def test_form_of_the_file_tells_the_benchmark(tmp_path):
    rows = [(0, 1, np.array([10.0, 20.0, 20.0, 50.0]), 8, 1)]
    write_mot(tmp_path / "MOT20-09", rows, [], 1)
    write_mot(tmp_path / "Street", rows, [], 1)
    assert read_labeled(tmp_path / "MOT20-09").benchmark == "mot20"
    assert read_labeled(tmp_path / "Street").benchmark == "mot17"
    (tmp_path / "old.txt").write_text("1,1,2,3,4,5,1,-1,-1,-1\n")
    assert read_labeled(tmp_path / "old.txt").benchmark == "mot15"
    # Distractors are seen by nobody, other classes are no people.
    (tmp_path / "gt.txt").write_text("1,1,2,3,4,5,1,1,0.5\n1,2,2,3,4,5,1,8,1\n1,3,2,3,4,5,1,3,1\n")
    tracks = read_tracks(tmp_path / "gt.txt")
    assert tracks.ids.tolist() == [1, 2] and [share.tolist() for share in tracks.visibilities] == [[0.5], [0.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 Pedestrian 0 0 0 1 2 3\n", "must have 10 to 18 columns, got 9"),
        ("0 1 Pedestrian 0 0 0 1 2 3 4\n0 1 Dog 0 0 0 1 2 3 4\n", "line 2: class must be one of"),
        ("0 1 Pedestrian 0 0 0 5 2 3 4\n", "width and height must be at least 0"),
        ("0 1 Pedestrian 0 nan 0 1 2 3 4\n", "columns must be numbers"),
        ("0 1 Pedestrian 0 0 0 1 2 3 4\n0 1 Pedestrian 0 0 0 1 2 3 4\n", "id 1 is in this frame already"),
    ],
)
def test_bad_labels_of_kitti_are_named(tmp_path, text, message):
    (tmp_path / "0000.txt").write_text(text)
    with pytest.raises(SequenceError, match=message):
        read_labeled(tmp_path / "0000.txt")


def test_classes_of_another_benchmark_are_refused():
    boxes = plain_boxes(np.zeros(1, np.int64), np.ones(1, np.int64), np.ones((1, 4)), kind=14)
    with pytest.raises(ValueError, match="classes of the truth must be those of MOT17, 1 to 13, got 14; choose"):
        benchmark_sequence(boxes, boxes, BENCHMARKS["mot17"])
