"""Process that measures the rate of the Kalman Jacobian estimator on a batch of arms.

`python jacobian_process.py BATCH` follows the protocol of `stepping.serve`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from servotrack.baselines.speed.stepping import WARM_UP, serve
from servotrack.estimators.jacobian import KalmanJacobian, ServoMeasurement

STEPS = 256
PERIOD = 0.05


def updater(batch: int) -> Callable[[float], float]:
    """Return a function that runs for a given time, s, and returns measurements processed per second, over all rows.

    Args:
        batch: Number of arms (two joints, one image point each).
    """
    rng = np.random.default_rng(0)
    angles = np.cumsum(rng.uniform(-0.1, 0.1, (STEPS, batch, 2)), axis=0)
    jacobian = rng.normal(0.0, 200.0, (batch, 2, 2))
    features = 240.0 + np.einsum("bij,tbj->tbi", jacobian, angles) + rng.normal(0.0, 0.5, (STEPS, batch, 2))
    goal, seen = np.full((batch, 2), 240.0), np.ones(batch, dtype=np.bool_)
    times = np.arange(STEPS)[:, None] * PERIOD + np.zeros(batch)
    stream = [ServoMeasurement(angles[t], features[t], goal, seen, times[t], times[t]) for t in range(STEPS)]
    estimator = KalmanJacobian()

    def run(duration: float) -> float:
        updates, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            state = estimator.initial(stream[0])
            for measurement in stream:
                state, _ = estimator.step(state, measurement)
            updates += STEPS * batch
        return updates / elapsed

    run(WARM_UP)
    return run


if __name__ == "__main__":
    serve(updater(int(sys.argv[1])))
