"""Hard records of the default bearing tracker, on tune seeds."""

import numpy as np
import pytest

from servotrack.baselines.papers.hmm_sonar.hard_cases import cases, draw_powers, run, table, tracker_of
from servotrack.estimators.stateful import Stateful


@pytest.mark.parametrize("name", ["interferer 30 dB louder", "transients, half of the bearings", "target at 6 deg/s"])
def test_hard_cases_on_tune_seeds(name):
    (case,) = [case for case in cases() if case.name == name]
    outcomes = [run(case, seed) for seed in (190_000, 190_001)]
    assert np.mean([one.tracked for one in outcomes]) > 0.9
    assert sum(one.false_tracks for one in outcomes) == 0


def test_the_table_has_a_line_per_case(capsys):
    grid = table([190_002], "3 deg/s")
    assert [row[0] for row in grid.rows] == ["target at 3 deg/s"]
    assert "target at 3 deg/s" in capsys.readouterr().out


def test_a_loud_target_sets_the_level_online():
    (case,) = [case for case in cases() if case.name == "interferer 30 dB louder"]
    rng = np.random.default_rng(190_003)
    tracker, scene = tracker_of(case), case.draw(rng)
    online = Stateful(tracker)
    answers = [online.step(row) for row in draw_powers(case, tracker, scene, rng)[:40]]
    assert online.state.level < 0.9
    weak = scene.bearings[scene.measured]
    errors = [np.abs(answers[k + tracker.lag].states[:, 0] - weak[k]).min(initial=99.0) for k in range(10, 35)]
    assert np.mean(np.array(errors) < 3.0) > 0.9
