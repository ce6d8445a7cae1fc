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

CROWD_GRIDS: Mapping[str, Grid] = {
    "crowd-servo": {
        "detection": (0.76, 0.82, 0.88, 0.94),
        "births": (0.05, 0.2, 0.5),
        "position_noise": (3.0, 4.0, 5.0, 6.0),
        "color_noise": (7.0, 9.0, 12.0),
        "show_rate": (0.4, 0.8, 1.2),
        "turn_rate": (0.15, 0.3, 0.6),
        "lose_rate": (0.01, 0.03, 0.1),
    },
}
"""Values tried, by agent and path into its `CrowdFollower`."""

BORROWED: Mapping[str, str] = {
    "phd-servo-told-jacobian": "phd-servo",
    "phd-servo-told-detections": "phd-servo",
    "phd-servo-told-jacobian-detections": "phd-servo",
}
"""Agents that use the values of another agent."""
