"""The hmm_sonar audit: scores of tracks worked out by hand, tables and files of a small run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servotrack.baselines.agents.sonar.catalog import sonar_tracker
from servotrack.baselines.papers.claims import fill, read_claims
from servotrack.baselines.papers.hmm_sonar import experiment, readings, readings_report
from servotrack.baselines.papers.hmm_sonar.figures import draw_offsets
from servotrack.baselines.papers.hmm_sonar.findings import (
    COMMAND,
    CONTRADICTIONS,
    bearing_error,
    coverage,
    findings,
    simulation_grid,
    trial_grid,
)
from servotrack.baselines.papers.hmm_sonar.scores import RecordScores, score_tracks
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.envs.track.sonar.array_model import scene_model_of
from servotrack.envs.track.sonar.config import sonar_config
from servotrack.envs.track.sonar.scene import draw_scene
from servotrack.estimators.metrics import Track


def crossing_pair():
    """Two targets that cross after 20 of 40 records; both there from 5 to 35."""
    k = np.arange(40)
    bearings = np.stack([60.0 + k, 101.0 - k], axis=1)
    exists = np.repeat(((k >= 5) & (k <= 35))[:, None], 2, axis=1)
    return bearings, exists


def track(bearings, steps, target, error=0.0):
    return Track(np.asarray(steps), bearings[steps, target, None] + error)


def test_true_tracks_have_no_error():
    bearings, exists = crossing_pair()
    steps = np.arange(5, 36)
    scores = score_tracks(bearings, exists, [track(bearings, steps, 0), track(bearings, steps, 1)])
    assert scores.squared_error.tolist() == [0.0, 0.0]
    assert scores.tracked.tolist() == scores.present.tolist() == [31, 31]
    assert (scores.start.tolist(), scores.end.tolist()) == ([0, 0], [0, 0])
    assert (scores.crossings, scores.kept, scores.swapped, scores.false_tracks) == (1, 1, 0, 0)
    assert scores.count_right == 1.0


def test_late_short_and_false_tracks_are_counted():
    bearings, exists = crossing_pair()
    late = np.arange(8, 34)
    nobody = Track(np.arange(12), np.full((12, 1), 170.0))
    scores = score_tracks(bearings, exists, [track(bearings, late, 1, 0.5), nobody])
    assert np.sqrt(scores.squared_error[1] / scores.tracked[1]) == pytest.approx(0.5)
    assert scores.tracked.tolist() == [0, 26]
    assert np.isnan(scores.start[0])
    assert (scores.start[1], scores.end[1]) == (3, -2)
    assert scores.false_tracks == 1
    assert (scores.kept, scores.swapped) == (0, 0)
    # Right: 4 records before and 4 after in which nobody is there, less those in which the false track is.
    assert scores.count_right == pytest.approx((4 + 4) / 40)


def test_tracks_that_bounce_off_each_other_are_swapped():
    bearings, exists = crossing_pair()
    low, high = np.sort(bearings, axis=1).T
    steps = np.arange(5, 36)
    bounced = [Track(steps, low[steps, None]), Track(steps, high[steps, None])]
    scores = score_tracks(bearings, exists, bounced)
    assert (scores.crossings, scores.kept, scores.swapped) == (1, 0, 1)
    assert scores.tracked.tolist() == [31, 31]


def test_new_tracks_after_a_crossing_are_neither_kept_nor_swapped():
    bearings, exists = crossing_pair()
    pieces = [track(bearings, steps, i) for i in range(2) for steps in (np.arange(5, 19), np.arange(22, 36))]
    scores = score_tracks(bearings, exists, pieces)
    assert (scores.crossings, scores.kept, scores.swapped, scores.false_tracks) == (1, 0, 0, 0)


def test_no_tracks_and_no_targets_are_scored():
    bearings, exists = crossing_pair()
    assert score_tracks(bearings, exists, []).tracked.tolist() == [0, 0]
    nothing = score_tracks(np.zeros((40, 0)), np.zeros((40, 0), bool), [])
    assert (nothing.count_right, nothing.false_tracks, nothing.crossings) == (1.0, 0, 0)


@pytest.fixture(scope="module")
def small():
    """A plan of the same conditions on a receiver and at a length that take no time."""
    cheap = {"beams": 181, "elements": 24, "bin_width": 25.0, "snapshots": 25, "fidelity": "gamma", "horizon": 50}
    return [condition._replace(config=replace(condition.config, **cheap), runs=1) for condition in experiment.plan(1)]


@pytest.fixture(scope="module")
def found(small, tmp_path_factory):
    """All conditions, every method with the cheapest tracker in its place."""
    folder = tmp_path_factory.mktemp("records")
    with pytest.MonkeyPatch.context() as patch, progress_bars() as progress:
        patch.setattr(experiment, "sonar_tracker", lambda name, told: sonar_tracker("peak-kalman-hungarian", told))
        first = experiment.run_all(small, folder, progress, jobs=1)
        again = experiment.run_all(small, folder, progress, jobs=1)
    for name, methods in first.items():
        for method, measures in methods.items():
            assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(measures, again[name][method], strict=True))
    return first


def test_every_condition_is_measured_with_every_method(found):
    assert len(found) == 2 * len(experiment.OFFSETS) + 2
    clear = found[experiment.simulation("cross30", 0)]
    assert set(clear) == set(experiment.METHODS)
    assert coverage(clear[experiment.ROW]).mean() > 0.8
    assert bearing_error(clear[experiment.ROW]) < 0.5
    # What is given row after row, and answers late, is the same tracker.
    assert coverage(clear[experiment.LATE]).mean() == pytest.approx(coverage(clear[experiment.ROW]).mean(), abs=0.05)
    assert found[experiment.NOISE][experiment.ROW].present.sum() == 0


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """All readings, with invented scores: L known is perfect, L tested has two false tracks."""
    perfect = RecordScores(
        squared_error=np.zeros(2), tracked=np.array([39, 36]), present=np.array([39, 36]), start=np.zeros(2),
        end=np.zeros(2), crossings=1, kept=1, swapped=0, false_tracks=0, count_right=1.0,
    )  # fmt: skip

    def scored(config, at, seed):
        if at["exclusion"] == "none":
            return perfect._replace(tracked=np.array([39, 0]))
        return perfect if at["number"] == "known" else perfect._replace(false_tracks=2)

    with pytest.MonkeyPatch.context() as patch, progress_bars() as progress:
        patch.setattr(readings, "_scored", scored)
        return readings.ReadingsBox(tmp_path_factory.mktemp("readings"), progress)


def test_every_claim_of_the_paper_gets_a_verdict_and_every_table_its_rows(found, box):
    shipped = {claim.id for claim in read_claims() if claim.paper == "hmm_sonar" and claim.verdict != "not tested"}
    seconds = {number: np.full(12, 0.1 * number) for number in (1, 3, 6)}
    by_reading = readings_report.findings(box, seconds)
    assert {finding.id for finding in [*by_reading, *findings(found)]} == shipped
    claims = {claim.id: claim for claim in fill(read_claims(), by_reading, readings_report.COMMAND)}
    assert claims["sonar-automatic"].verdict == "depends"
    assert claims["sonar-automatic"].depends_on == ("number",)
    assert claims["sonar-exclusion"].verdict == claims["sonar-cost"].verdict == "holds"
    # Ten records with a turning target suffice for the mean, ten crossings of ten do not for 90 %.
    assert claims["sonar-turning"].verdict == "holds"
    assert claims["sonar-crossing"].verdict == "open"
    # One record decides nothing.
    assert {claim.verdict for claim in fill(read_claims(), findings(found), COMMAND) if claim.command == COMMAND} == {
        "open"
    }
    grid = simulation_grid(found, "rates")
    assert len(grid.rows) == len(experiment.OFFSETS) * len(experiment.METHODS)
    assert len(trial_grid(found).rows) == len(experiment.METHODS)
    assert all(len(row) == len(CONTRADICTIONS.headings) for row in CONTRADICTIONS.rows)


def test_the_power_itself_and_a_known_number_of_chains_keep_both_tracks_through_a_crossing():
    config = sonar_config(variant="cross30")
    scene = draw_scene(config, 100_000)
    rows = experiment.draw_rows(config, scene, 100_000)[: config.horizon]
    model = sonar_tracker("hmm-cell", scene_model_of(config))
    tracks = readings.track(model, rows, readings.Reading("power", "uninformative", 2))
    scores = score_tracks(scene.bearings[: config.horizon], scene.exists[: config.horizon], tracks)
    assert (len(tracks), scores.kept, scores.false_tracks) == (2, 1, 0)


def test_a_file_of_another_setting_is_refused(small, monkeypatch, tmp_path):
    monkeypatch.setattr(experiment, "METHODS", {experiment.HUNGARIAN: "peak-kalman-hungarian"})
    condition = small[0]
    with progress_bars() as progress:
        experiment.run_all([condition], tmp_path, progress, jobs=1)
        other = condition._replace(config=replace(condition.config, snr_offset=1.0))
        with pytest.raises(ResultsError, match="holds runs of another setting"):
            experiment.run_all([other], tmp_path, progress, jobs=1)


def test_figures_are_drawn(found):
    figure = draw_offsets(found)
    assert len(figure.axes) == 4
    assert len(figure.axes[0].lines) == len(experiment.METHODS)
