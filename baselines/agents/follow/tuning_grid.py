"""Values that `servotrack tune` tries for the agent that follows one person.

Every grid holds the default. The servo's own values are those of its Jacobian estimator.
"""

from __future__ import annotations

from collections.abc import Mapping

Grid = Mapping[str, tuple[float, ...]]

GRIDS: Mapping[str, Grid] = {
    "phd-servo": {
        "detection": (0.8, 0.87, 0.93, 0.97),
        "near": (15.0, 25.0, 40.0),
        "alike": (12.0, 16.0, 25.0, 40.0),
        "search_after": (15, 30, 60),
        "spreading": (30.0, 60.0, 120.0),
        "memory": (0.2, 0.4, 0.8),
        "acceleration": (30.0, 60.0, 120.0),
        "position_noise": (2.5, 5.0, 10.0),
        "color_noise": (8.0, 11.0, 16.0),
    },
}
"""Values tried, by agent and path into its `PersonFollower`."""

BORROWED: Mapping[str, str] = {
    "phd-servo-told-jacobian": "phd-servo",
    "phd-servo-told-detections": "phd-servo",
    "phd-servo-told-jacobian-detections": "phd-servo",
}
"""Agents that use the values of another agent."""
