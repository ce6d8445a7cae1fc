"""Sums have the bits of additions from the first to the last on every Python, and so has what is made of them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from servotrack.envs.servo3d.arms import ARMS
from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.estimators.elementary import sum_in_order


def added(values: list[float]) -> float:
    total = 0.0
    for value in values:
        total += value
    return total


def test_rounding_is_not_compensated() -> None:
    # Python's own sum returns 2 from version 3.12 on.
    assert sum_in_order([1.0, 1e100, 1.0, -1e100]) == 0.0


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100, 5000])
def test_numbers_are_added_from_the_first_to_the_last(count: int) -> None:
    values = np.random.default_rng(count).standard_normal(count)
    assert sum_in_order(values) == added(values.tolist())


@pytest.mark.parametrize("name", ARMS)
def test_the_reach_of_an_arm_is_added_in_order(name: str) -> None:
    arm = ARMS[name]
    points = [*arm.points[1:].tolist(), arm.tool[:3, 3].tolist()]
    assert arm.reach == added([math.dist(a, b) for a, b in itertools.pairwise(points)])


@pytest.mark.parametrize("slope", [1.0, 5.0, 7.3, -10.0])
def test_the_mean_of_ambient_noise_is_added_in_order(slope: float) -> None:
    config = SonarConfig(ambient_slope=slope)
    octaves = [math.log2(ratio) for ratio in (config.band.frequencies / config.band_low).tolist()]
    power = [10.0 ** (-slope / 10.0 * octave) for octave in octaves]
    mean = added(power) / len(power)
    assert config.ambient.tolist() == [value / mean for value in power]
