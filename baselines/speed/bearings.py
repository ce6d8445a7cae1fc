"""Targets followed per second through a minute of bearing-time record, by how many are there.

`python bearings.py TARGETS` is asked on demand, as `stepping` is for environments. Where cost is linear in the targets
the rate does not fall with them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from servotrack.baselines.agents.sonar.catalog import sonar_tracker
from servotrack.baselines.speed.speed import Subject
from servotrack.baselines.speed.stepping import WARM_UP, serve
from servotrack.envs.track.sonar.array_model import scene_model_of
from servotrack.envs.track.sonar.config import SonarConfig, sonar_config
from servotrack.envs.track.sonar.records import draw_record
from servotrack.envs.track.sonar.scene import SonarScene, draw_scene
from servotrack.estimators.types import Array

ROWS = 60
NUMBERS = (2, 4, 6, 8, 12)
ENDS = (25.0, 155.0)
"""Bearings of the first and the last target, deg; the others stand between, equally far from each other."""
FIRST = 5
"""Record in which they begin."""


def subjects() -> list[Subject]:
    """The table's rows: two targets in 0.1 s are wanted."""
    return [
        Subject(f"{count} targets apart", (__file__, str(count)), 20.0 if count == min(NUMBERS) else 0.0)
        for count in NUMBERS
    ]


def standing_apart(count: int) -> tuple[SonarConfig, SonarScene]:
    """A world and a scene of so many targets, all as loud as the paper's broadband one."""
    paper = draw_scene(sonar_config(variant="rates"), 0)
    config = sonar_config(variant="random", targets=count, max_targets=count, horizon=ROWS)
    records = config.horizon + config.lag + 1
    bearings = np.tile(np.linspace(*ENDS, count), (records, 1))
    exists = np.tile(np.arange(records)[:, None] >= FIRST, count)
    power = np.repeat(paper.power[~paper.tonal][:1], count, axis=0)
    return config, SonarScene(bearings, np.zeros_like(bearings), exists, power, np.zeros(count, np.bool_))


def record(count: int) -> tuple[SonarConfig, Array]:
    """That world and a minute of its record, shape (60, beams)."""
    config, scene = standing_apart(count)
    return config, np.array([draw_record(config, scene, 0, k) for k in range(ROWS)])


def tracking(count: int) -> Callable[[float], float]:
    """A function that runs for a given time and returns targets per second, all of whom are found."""
    config, rows = record(count)
    tracker = sonar_tracker("hmm-row", scene_model_of(config))
    if (found := len(tracker.track(rows))) != count:
        raise RuntimeError(f"{count} targets apart were taken for {found}")

    def run(duration: float) -> float:
        passes, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            tracker.track(rows)
            passes += 1
        return passes * count / elapsed

    run(WARM_UP)
    return run


if __name__ == "__main__":
    serve(tracking(int(sys.argv[1])))
