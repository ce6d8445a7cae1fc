"""Tracking environments: the agent answers every observation with an estimate of the set of targets."""
