"""Cards of the observers of points in clutter. Set filters also observe people on video."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information

_SETS: dict[str, Any] = {
    "worlds": frozenset({"clutter", "people"}),
    # In clutter the parameters of the very sensor are known, on video only typical ones of people.
    "information_in": {"people": "structure"},
}


def _observer(name: str, summary: str, information: Information = "calibrated", **fields: Any) -> AgentCard:
    estimator = name.removesuffix("-hmm")
    parameters: dict[str, Any] = {"estimator": estimator}
    if estimator != name:
        parameters["hidden_markov"] = True
    return AgentCard(
        name,
        "servotrack.baselines.agents.tracking:create_observer",
        information,
        summary,
        parameters=parameters,
        **{"worlds": frozenset({"clutter"}), **fields},
    )


CARDS = (
    _observer("gm-phd", "Gaussian-mixture PHD filter, pairwise Markov if the noises are dependent", **_SETS),
    _observer("gm-phd-hmm", "Gaussian-mixture PHD filter that assumes independent noises"),
    _observer("gm-phd-anywhere", "the same filter with a few additional births anywhere", in_default_suite=False),
    _observer(
        "gm-phd-counting",
        "the same filter, detection probability and clutter estimated from counts, births anywhere",
        in_default_suite=False,
    ),
    _observer(
        "gm-cphd",
        "cardinalized PHD filter: the distribution of the number of targets beside the intensity",
        in_default_suite=False,
    ),
    _observer("gm-cbmember", "cardinality-balanced multi-Bernoulli filter (Zhang et al. 2017)", **_SETS),
    _observer("gm-cbmember-hmm", "the same, assuming independent noises"),
    _observer("pmb", "track-oriented Poisson multi-Bernoulli filter with belief propagation", **_SETS),
    _observer("pmb-hmm", "the same, assuming independent noises"),
    _observer(
        "robust-pmb",
        "PMB that estimates detection probability and clutter, follows maneuvers, and expects births anywhere; "
        "the choice for levels 2 to 7",
    ),
    _observer("pmbm", "Poisson multi-Bernoulli mixture filter: the exact posterior up to pruning"),
    _observer(
        "trajectory-pmb",
        "PMB with smoothed trajectories, as late as the world's lag allows; equal to pmb without a lag",
        in_default_suite=False,
    ),
    _observer(
        "robust-trajectory-pmb",
        "smoothed trajectories with the sensor and births that robust-pmb estimates beside them, as late as the "
        "world's lag allows",
        in_default_suite=False,
    ),
    _observer("smc-phd", "particle PHD filter with k-means extraction"),
    _observer("gnn", "Kalman tracks, nearest neighbors by one assignment, 3-of-5 confirmation"),
    _observer("gnn-hmm", "the same, assuming independent noises"),
    _observer("raw-measurements", "reports every measurement as a target", "model-free", worlds=_SETS["worlds"]),
    _observer("association-oracle", "Kalman filters with known data association", "privileged", requires=TRUTH),
)
