"""Worlds: they hold the truth, draw it and score the agent."""

from servotrack.envs.flat_sets import FlatSets, VectorFlatSets

__all__ = ["FlatSets", "VectorFlatSets"]
