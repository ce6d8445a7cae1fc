"""The scene model that agents of the sonar environment get: receiver, beams and lag."""

from __future__ import annotations

from typing import NamedTuple

from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.estimators.sonar.array import Band, LineArray
from servotrack.estimators.types import Array


class SonarModel(NamedTuple):
    """Model that agents get. It describes only the receiver; it contains nothing about the targets.

    Attributes:
        array: Line array: number of elements, spacing, speed of sound.
        band: Frequency bins that a beam power sums over.
        shading: Weighting of the elements.
        beam_bearings: Look directions of the beams, shape (beams,), deg.
        averages: Number of averages M = bins * snapshots of a beam power. The relative variance of noise is 1/M.
        period: Time between records, s.
        lag: Delay of answers, records: the answer to record k is for record k - lag.
        cutoff: Cut-off c of the scores, deg.
    """

    array: LineArray
    band: Band
    shading: str
    beam_bearings: Array
    averages: int
    period: float
    lag: int
    cutoff: float


def scene_model_of(config: SonarConfig) -> SonarModel:
    """Return the scene model of an environment with these parameters."""
    return SonarModel(
        array=config.array,
        band=config.band,
        shading=config.shading,
        beam_bearings=config.beam_bearings,
        averages=config.averages,
        period=config.period,
        lag=config.lag,
        cutoff=config.cutoff,
    )
