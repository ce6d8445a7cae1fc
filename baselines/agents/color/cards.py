"""Cards of the trackers of one colored object."""

from __future__ import annotations

from typing import Any

from servotrack.baselines.agents.color.tuning_grid import tuning_steps
from servotrack.baselines.agents.protocol import TRUTH, AgentCard, Information


def _color(name: str, summary: str, information: Information = "model-free", **fields: Any) -> AgentCard:
    fields = {"parameters": {"tracker": name}, "tuning_steps": tuning_steps(name), **fields}
    return AgentCard(
        name,
        "servotrack.baselines.agents.color.observers:create_color_observer",
        information,
        summary,
        worlds=frozenset({"color"}),
        **fields,
    )


CARDS = (
    _color("monte-carlo-color", "random boxes weighted by their color histograms (Zhang and Li 2008)"),
    _color("monte-carlo-color-plus", "the same idea with gradients, spatial colors, background weights and inertia"),
    _color("color-particle-filter", "bootstrap particle filter on color histograms, second-order motion"),
    _color("kernel-mean-shift", "Comaniciu's mean shift with scales"),
    _color("opencv-meanshift", "OpenCV's mean shift on the back-projected hue"),
    _color("opencv-camshift", "OpenCV's CamShift on the back-projected hue"),
    _color("mil", "OpenCV's multiple-instance learning tracker", in_default_suite=False),
    _color("first-box", "stays where the object was first: no skill"),
    _color("box-oracle", "reports the true box", "privileged", parameters={"tracker": "true-box"}, requires=TRUTH),
)
