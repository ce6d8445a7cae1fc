"""Process that measures the rate of a set filter, or prints its estimates.

Rates follow the protocol of `stepping.serve`.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.speed.stepping import WARM_UP, serve
from servotrack.estimators.rfs import GMPHD, PMB, PMBM, Birth, GMCBMeMBer, Reduction, constant_velocity
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Estimator

SetFilter: TypeAlias = "Estimator[ArrayLike, Any, SetEstimate]"
"""Filter of measurement sets: a scan in, targets with identities out."""

FILTERS: dict[str, Callable[..., SetFilter]] = {
    "GMPHD": GMPHD,
    "GMCBMeMBer": GMCBMeMBer,
    "PMB": PMB,
    "PMBM": PMBM,
}

CROWD, CROWD_CLUTTER, CROWD_STEPS = 100, 200.0, 30
CROWD_HALF_WIDTH = 2000.0


def scenario_filter(kind: str, stored: Any) -> SetFilter:
    """Return a filter with the model of the stored scans.

    Args:
        kind: Name in `FILTERS`.
        stored: Arrays that `set_filters.write_scans` wrote.
    """
    sites = np.asarray(stored["sites"])
    means = np.zeros((len(sites), 4))
    means[:, [0, 2]] = sites
    birth = Birth(np.full(len(sites), 0.03), means, 100.0 * np.eye(4))
    model = constant_velocity(*(float(value) for value in stored["noise"]))
    return FILTERS[kind](model, birth, clutter_intensity=float(stored["clutter_intensity"]))


def stored_scans(stored: Any, batch: int) -> list[Array]:
    """Return scans of one run as arrays (m, 2), or of a batch of runs as rows (batch, M, 3) with existence first."""
    if batch == 1:
        return np.split(stored["scan"], np.cumsum(stored["count"])[:-1])
    return list(np.swapaxes(stored["rows"][:batch], 0, 1))


def crowd(kind: str) -> tuple[SetFilter, list[Array]]:
    """Return a filter and scans of 100 targets that exist all the time, spread over the whole region."""
    rng = np.random.default_rng(0)
    model = constant_velocity(5.0, 1.5)
    states = np.zeros((CROWD, 4))
    states[:, [0, 2]] = rng.uniform(-0.9 * CROWD_HALF_WIDTH, 0.9 * CROWD_HALF_WIDTH, (CROWD, 2))
    states[:, [1, 3]] = rng.normal(0.0, 5.0, (CROWD, 2))
    birth = Birth(np.full(CROWD, 0.01), states, 100.0 * np.eye(4))
    scans = []
    for _ in range(CROWD_STEPS):
        states = states @ model.transition.T
        seen = states[rng.random(CROWD) < 0.98][:, [0, 2]]
        false = rng.uniform(-CROWD_HALF_WIDTH, CROWD_HALF_WIDTH, (rng.poisson(CROWD_CLUTTER), 2))
        scans.append(rng.permutation(np.concatenate([seen + rng.normal(0.0, 1.5, seen.shape), false])))
    # Five components per target, as in the preset of pairwise_markov.
    size = {"components": 5 * CROWD} if kind == "GMPHD" else {"components": 5, "tracks": 5 * CROWD}
    kappa = CROWD_CLUTTER / (2.0 * CROWD_HALF_WIDTH) ** 2
    return FILTERS[kind](model, birth, clutter_intensity=kappa, reduction=Reduction(**size)), scans


def filterer(filter_: SetFilter, scans: Sequence[Array], batch: int) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns scans filtered per second, summed over runs."""

    def run(duration: float) -> float:
        done, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            state = filter_.initial(scans[0])
            for scan in scans:
                state, _ = filter_.step(state, scan)
            done += len(scans) * batch
        return done / elapsed

    run(WARM_UP)
    return run


def estimates(filter_: SetFilter, scans: Sequence[Array]) -> list[list[list[float]]]:
    """Return the positions reported after each scan, m."""
    state, answers = filter_.initial(scans[0]), []
    for scan in scans:
        state, estimate = filter_.step(state, scan)
        answers.append(estimate.states[:, [0, 2]].tolist())
    return answers


def main(job: str, kind: str, *rest: str) -> None:
    """Serve rates with `scans KIND BATCH FILE` or `crowd KIND`; print positions as JSON with `estimates KIND FILE`."""
    if job == "crowd":
        serve(filterer(*crowd(kind), 1))
        return
    stored = np.load(Path(rest[-1]))
    batch = int(rest[0]) if job == "scans" else 1
    filter_, scans = scenario_filter(kind, stored), stored_scans(stored, batch)
    if job == "scans":
        serve(filterer(filter_, scans, batch))
    else:
        print(json.dumps(estimates(filter_, scans)))


if __name__ == "__main__":
    main(*sys.argv[1:])
