"""Values that `servotrack tune` tries for the trackers of people.

Every grid holds the tracker's default. Quantities that follow from frame size and frame rate, and the detectors, are
not searched; the paper's setting and trackers of other packages keep their authors' values.
"""

from __future__ import annotations

from collections.abc import Mapping

Grid = Mapping[str, tuple[float, ...]]

_IDENTITIES: Grid = {"similarity": (0.5, 0.6, 0.7, 0.8), "reach": (0.15, 0.3, 0.6)}
_MIXTURE: Grid = {
    "tracker.filter.threshold": (0.3, 0.4, 0.5, 0.6, 0.7),
    "tracker.filter.reduction.merge": (2.0, 4.0, 8.0),
}

GRIDS: Mapping[str, Grid] = {
    "pmb": {
        "detection": (0.7, 0.8, 0.9),
        "miss_half_life": (0.06, 0.12, 0.24),
        "clutter_log_density": (-2.0, -0.5, 1.0),
        "birth": (0.6, 0.9, 0.97),
        "memory": (1.0, 2.0, 4.0),
        "acceleration": (0.12, 0.25, 0.5),
        "position_noise": (0.045, 0.065, 0.09),
        "appearance": (3.0, 6.0, 12.0),
    },
    "gm-phd": {**_IDENTITIES, **_MIXTURE, "tracker.filter.reduction.prune": (1e-4, 1e-3, 1e-2)},
    "gm-cbmember": {**_IDENTITIES, **_MIXTURE, "tracker.filter.reduction.existence": (1e-3, 1e-2, 1e-1)},
    "kalman-hungarian": {
        "overlap": (0.05, 0.1, 0.2, 0.3),
        "confirm": (1, 2, 3, 5),
        "misses": (4, 8, 16, 30),
        "acceleration": (0.15, 0.3, 0.6),
        "position_noise": (0.04, 0.08, 0.16),
    },
}
"""Values tried, by agent and path into its tracker."""

SEARCHED: Mapping[str, float] = {
    "acceleration": 0.3,
    "drift": 0.3,
    "position_noise": 0.2,
    "size_noise": 0.2,
    "speed": 0.3,
    "learning.return_rate": 0.4,
    "clutter_log_density": 1.0,
    "score_weight": 0.3,
    "detection": 0.07,
    "miss_half_life": 0.4,
    "memory": 0.3,
    "velocity_memory": 0.4,
    "overlap": 0.3,
    "report": 0.1,
}
"""Parameters of `pmb` that `people_search` changes, and the standard deviation of the logarithm of a change."""
