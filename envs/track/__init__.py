"""Worlds in which the agent is an observer: it answers every scan with the set of targets it believes in."""
