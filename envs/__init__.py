"""Environments: simulated worlds with ground truth, rendering and scores."""

from servotrack.envs.flat_sets import FlatSets, VectorFlatSets

__all__ = ["FlatSets", "VectorFlatSets"]
