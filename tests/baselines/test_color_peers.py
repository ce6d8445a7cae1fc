"""The page that compares color trackers with correlation filters."""

from __future__ import annotations

import numpy as np

from servotrack.baselines.papers.monte_carlo_color.peers import HARD_AXES, OURS, PEERS, peers_report, settings
from servotrack.envs.track.color.config import AXES, LEVEL_NAMES, ColorConfig, color_config


def test_every_level_and_axis_is_compared() -> None:
    # Length and size of the frame are no difficulties.
    assert set(AXES) - set(HARD_AXES) == {"horizon", "width", "height"}
    assert len(settings()) == len(LEVEL_NAMES) + len(HARD_AXES)


def test_an_axis_is_alone_but_for_those_that_it_needs() -> None:
    for name, axes in list(settings().items())[len(LEVEL_NAMES) :]:
        config, plain = color_config(**axes), ColorConfig()
        changed = {axis for axis in AXES if getattr(config, axis) != getattr(plain, axis)}
        assert changed and changed <= {part.split("=")[0] for part in name.split()}


def test_the_page_says_where_ours_is_behind() -> None:
    even = {name: np.full(4, 0.5) for name in (OURS, *PEERS)}
    found = {"a": even | {OURS: np.full(4, 0.75)}, "b": even | {"csrt": np.array([0.5, 0.6, 0.6, 0.7])}}
    page = peers_report(found, 4, "scripts/color-peers")
    assert "It is behind CSRT on b." in page
    assert "| a | 0.750 | 0.500 | 0.500 | 0.500 | +0.250 [+0.250, +0.250] |" in page
    assert "It is ahead of CSRT in every row." in peers_report({"a": found["a"]}, 4, "scripts/color-peers")
