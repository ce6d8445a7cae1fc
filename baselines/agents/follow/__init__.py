"""Agents that keep one person of a crowd centered."""
