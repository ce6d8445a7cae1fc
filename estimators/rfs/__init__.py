"""Filters over random finite sets: a varying number of targets in clutter, one step at a time.

    model = pairwise_structure(constant_velocity(process_noise=5.0, measurement_noise=1.5), "S1")
    tracker = Stateful(PMB(model, MeasurementBirth(), clutter_intensity=20 / 4000.0**2, detection=0.95))
    for z in measurements:  # arrays of shape (number, 2), number may be 0
        estimate = tracker.step(z)
        print(estimate.labels, estimate.states, estimate.existence)

Start with `PMB`, or with `RobustPMB` where sensor and motion are not known well; `PMBM` is the exact posterior up to
pruning and takes longer. `TrajectoryPMB` reports smoothed targets some scans late, and `RobustTrajectoryPMB` those of
an unknown sensor. `GMPHD` is the cheapest and the simplest filter; `GMCBMeMBer` is the filter of Zhang et al. 2017,
and `LMB` names targets at their birth. Each is a frozen dataclass with `initial(measurement) -> state` and
`step(state, measurement) -> (state, estimate)`, whose state is a NamedTuple of arrays. Measurements of shape (B, rows,
1 + m), existence in column 0, run B independent filters at once. `step(..., dt=, sensor=, noise=)` takes scans at
varying intervals, of other sensors, and with a noise for each measurement; `TimedTracker` takes them by their time
stamps, late ones too.
"""

from servotrack.estimators.rfs.adaptation import SensorAdaptation
from servotrack.estimators.rfs.birth import Birth, MeasurementBirth
from servotrack.estimators.rfs.cbmember import GMCBMeMBer
from servotrack.estimators.rfs.cphd import GMCPHD
from servotrack.estimators.rfs.gnn import GlobalNearestNeighbor
from servotrack.estimators.rfs.interacting import (
    InteractingModels,
    constant_acceleration,
    coordinated_turn,
    lasting,
    maneuvers,
    white_acceleration,
)
from servotrack.estimators.rfs.lmb import LMB
from servotrack.estimators.rfs.matching import match_measurements
from servotrack.estimators.rfs.mixed_births import Births
from servotrack.estimators.rfs.models import (
    STRUCTURES,
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    constant_velocity,
    definiteness_margin,
    pairwise_structure,
)
from servotrack.estimators.rfs.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn
from servotrack.estimators.rfs.phd import GMPHD
from servotrack.estimators.rfs.pmb import PMB
from servotrack.estimators.rfs.pmbm import PMBM
from servotrack.estimators.rfs.raw import RawMeasurements
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.region import RegionSurvival
from servotrack.estimators.rfs.robust_pmb import RobustPMB
from servotrack.estimators.rfs.robust_trajectory_pmb import RobustTrajectoryPMB
from servotrack.estimators.rfs.sensor_models import bearing_sensor, range_bearing_sensor, spherical_sensor
from servotrack.estimators.rfs.sensors import FunctionSensor, LinearSensor, Places
from servotrack.estimators.rfs.sets import RowAllocation, SetEstimate, measurements_to_rows, rows_to_tracks
from servotrack.estimators.rfs.smc_phd import ParticlePHD
from servotrack.estimators.rfs.spawn import Spawn
from servotrack.estimators.rfs.steered import CountingPHD, SteadyPHD, SteeredPHD, Steering
from servotrack.estimators.rfs.timed import TimedTracker
from servotrack.estimators.rfs.trajectory import Trajectory, collect_trajectories, track_scans
from servotrack.estimators.rfs.trajectory_pmb import TrajectoryPMB

__all__ = [
    "GMCPHD",
    "GMPHD",
    "LMB",
    "PMB",
    "PMBM",
    "STRUCTURES",
    "Birth",
    "Births",
    "ConstantAcceleration",
    "ConstantVelocity",
    "CoordinatedTurn",
    "CountingPHD",
    "FunctionSensor",
    "GMCBMeMBer",
    "GlobalNearestNeighbor",
    "HiddenMarkovModel",
    "InteractingModels",
    "LinearSensor",
    "MeasurementBirth",
    "PairwiseMarkovModel",
    "ParticlePHD",
    "Places",
    "RangeBearingModel",
    "RawMeasurements",
    "Reduction",
    "RegionSurvival",
    "RobustPMB",
    "RobustTrajectoryPMB",
    "RowAllocation",
    "SensorAdaptation",
    "SetEstimate",
    "Spawn",
    "SteadyPHD",
    "SteeredPHD",
    "Steering",
    "TimedTracker",
    "Trajectory",
    "TrajectoryPMB",
    "bearing_sensor",
    "collect_trajectories",
    "constant_acceleration",
    "constant_velocity",
    "coordinated_turn",
    "definiteness_margin",
    "lasting",
    "maneuvers",
    "match_measurements",
    "measurements_to_rows",
    "pairwise_structure",
    "range_bearing_sensor",
    "rows_to_tracks",
    "spherical_sensor",
    "track_scans",
    "white_acceleration",
]
