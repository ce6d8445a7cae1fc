"""Environments: simulated worlds with ground truth, rendering and scores."""

from servotrack.envs.flat_sets import FlatSets, VectorFlatSets
from servotrack.envs.goal_observation import GoalObservation

__all__ = ["FlatSets", "GoalObservation", "VectorFlatSets"]
