"""Worlds: they hold the truth, draw it and score the agent."""
