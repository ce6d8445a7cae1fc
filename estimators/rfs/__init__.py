"""Filters over random finite sets: a varying number of targets in clutter, one step at a time."""

from servotrack.estimators.rfs.birth import Birth, MeasurementBirth, Spawn
from servotrack.estimators.rfs.cbmember import GMCBMeMBer
from servotrack.estimators.rfs.gnn import GlobalNearestNeighbor
from servotrack.estimators.rfs.models import (
    STRUCTURES,
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    constant_velocity,
    definiteness_margin,
    pairwise_structure,
)
from servotrack.estimators.rfs.phd import GMPHD
from servotrack.estimators.rfs.pmb import PMB
from servotrack.estimators.rfs.raw import RawMeasurements
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import RowAllocation, SetEstimate, measurements_to_rows, rows_to_tracks
from servotrack.estimators.rfs.smc_phd import ParticlePHD

__all__ = [
    "GMPHD",
    "PMB",
    "STRUCTURES",
    "Birth",
    "GMCBMeMBer",
    "GlobalNearestNeighbor",
    "HiddenMarkovModel",
    "MeasurementBirth",
    "PairwiseMarkovModel",
    "ParticlePHD",
    "RangeBearingModel",
    "RawMeasurements",
    "Reduction",
    "RowAllocation",
    "SetEstimate",
    "Spawn",
    "constant_velocity",
    "definiteness_margin",
    "measurements_to_rows",
    "pairwise_structure",
    "rows_to_tracks",
]
