"""Assignment of measurements to reported targets, by which names and classes of measurements reach the tracks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.gaussians import attach_measurement, weigh_pairs
from servotrack.estimators.rfs.mixture import empty_mixture
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.scan_noise import no_excess, read_noise
from servotrack.estimators.rfs.sensors import SensedModel, Sensor, model_at
from servotrack.estimators.rfs.sets import SetEstimate, read_measurements
from servotrack.estimators.types import Array, Labels

FORBIDDEN_COST = 1e9
"""Cost of a pair outside the gate, above any negative log likelihood inside it."""


def match_measurements(
    estimate: SetEstimate,
    measurement: ArrayLike,
    model: TargetModel,
    *,
    sensor: Sensor | None = None,
    noise: ArrayLike | None = None,
    gate_probability: float = 0.999,
) -> Labels:
    """Assign the measurements of a scan to the targets that a filter reports after it.

    The filters sum over associations and do not decide on one; this is the most probable division of the scan given
    their answer, each measurement to one target at most. Use it to pass names, classes or scores of measurements on to
    the tracks: `names[index]` where `index >= 0`.

    Args:
        estimate: Estimate of one run after the scan; for a filter that answers late, the estimate for the scan's time.
        measurement: The scan. Shape (Z, m).
        model: The filter's model.
        sensor: Sensor of the scan; None: the measurement of the model.
        noise: Covariance of each measurement's noise, if the filter was given any. Shape (Z, m, m).
        gate_probability: Probability that a target's measurement lies in its gate. Raising it matches measurements
            that are farther from their target.

    Returns:
        Row of the measurement of each reported target, -1 for a target that the scan missed. Shape (k,).

    Raises:
        ValueError: The estimate is of a batch, or an argument is out of range or has a wrong shape.
    """
    if estimate.states.ndim != 2:
        raise ValueError(
            f"estimate must be of one run, got states of shape {estimate.states.shape}; take one run of it"
        )
    if not 0.0 < gate_probability < 1.0:
        raise ValueError(f"gate_probability must be in (0, 1), got {gate_probability!r}")
    now = model if sensor is None else model_at(model, None, sensor)
    packed = now.packed
    m, n = packed.observation.shape
    z, _, single = read_measurements(measurement, m)
    if not single:
        raise ValueError(f"measurement must be a scan of one run, shape (Z, {m}), got {np.shape(measurement)}")
    excess = no_excess(1, m) if noise is None else read_noise(noise, measurement, packed)
    k = len(estimate.states)
    targets = empty_mixture(1, k, n + m)
    targets.number[:] = k
    targets.mean[0, :, :n], targets.covariance[0, :, :n, :n] = estimate.states, estimate.covariances
    if isinstance(now, SensedModel):
        now.attach(targets)
    else:
        _attach_all(packed, targets.mean[0], targets.covariance[0])
    gate = float(chdtri(m, 1.0 - gate_probability))
    target, row, likelihood, *_ = weigh_pairs(
        packed, k, targets.mean[0], targets.covariance[0], z[0], excess[0], z.shape[1], gate
    )
    return most_likely_pairs(target, row, likelihood, k, z.shape[1])


def most_likely_pairs(track: Labels, measurement: Labels, likelihood: Array, T: int, Z: int) -> Labels:
    """The assignment of measurements to tracks, one each at most, with the largest product of likelihoods.

    Args:
        track: Track of each possible pair. Shape (P,).
        measurement: Measurement of the pair. Shape (P,).
        likelihood: Likelihood of the pair, positive. Shape (P,).
        T: Number of tracks.
        Z: Number of measurements.

    Returns:
        Measurement of each track, -1 for none. Shape (T,).
    """
    cost = np.full((T, Z), FORBIDDEN_COST)
    cost[track, measurement] = -np.log(likelihood)
    rows, columns = linear_sum_assignment(cost)
    inside = cost[rows, columns] < FORBIDDEN_COST
    partner = np.full(T, -1)
    partner[rows[inside]] = columns[inside]
    return partner


@njit(cache=True, nogil=True)
def _attach_all(model, mean, cov):  # type: ignore[no-untyped-def]
    """Fill the y blocks of all components."""
    for i in range(mean.shape[0]):
        attach_measurement(model, mean[i], cov[i])
