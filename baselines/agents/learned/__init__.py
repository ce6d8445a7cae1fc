"""Agents that learned: what they see, how they are trained, and how they are shipped and run without torch."""
