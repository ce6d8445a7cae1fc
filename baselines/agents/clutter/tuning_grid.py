"""Values that `servotrack tune` tries for the observers of points in clutter.

Every grid holds the filter's default. Detection, survival, clutter and births come from the environment's `SceneModel`
and are not searched; capacities are budgets of time.
"""

from __future__ import annotations

from collections.abc import Mapping

Grid = Mapping[str, tuple[float, ...]]

_MIXTURE: Grid = {
    "threshold": (0.3, 0.4, 0.5, 0.6, 0.7),
    "reduction.prune": (1e-6, 1e-5, 1e-4, 1e-3),
    "reduction.merge": (1.0, 2.0, 4.0, 8.0),
}
_TRACKS: Grid = {**_MIXTURE, "reduction.existence": (1e-4, 1e-3, 1e-2)}

GRIDS: Mapping[str, Grid] = {
    "gm-phd": _MIXTURE,
    "gm-cbmember": _TRACKS,
    "pmb": _TRACKS,
    "robust-pmb": {
        **_TRACKS,
        "adaptation.memory": (20.0, 50.0, 100.0),
        "adaptation.target_trust": (2.0, 5.0, 20.0),
    },
    "pmbm": {**_MIXTURE, "recycle": (0.01, 0.03, 0.1, 0.3), "least_weight": (1e-7, 1e-6, 1e-5, 1e-4)},
    "gnn": {"gate_probability": (0.99, 0.999, 0.9999), "misses": (2, 3, 4, 6, 8)},
}
"""Values tried, by agent and path into its estimator."""

BORROWED: Mapping[str, str] = {
    "gm-phd-hmm": "gm-phd",
    "gm-cbmember-hmm": "gm-cbmember",
    "pmb-hmm": "pmb",
    "trajectory-pmb": "pmb",
    "gnn-hmm": "gnn",
}
"""Agents that use the values of another agent."""
