"""The benchmark of the set filters measures what it says, without Stone Soup where there is none."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from servotrack.baselines.speed import clutter, set_filtering, speed


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    return clutter.write_scans(tmp_path_factory.mktemp("scans") / "scans.npz")


def test_one_run_and_the_batch_are_the_same_scans(scans):
    stored = np.load(scans)
    one, batch = set_filtering.stored_scans(stored, 1), set_filtering.stored_scans(stored, 3)
    assert len(one) == len(batch) == 100
    for z, rows in zip(one, batch, strict=True):
        assert rows.shape[0] == 3
        np.testing.assert_array_equal(rows[0][rows[0, :, 0] == 1.0, 1:], z)


def test_every_row_has_a_command_that_runs_and_a_missing_peer_says_what_to_do(scans):
    rows = clutter.subjects(scans, None)
    rates = speed.measure(rows[-3:], 1, 0.05, lambda name: None)
    assert rates[clutter.PEER].missing == clutter.REMEDY
    assert all(rate.median > 0.0 for name, rate in rates.items() if name != clutter.PEER)
    assert "missing" in speed.table(rows[-3:], rates)


def test_estimates_are_near_the_truth(scans):
    command = [sys.executable, str(clutter.SET_FILTERING), "estimates", "GMPHD", str(scans)]
    answers = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    numbers = [len(positions) for positions in answers]
    assert len(answers) == 100
    assert 4.0 < np.mean(numbers) < 12.0
