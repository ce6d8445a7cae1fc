"""Targets followed per second through a minute of bearing-time record, by number of targets.

`python bearings.py TARGETS` follows the protocol of `stepping.serve`. The rate stays constant if cost is linear in the
number of targets.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from servotrack.baselines.agents.sonar.catalog import sonar_tracker
from servotrack.baselines.speed.rates import Subject
from servotrack.baselines.speed.stepping import WARM_UP, serve
from servotrack.envs.track.sonar.array_model import scene_model_of
from servotrack.envs.track.sonar.config import SonarConfig, sonar_config
from servotrack.envs.track.sonar.records import draw_record
from servotrack.envs.track.sonar.scene import SonarScene, draw_scene
from servotrack.estimators.types import Array

ROWS = 60
NUMBERS = (2, 4, 6, 8, 12)
ENDS = (25.0, 155.0)
"""Bearings of the first and the last target, deg. The others are equally spaced between them."""
FIRST = 5
"""Record in which the targets begin."""


def subjects() -> list[Subject]:
    """Return the rows of the table. The target is two targets in 0.1 s."""
    return [
        Subject(f"{count} targets apart", (__file__, str(count)), 20.0 if count == min(NUMBERS) else 0.0)
        for count in NUMBERS
    ]


def spaced_targets(count: int) -> tuple[SonarConfig, SonarScene]:
    """Return a world and a scene of `count` targets at constant bearings, as loud as the paper's broadband target."""
    paper = draw_scene(sonar_config(variant="rates"), 0)
    config = sonar_config(variant="random", targets=count, max_targets=count, horizon=ROWS)
    records = config.horizon + config.lag + 1
    bearings = np.tile(np.linspace(*ENDS, count), (records, 1))
    exists = np.tile(np.arange(records)[:, None] >= FIRST, count)
    power = np.repeat(paper.power[~paper.tonal][:1], count, axis=0)
    return config, SonarScene(bearings, np.zeros_like(bearings), exists, power, np.zeros(count, np.bool_))


def record(count: int) -> tuple[SonarConfig, Array]:
    """Return the world of `spaced_targets` and a minute of its record, shape (60, beams)."""
    config, scene = spaced_targets(count)
    return config, np.array([draw_record(config, scene, 0, k) for k in range(ROWS)])


def tracking(count: int) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns targets followed per second.

    Raises:
        RuntimeError: The tracker finds another number of targets.
    """
    config, rows = record(count)
    tracker = sonar_tracker("hmm-row", scene_model_of(config))
    if (found := len(tracker.track(rows))) != count:
        raise RuntimeError(f"the tracker found {found} of {count} targets")

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
