"""Agents made of estimators or networks, and what trains, evaluates and ranks them."""
