"""Values that `servotrack tune` tries for the trackers of bearings.

Every grid holds the tracker's default. Array, band, period and lag come from the environment's `SonarModel` and are not
searched.
"""

from __future__ import annotations

from collections.abc import Mapping

Grid = Mapping[str, tuple[float, ...]]

_CHAIN: Grid = {
    "acceleration": (0.1, 0.2, 0.3, 0.5),
    "switching": (0.005, 0.01, 0.02, 0.05),
    "bridge": (3.0, 6.0, 12.0),
}

GRIDS: Mapping[str, Grid] = {
    "hmm-row": {
        **_CHAIN,
        "evidence": (5.0, 10.0, 20.0),
        "evidence_of_piece": (2.0, 4.0, 8.0),
        "model_error": (0.1, 0.15, 0.25),
        "power_spread": (0.2, 0.3, 0.5),
        "likelihood_rules.miss_probability": (0.01, 0.02, 0.05),
    },
    "hmm-cell": {**_CHAIN, "evidence": (5.0, 10.0, 20.0), "likelihood_rules.cell_amplitude": (2.0, 3.0, 4.0)},
    "viterbi": {**_CHAIN, "evidence": (20.0, 40.0, 80.0), "width": (2.0, 3.0, 4.5)},
    "peak-nearest-neighbor": {
        "threshold": (3.0, 4.0, 5.0, 6.0),
        "confirm": (2, 3, 4, 6),
        "misses": (2, 4, 6, 8),
        "gate": (1.5, 3.0, 4.5),
    },
    "peak-kalman-hungarian": {
        "threshold": (3.0, 4.0, 5.0, 6.0),
        "confirm": (2, 3, 4, 6),
        "misses": (2, 4, 6, 8),
        "acceleration": (0.05, 0.1, 0.2),
        "noise": (0.15, 0.3, 0.6),
        "gate": (3.0, 4.0, 5.0),
    },
}
"""Values tried, by agent and path into its tracker."""
