"""Cards of the bearing trackers."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information


def _sonar(name: str, summary: str, information: Information = "calibrated", **fields: Any) -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.sonar.observers:create_sonar_observer",
        information,
        summary,
        parameters={"tracker": name},
        worlds=frozenset({"sonar"}),
        **fields,
    )


CARDS = (
    _sonar("hmm-row", "HMM track-before-detect, likelihood of the whole row with what other targets explain"),
    _sonar("hmm-cell", "HMM track-before-detect, likelihood of one cell (Jiang and Zhou 2016)"),
    _sonar("viterbi", "path of most integrated power, one target after the other, each taken out of the record"),
    _sonar("peak-nearest-neighbor", "peaks of each record, joined to the nearest track"),
    _sonar("peak-kalman-hungarian", "peaks of each record, Kalman tracks, one assignment per record"),
    _sonar("bearing-oracle", "reports the true bearings", "privileged", requires=TRUTH),
)
