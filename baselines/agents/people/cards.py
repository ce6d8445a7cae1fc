"""Cards of the observers of people on video."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information


def _video(name: str, summary: str, information: Information = "structure", **fields: Any) -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.people.observers:create_video_observer",
        information,
        summary,
        parameters={"estimator": name},
        worlds=frozenset({"people"}),
        **fields,
    )


CARDS = (
    _video("kalman-hungarian", "Kalman tracks of boxes, matched by overlap (SORT)"),
    _video("gm-phd-paper", "Gaussian-mixture PHD filter with Wu and Hu 2010's Table 1"),
    _video("sort", "SORT of the package trackers", in_default_suite=False),
    _video("bytetrack", "ByteTrack of the package trackers", in_default_suite=False),
    _video("oc-sort", "OC-SORT of the package trackers", in_default_suite=False),
    _video("bot-sort", "BoT-SORT of the package trackers, without camera motion", in_default_suite=False),
    _video("c-biou", "C-BIoU of the package trackers", in_default_suite=False),
    _video("people-oracle", "reports the true boxes", "privileged", requires=TRUTH),
)
