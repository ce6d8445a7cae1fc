"""What the agents of a sonar world are told about it."""

from __future__ import annotations

from typing import NamedTuple

from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.estimators.sonar.array import Band, LineArray
from servotrack.estimators.types import Array


class SonarModel(NamedTuple):
    """What agents are told: their own receiver, and nothing of who is out there.

    Attributes:
        array: Elements, spacing, speed of sound.
        band: Frequencies that are summed over.
        shading: Of the elements.
        beam_bearings: Look directions of the beams, shape (beams,), deg.
        averages: M, bins times snapshots: noise has a relative variance of 1/M.
        period: Time between records, s.
        lag: An answer is for the record this many before the newest.
        cutoff: Of the scores, deg.
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
    """What the agents of a world are told about it."""
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
