"""Speed of the set filters: the scans, the rates without Stone Soup, and the estimates."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from servotrack.baselines.speed import rates, set_filter_process, set_filters


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    return set_filters.write_scans(tmp_path_factory.mktemp("scans") / "scans.npz")


def test_one_run_and_the_batch_are_the_same_scans(scans):
    stored = np.load(scans)
    one, batch = set_filter_process.stored_scans(stored, 1), set_filter_process.stored_scans(stored, 3)
    assert len(one) == len(batch) == 100
    for z, rows in zip(one, batch, strict=True):
        assert rows.shape[0] == 3
        np.testing.assert_array_equal(rows[0][rows[0, :, 0] == 1.0, 1:], z)


def test_every_row_has_a_command_that_runs_and_a_missing_peer_says_what_to_do(scans):
    rows = set_filters.subjects(scans, None)
    found = rates.measure(rows[-3:], 1, 0.05, lambda name: None)
    assert found[set_filters.REFERENCE].missing == set_filters.REMEDY
    assert all(rate.median > 0.0 for name, rate in found.items() if name != set_filters.REFERENCE)
    assert "missing" in rates.table(rows[-3:], found)


def test_estimates_are_near_the_truth(scans):
    command = [sys.executable, str(set_filters.SET_FILTER_PROCESS), "estimates", "GMPHD", str(scans)]
    answers = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    numbers = [len(positions) for positions in answers]
    assert len(answers) == 100
    assert 4.0 < np.mean(numbers) < 12.0
