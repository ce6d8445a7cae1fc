"""The gm_phd_video reproduction: from frames to counts, scores, claims and figures, on short sequences."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import spearmanr

from servotrack.baselines.agents.people.catalog import create_detector
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers import reproduce, sequences, transfer
from servotrack.baselines.papers.boxes import Effect, Rule, summarize_box
from servotrack.baselines.papers.claims import Finding, fill, read_claims
from servotrack.baselines.papers.gm_phd_video import (
    alternatives,
    box,
    events,
    experiment,
    readings,
    readings_report,
    report,
)
from servotrack.baselines.papers.gm_phd_video.experiment import Method, Outcome, count_right, run_methods
from servotrack.baselines.papers.gm_phd_video.figures import draw_counts
from servotrack.baselines.papers.request import Recording
from servotrack.estimators.metrics import Track


def outcome(counts: list[int]) -> Outcome:
    return Outcome(np.array(counts), [], 1e-3, 1e-4)


def test_a_count_is_right_only_where_it_is_equal_and_only_the_first_frames_count() -> None:
    assert count_right(outcome([1, 2, 0, 5]), np.array([1, 1, 0, 5])) == 0.75
    assert count_right(outcome([1, 9, 9, 9]), np.array([1, 1, 1, 1]), frames=1) == 1.0


def test_methods_share_a_detector_and_answer_every_frame() -> None:
    frames = np.full((8, 60, 80, 3), 90, np.uint8)
    for k in range(2, 8):
        frames[k, 15:45, 10 + 5 * k : 20 + 5 * k] = 220
    methods = {"raw": Method("masked", "no-filter"), "kalman": Method("masked", "kalman-hungarian")}
    found = run_methods(iter(frames), (80, 60), 25.0, methods)
    assert found["raw"].counts.tolist() == [0, 0, 1, 1, 1, 1, 1, 1]
    assert len(found["kalman"].counts) == 8 and found["kalman"].detection_seconds == found["raw"].detection_seconds
    with pytest.raises(ValueError, match="at least one frame"):
        run_methods(iter(()), (80, 60), 25.0, methods)


def test_the_rendered_sequence_tells_the_truth_of_the_frames_it_gave() -> None:
    sequence = sequences.rendered(7, script=sequences.SCRIPT, horizon=60)
    shown = list(sequence.frames)
    assert len(shown) == 60 and shown[0].shape == (288, 384, 3)
    assert sequence.numbers.tolist() == [0] * 49 + [1] * 11
    (person,) = sequence.truth
    assert person.steps[0] >= 49 and person.steps[-1] == 59


KINDS_PER_SEQUENCE = np.array([5.0, 1.0, 1.0, 4.0])


def invented_rows(trackers: Iterable[str], right: dict[str, float], one_merge: float = 1.0) -> list[dict[str, Any]]:
    """Results of sequences in which every tracker counts equally well, with little differences between them.

    Where two who merge are one target, every tracker handles the share `one_merge` of the merges.
    """
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(12):
        row: dict[str, Any] = {"happened": KINDS_PER_SEQUENCE}
        for name in trackers:
            kept = name.endswith(readings.UNPRUNED)
            row[f"{name}|seconds"] = 1e-3 * (10.0 if name == box.PARTICLES or kept else 1.0) * rng.uniform(0.9, 1.1)
            for merged in (box.TWO, box.ONE):
                share = one_merge if merged == box.ONE else 1.0
                row |= {
                    f"{name}|right|{merged}": right.get(name.split("/")[0], 0.9) + 0.001 * rng.standard_normal(),
                    f"{name}|extra|{merged}": 0.1 * kept + 0.001 * rng.standard_normal(),
                    f"{name}|handled|{merged}": KINDS_PER_SEQUENCE * [1.0, share, 1.0, 1.0],
                    f"{name}|near|{merged}": 0.7,
                }
        rows.append(row)
    return rows


def invented_alternatives(right: dict[str, float]) -> box.AlternativesBox:
    made = box.AlternativesBox.__new__(box.AlternativesBox)
    made._rows = invented_rows(box._alternatives((384, 288))[1], right)
    return made


def invented_readings(right: dict[str, float], one_merge: float = 1.0) -> readings.ReadingsBox:
    made = readings.ReadingsBox.__new__(readings.ReadingsBox)
    made._rows = invented_rows(readings.trackers(), right, one_merge)
    return made


def verdicts(findings: list[Finding]) -> dict[str, str]:
    refilled = read_claims(replaced={finding.id for finding in findings})
    return {claim.id: claim.verdict for claim in fill(refilled, findings, report.COMMAND)}


def test_claims_follow_the_measurements() -> None:
    rng = np.random.default_rng(0)
    slopes = (Effect(0.9, 0.8, 1.0, "log/log", "slope", 12),)

    def measured(switches: float, merges: float = 0.0) -> report.Measured:
        noise = 0.01 * rng.standard_normal(12)
        rest = [np.full(12, 0.9)] * 3
        happened = np.tile(KINDS_PER_SEQUENCE, (12, 1))
        times = [np.full(12, 1e-3)] * 2
        return report.Measured(
            0.95 + noise, *rest, switches + noise, *times, happened * [1.0, merges, 1.0, 1.0], happened
        )

    found = {name: measured(3.0) for name in experiment.METHODS}
    found[report.TUNED] = measured(1.0)
    first = verdicts(report.findings(found, invented_alternatives({"unmasked": 0.8}), slopes))
    assert first["phd-video-identity"] == first["phd-video-linear-cost"] == first["phd-video-masked-update"] == "holds"
    found[report.PAPER] = measured(3.0, merges=1.0)
    found[report.TUNED] = measured(9.0)
    last = verdicts(report.findings(found, invented_alternatives({"unmasked": 0.95}), slopes))
    assert last["phd-video-identity"] == last["phd-video-masked-update"] == "does not hold"
    rows = {row[0]: row[3:] for row in report.events_grid(found).rows}
    assert rows[report.PAPER] == ["60 of 60", "12 of 12", "12 of 12", "48 of 48"]
    assert rows[report.TUNED] == ["60 of 60", "0 of 12", "12 of 12", "48 of 48"]


def test_claims_on_counts_follow_the_readings() -> None:
    first = verdicts(readings_report.findings(invented_readings({})))
    held = ("count", "events", "errors-at-changes", "after-occlusion", "detector", "pruning")
    assert {first[f"phd-video-{name}"] for name in held} == {"holds"}
    # The detector decides the count, and what is right while people are one region decides the events.
    last = readings_report.findings(invented_readings({"printed": 0.3}, one_merge=0.0))
    assert verdicts(last)["phd-video-count"] == "depends" and verdicts(last)["phd-video-detector"] == "does not hold"
    points = next(finding.points for finding in last if finding.id == "phd-video-events")
    assert summarize_box("holds", points, Rule(above=0.5))[1] == ["merged"]


def test_both_boxes_of_the_video_run_every_point_on_one_sequence() -> None:
    arrays = readings.read(sequences.rendered(7, script=sequences.SCRIPT, horizon=60))
    assert {f"{name}|right|{box.TWO}" for name in readings.trackers()} <= set(arrays)
    assert arrays["ours/25/0.05|right|two people"] == arrays["ours/25/0.05|right|one target"] >= 0.9
    assert arrays["happened"].tolist() == [1, 0, 0, 0]
    detectors, trackers = box._alternatives((384, 288))
    arrays = box.play(sequences.rendered(7, script=sequences.SCRIPT, horizon=20), detectors, trackers)
    assert {f"{name}|seconds" for name in trackers} <= set(arrays)


def test_people_who_have_merged_are_one_region() -> None:
    def person(left: np.ndarray) -> Track:
        size = np.full(40, 20.0)
        return Track(np.arange(40), np.stack([left, 0.0 * left + 50.0, size, 2.0 * size], axis=1))

    steps = np.arange(40.0)
    near = np.clip(np.abs(steps - 20.0) - 5.0, 0.0, None) * 4.0
    truth = [person(100.0 + near), person(100.0 - near), person(300.0 + 0.0 * steps)]
    numbers = np.full(40, 3)
    regions = events.regions_of_people(truth, numbers)
    merge, split = events.find_events(truth, 40)
    assert (merge.kind, split.kind) == ("merge", "split")
    assert regions.tolist() == [2 if merge.frame <= k < split.frame else 3 for k in range(40)]
    # A filter that reports one target while they are one region, and three without identities before and after.
    found = [Track(np.array([k]), truth[n].states[[k]]) for k in range(40) for n in range(regions[k])]
    assert events.handled([merge, split], truth, numbers, found, regions) == [False, False]
    assert events.handled([merge, split], truth, regions, found, regions, identities_kept=False) == [True, True]


def test_an_unmasked_background_learns_people_who_stand() -> None:
    empty = np.full((60, 80, 3), 90, np.uint8)
    person = empty.copy()
    person[15:45, 30:40] = 220
    masked: Any = create_detector("masked-paper", None, learning_rate=0.2)
    for detector, expected in ((masked, 1), (alternatives.UnmaskedBackground(masked), 0)):
        state = detector.initial(empty)
        for _ in range(40):
            state, found = detector.step(state, person)
        assert len(found.boxes) == expected


def test_ranks_that_agree_correlate() -> None:
    values = np.arange(12.0)
    assert transfer.rank_correlation(values, values**3).startswith("+1.00 [+1.00, +1.00]")
    assert transfer.rank_correlation(values, -values).startswith("-1.00")
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, 5, (2, 24)).astype(float)
    assert transfer._correlations(one[None], other[None])[0] == pytest.approx(spearmanr(one, other).statistic)
    assert transfer.mean_rank_correlation(values, [values, -values]).startswith("+0.00 [-1.00, +1.00]")
    assert np.isnan(transfer._correlations(values[None], np.ones((1, 12)))[0])


def test_means_over_detectors_leave_one_value_per_tracker() -> None:
    values = np.arange(2.0 * len(transfer.CONFIGURATIONS)).reshape(2, -1)
    found = transfer.by_tracker(values)
    assert found.shape == (2, len(transfer.TRACKERS))
    pmb = [number for number, method in enumerate(transfer.CONFIGURATIONS.values()) if method.tracker == "pmb"]
    assert found[1, -1] == values[1, pmb].mean()


def test_sequences_of_detections_rank_trackers_in_four_measures(tmp_path: Path) -> None:
    folder = tmp_path / "Walk"
    rows = [f"{k + 1},{{}},{10 + 3 * k},20,10,30,1,1,1" for k in range(30)]
    for name, identity in (("gt", 1), ("det", -1)):
        (folder / name).mkdir(parents=True)
        (folder / name / f"{name}.txt").write_text("".join(f"{row.format(identity)}\n" for row in rows))
    recording = Recording(str(folder), None)
    assert transfer.holds_only_detections(recording) and transfer._name_of(recording) == "Walk"
    assert not transfer.holds_only_detections(Recording("a.avi", "a.xml"))
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transfer, "SCENES", {"plain": {"level": 0}})
        patch.setattr(transfer, "FRAMES", 8)
        reproduce.reproduce_paper("transfer", tmp_path / "out", 1, Console(file=output, width=250), None, [recording])
    text = (tmp_path / "out" / "transfer.md").read_text()
    for measure in transfer.MEASURES:
        assert f"Rank correlation of {measure}, trackers on given detections" in text
    assert "1.00 / 1.00 / 1.00 / 0" in text


def test_counts_are_drawn_one_panel_per_method() -> None:
    figure = draw_counts(np.array([0, 1, 1]), {"a": np.array([0, 1, 2]), "b": np.array([0, 0, 0])}, 25.0)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["a", "b"]


def test_recordings_go_only_with_what_takes_them(tmp_path: Path) -> None:
    console = Console(file=io.StringIO())
    with pytest.raises(ValueError, match="--source goes with gm_phd_video and transfer, got it with 'hmm_sonar'"):
        reproduce.reproduce_paper("hmm_sonar", tmp_path, 1, console, None, [Recording("a.avi", None)])


def test_a_recording_ends_where_its_frames_end() -> None:
    track = Track(np.array([0, 5, 9]), np.ones((3, 4)))
    assert sequences._until(track, 6).steps.tolist() == [0, 5]


@pytest.mark.slow
def test_the_whole_command(tmp_path: Path) -> None:
    reproduce.reproduce_paper("gm_phd_video", tmp_path, 1, Console(file=io.StringIO(), width=170))
    assert {"gm_phd_video.md", "claims.yaml", "figure2.png", "figure3.svg"} <= {
        path.name for path in tmp_path.iterdir()
    }


@pytest.mark.slow
def test_the_number_of_people_is_right_in_nine_frames_of_ten() -> None:
    found = []
    for seed in seeds.take("tune", 4):
        sequence = sequences.rendered(seed, script=sequences.SCRIPT, horizon=experiment.COUNTED_FRAMES)
        outcomes = run_methods(sequence.frames, sequence.size, sequence.frame_rate, {"PMB": Method("masked", "pmb")})
        found.append(count_right(outcomes["PMB"], sequence.numbers))
    assert np.mean(found) >= 0.9
