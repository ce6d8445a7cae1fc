"""Arrays of a fixed size for a number of targets that is not known: grow where the caller set no cap, else warn."""

from __future__ import annotations

import warnings

import numpy as np

from servotrack.estimators.rfs.bernoulli import Tracks
from servotrack.estimators.rfs.mixture import Mixture
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import HELD, REPORTED
from servotrack.estimators.types import Array


def tracks_outgrew(rules: Reduction, tracks: Tracks, pool: Mixture) -> bool:
    """Return True if a step has to be repeated with larger arrays because these are full.

    Args:
        rules: Caps of the filter.
        tracks: Tracks after the step, the most probable first.
        pool: Components of the tracks.

    Warns:
        UserWarning: The arrays are full and the caller's cap keeps them from growing, so that identities were removed.
    """
    full_tracks = tracks.number >= tracks.existence.shape[1]
    full = full_tracks | (pool.number >= pool.weight.shape[1])
    if not np.count_nonzero(full):
        return False
    if rules.tracks is None and (rules.pool is None or full_tracks.any()):
        return True
    last = np.maximum(tracks.number - 1, 0)
    weakest = tracks.existence[np.arange(len(last)), last]
    if np.any(full & (weakest >= HELD)):
        warn_of_cap("tracks or pool of reduction", "tracks")
    return False


def intensity_outgrew(rules: Reduction, intensity: Mixture, missed: Array) -> bool:
    """Return True if a step has to be repeated because the cap on components removed half a target.

    Args:
        rules: Caps of the filter.
        intensity: Components after the step.
        missed: Expected number of targets that pruning and the cap removed. Shape (B,).

    Warns:
        UserWarning: The cap removed them, and the caller's cap keeps the arrays from growing.
    """
    if not np.any((intensity.number >= intensity.weight.shape[1]) & (missed >= REPORTED)):
        return False
    if rules.components is None:
        return True
    warn_of_cap("components of reduction", "components")
    return False


def undetected_outgrew(
    cap: int | None, rules: Reduction, predicted: Mixture, detection: Array, undetected: Mixture
) -> bool:
    """Return True if a step has to be repeated because the cap on undetected targets removed some.

    Args:
        cap: Cap that the caller set on the components; None for none.
        rules: Caps and thresholds of the filter.
        predicted: Undetected targets before the step.
        detection: Detection probability of each of their components. Shape (B, K).
        undetected: Undetected targets after the step.

    Warns:
        UserWarning: The cap removed them, and the caller's cap keeps the arrays from growing.
    """
    full = undetected.number >= undetected.weight.shape[1]
    if not np.count_nonzero(full):
        return False
    used = np.arange(predicted.weight.shape[1]) < predicted.number[:, None]
    left = np.where(used, predicted.weight, 0.0) * (1.0 - detection)
    kept = np.arange(undetected.weight.shape[1]) < undetected.number[:, None]
    removed = np.where(left > rules.prune, left, 0.0).sum(axis=1) - np.where(kept, undetected.weight, 0.0).sum(axis=1)
    if not np.any(full & (removed >= HELD)):
        return False
    if cap is None:
        return True
    warn_of_cap("undetected", "components")
    return False


def warn_of_cap(name: str, cut: str) -> None:
    """Warn that a cap removes something, in words that are the same every time so that Python shows them once."""
    warnings.warn(
        f"the cap on {name} removes {cut} of targets that may exist; raise it, or pass None to let the arrays grow",
        UserWarning,
        stacklevel=5,
    )
