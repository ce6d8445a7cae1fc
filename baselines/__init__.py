"""Agents made of estimators or networks, and what trains, evaluates and ranks them."""

from servotrack.baselines.agents.registry import agent_card, create_agent

__all__ = ["agent_card", "create_agent"]
