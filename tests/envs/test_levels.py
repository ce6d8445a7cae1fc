"""Levels of difficulty: settings that each level adds, and error messages for invalid arguments."""

from __future__ import annotations

import inspect
import itertools
import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from servotrack.envs.servo.levels import AXES, LEVEL_NAMES, ServoConfig, reach_config, servo_config

LEVELS = range(7)


def test_each_level_adds_to_those_before_it() -> None:
    changed = [
        {axis for axis in AXES if getattr(servo_config(level), axis) != getattr(ServoConfig(), axis)}
        for level in LEVELS
    ]
    assert changed[0] == set()
    for lower, higher in itertools.pairwise(changed):
        assert lower < higher or lower == higher
    assert len(LEVEL_NAMES) == len(LEVELS)
    targets = [servo_config(level).target for level in LEVELS]
    assert targets == ["paper", "ellipse", "ellipse", "ellipse", "two_sine", "two_sine", "waypoints"]
    assert servo_config(5).latency == (1, 1) and servo_config(5).stamped and not servo_config(6).stamped


def test_level_0_is_the_papers_world() -> None:
    config = servo_config(0)
    assert (config.links, config.focal, config.depth) == ((0.5, 0.5), (160.0, 160.0), (0.35, 0.35))
    assert config.camera_size == 480 and config.warmup == 8 and config.max_joint_rate == 2.0


@pytest.mark.parametrize("level", LEVELS)
def test_an_axis_overrides_its_level(level: int) -> None:
    config = servo_config(level, pixel_noise=2.5, links=0.4, latency=(1, 2), stamped=True)
    assert (config.pixel_noise, config.links, config.latency, config.stamped) == (2.5, (0.4, 0.4), (1, 2), True)


def test_numbers_of_numpy_are_numbers() -> None:
    odd = servo_config(1, warmup=np.int64(3), pixel_noise=np.float32(0.5), links=(np.float64(0.4), np.int32(1)))
    plain = servo_config(1, warmup=3, pixel_noise=0.5, links=(0.4, 1.0))
    assert odd == plain and hash(odd) == hash(plain)
    assert type(odd.warmup) is int and type(odd.pixel_noise) is float


def test_reaching_rests_and_is_short() -> None:
    assert (reach_config(0).target, reach_config(0).horizon) == ("paper_point", 100)
    assert {reach_config(level).target for level in range(1, 7)} == {"point"}
    assert reach_config(3, horizon=50).horizon == 50


def test_every_axis_is_documented() -> None:
    # From Python 3.13 on the compiler takes the indentation out of docstrings, getdoc does so everywhere.
    text = inspect.getdoc(ServoConfig)
    assert text is not None
    for field in fields(ServoConfig):
        assert f"\n    {field.name}: " in text, field.name


@pytest.mark.parametrize("level", [-1, 7, 3.5, "3", "optics", True, None])
def test_unknown_levels_are_named(level: Any) -> None:
    with pytest.raises(ValueError, match=r"level must be a whole number from 0 to 6, got"):
        servo_config(level)


@pytest.mark.parametrize(
    ("typo", "suggestion"), [("pixle_noise", "pixel_noise"), ("levl", "level"), ("horizont", "horizon")]
)
def test_unknown_keywords_get_a_suggestion(typo: str, suggestion: str) -> None:
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{typo}'; did you mean '{suggestion}'"):
        servo_config(3, **{typo: 1})


def test_a_keyword_like_no_other_gets_the_list() -> None:
    with pytest.raises(TypeError, match="known are target, links, focal"):
        servo_config(3, zzz=1)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"links": (0.6, 0.4)}, r"links must be a number or \(low, high\) with low <= high, got \(0.6, 0.4\)"),
    ({"links": (0.3, 0.4, 0.5)}, "links must be a number"),
    ({"links": "0.5"}, "links must be a number"),
    ({"links": 0.01}, r"links must lie in \[0.1, 4.0\]"),
    ({"focal": (100.0, math.inf)}, "focal must be a number"),
    ({"mounting": (0.1, 0.2)}, r"mounting must be one number in \[0.0, 3.14.*\], got \(0.1, 0.2\)"),
    ({"mounting": 4.0}, "mounting must lie in"),
    ({"pixel_noise": -1.0}, r"pixel_noise must lie in \[0.0, 50.0\], got -1.0"),
    ({"pixel_noise": math.nan}, "pixel_noise must be one number"),
    ({"dropout": True}, "dropout must be one number"),
    ({"dropout": 1.0}, "dropout must lie in"),
    ({"horizon": 0}, "horizon must lie in"),
    ({"horizon": 2.5}, "horizon must be a whole number, got 2.5"),
    ({"horizon": (10, 20)}, "horizon must be one number"),
    ({"camera_size": "480"}, "camera_size must be one number"),
    ({"latency": (0, 1.5)}, "latency must be a whole number of control periods"),
    ({"latency": 9}, "latency must lie in"),
    (
        {"target": "elipse"},
        "target must be one of paper, paper_point, point, ellipse, two_sine, waypoints, got 'elipse'",
    ),
    ({"noise_kind": "normal"}, "noise_kind must be one of gaussian"),
    ({"stamped": 0}, "stamped must be True or False, got 0"),
    ({"stamped": False}, "stamped=False with latency 0 hides nothing; give latency="),
    ({"outlier_rate": 0.1, "outlier_size": 0.0}, "outlier_rate > 0 contradicts outlier_size = 0; give outlier_size"),
]


@pytest.mark.parametrize(("axes", "message"), BAD, ids=[str(axes) for axes, _ in BAD])
def test_bad_values_are_named(axes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        servo_config(3, **axes)
