"""Births at known places and at unexplained measurements together: their intensities add."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.rfs.birth import Birth, BirthMixture, MeasurementBirth


@dataclass(frozen=True, eq=False)
class Births:
    """Births at known places, and a few at the last measurements for targets that appear elsewhere.

    The sum of two Poisson processes is a Poisson process whose intensity is the sum (the multi-Bernoulli filters take
    the terms as further Bernoullis).

    Args:
        sites: Births at known places.
        anywhere: Births at unexplained measurements. Raising its `expected` finds targets away from the sites sooner
            and reports more clutter.

    Raises:
        ValueError: An argument has another type.
    """

    sites: Birth
    anywhere: MeasurementBirth

    def __post_init__(self) -> None:
        if not isinstance(self.sites, Birth):
            raise ValueError(f"sites must be a Birth, got {type(self.sites).__name__}")
        if not isinstance(self.anywhere, MeasurementBirth):
            raise ValueError(f"anywhere must be a MeasurementBirth, got {type(self.anywhere).__name__}")


def join_births(sites: BirthMixture, others: BirthMixture) -> BirthMixture:
    """Append births of each run, (B, K, ...), to births that all runs share, (1, S, ...)."""
    batch = len(others.weight)
    joined = (
        np.concatenate([np.broadcast_to(shared, (batch, *shared.shape[1:])), own], axis=1)
        for shared, own in zip(sites, others, strict=True)
    )
    return BirthMixture(*joined)
