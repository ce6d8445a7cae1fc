"""Distribution of a target's state, given one measurement of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.models import RangeBearingModel, TargetModel
from servotrack.estimators.rfs.sensors import SensedModel
from servotrack.estimators.types import Array


def state_from_measurement(
    model: TargetModel, z: Array, hidden_deviation: ArrayLike, excess: Array | None = None
) -> tuple[Array, Array]:
    """Distribution of the state given one measurement only.

    Args:
        model: Model of one target.
        z: Measurements. Shape (*batch, m).
        hidden_deviation: Standard deviation of the unmeasured state entries; a number or shape (n,).
        excess: Noise of each measurement in excess of the sensor's; None or no rows: none. Shape (*batch, m, m).

    Returns:
        mean (*batch, n), zero in unmeasured entries; covariance (*batch, n, n).

    Raises:
        ValueError: The sensor does not say where a target with a measurement may be.
    """
    if isinstance(model, SensedModel):
        found = sensed_starts(model, z, hidden_deviation, excess)
        if found is None:
            raise ValueError(
                "sensor must have places= to start a track from one measurement, got None; or give births at sites"
            )
        return _matched(*found)
    packed, inverse = model.packed, observation_inverse(model)
    R = packed.measurement_noise
    if excess is not None and excess.shape[:-2] == z.shape[:-1]:
        R = R + excess
    hidden = _hidden(inverse, packed.observation, hidden_deviation)
    if isinstance(model, RangeBearingModel):
        distance, bearing = z[..., 0], z[..., 1]
        cosine, sine = np.cos(bearing), np.sin(bearing)
        position = packed.sensor + np.stack([distance * cosine, distance * sine], axis=-1)
        polar = np.stack(
            [np.stack([cosine, -distance * sine], axis=-1), np.stack([sine, distance * cosine], axis=-1)], axis=-2
        )
        noise = np.einsum("...ij,...jk,...lk->...il", polar, R, polar)
    else:
        position = z
        noise = np.broadcast_to(R, (*z.shape[:-1], *R.shape[-2:]))
    mean = np.einsum("rk,...k->...r", inverse, position)
    return mean, hidden + np.einsum("rk,...kl,cl->...rc", inverse, noise, inverse)


def sensed_starts(
    model: SensedModel, z: Array, hidden_deviation: ArrayLike, excess: Array | None
) -> tuple[Array, Array] | None:
    """Gaussians (*batch, c, n), (*batch, c, n, n) of the state given one measurement, or None.

    Arguments as in `state_from_measurement`; c is the number of places where the sensor says that a target may be.
    """
    flat = z.reshape(-1, z.shape[-1])
    found = model.places(flat)
    if found is None:
        return None
    if excess is not None and excess.shape[:-2] == z.shape[:-1]:
        found = found._replace(covariance=found.covariance + _excess_at_places(model, flat, excess))
    inverse = np.eye(model.transition.shape[0])[:, list(model.sensor.position)]
    mean = np.einsum("rk,zck->zcr", inverse, found.mean)
    spread = np.einsum("rk,zckl,sl->zcrs", inverse, found.covariance, inverse)
    covariance = spread + _hidden(inverse, inverse.T, hidden_deviation)
    batch = z.shape[:-1]
    return mean.reshape(*batch, *mean.shape[1:]), covariance.reshape(*batch, *covariance.shape[1:])


def _excess_at_places(model: SensedModel, z: Array, excess: Array) -> Array:
    """Covariance that the excess noise of measurements adds to their places, to first order. Shape (k, c, d, d).

    The sensor made the places for its own noise. Where a measurement is more exact than that nothing is subtracted:
    a part of the covariance may not come from the noise.
    """
    values, vectors = np.linalg.eigh(excess.reshape(len(z), *excess.shape[-2:]))
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    added: Array | float = 0.0
    for k in range(z.shape[1]):
        after, before = model.places(z + roots[:, :, k]), model.places(z - roots[:, :, k])
        if after is not None and before is not None:
            half = 0.5 * (after.mean - before.mean)
            added = added + half[..., :, None] * half[..., None, :]
    return np.asarray(added, dtype=np.float64)


def _matched(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """One Gaussian with the moments of c equally probable ones."""
    center = mean.mean(axis=-2)
    spread = mean - center[..., None, :]
    return center, (covariance + spread[..., :, None] * spread[..., None, :]).mean(axis=-3)


def _hidden(inverse: Array, observation: Array, deviation: ArrayLike) -> Array:
    """Covariance of the state entries that a measurement leaves open. Shape (n, n)."""
    n = len(inverse)
    blind = np.eye(n) - inverse @ observation
    spread = np.broadcast_to(np.asarray(deviation, dtype=np.float64), (n,))
    return blind @ np.diag(spread**2) @ blind.T


def observation_inverse(model: TargetModel) -> Array:
    """Pseudoinverse of the observation: from a measurement to the measured state entries. Shape (n, m)."""
    return np.asarray(np.linalg.pinv(model.packed.observation), dtype=np.float64)
