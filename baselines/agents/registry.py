"""Every agent by name, in one table; nothing heavy is imported before an agent is created."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

from servotrack.baselines.agents.color.tuning_grid import tuning_steps
from servotrack.baselines.agents.learned.shipped import agent_in_file, shipped_agents
from servotrack.baselines.agents.protocol import Agent, AgentCard, Information, World
from servotrack.baselines.agents.tuning_record import shipped_tuning_steps

DEFAULT_LAW = "pi"
LAWS = (DEFAULT_LAW, "proportional", "damped", "one-step")


def _servo(name: str, information: Information, summary: str, law: str = DEFAULT_LAW, **fields: Any) -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.servo.catalog:create_servo_agent",
        information,
        summary,
        parameters={"estimator": name, "law": law},
        laws=True,
        tuning_steps=shipped_tuning_steps(name),
        **fields,
    )


_TRUTH = frozenset({"truth"})
_CLUTTER: frozenset[World] = frozenset({"clutter"})
_SETS: dict[str, Any] = {
    "worlds": frozenset({"clutter", "video"}),
    # In clutter the very sensor is told; on video nothing but what people are like.
    "information_in": {"video": "structure"},
}


def _observer(name: str, summary: str, information: Information = "calibrated", **fields: Any) -> AgentCard:
    estimator = name.removesuffix("-hmm")
    parameters: dict[str, Any] = {"estimator": estimator}
    if estimator != name:
        parameters["hidden_markov"] = True
    return AgentCard(
        name,
        "servotrack.baselines.agents.clutter.observers:create_observer",
        information,
        summary,
        parameters=parameters,
        **{"worlds": _CLUTTER, **fields},
    )


def _video(name: str, summary: str, information: Information = "structure", **fields: Any) -> AgentCard:
    return AgentCard(
        name,
        "servotrack.baselines.agents.people.observers:create_video_observer",
        information,
        summary,
        parameters={"estimator": name},
        worlds=frozenset({"video"}),
        **fields,
    )


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


def _follow(name: str, summary: str, information: Information = "structure", **parameters: Any) -> AgentCard:
    told = bool(parameters.get("told"))
    return AgentCard(
        name,
        "servotrack.baselines.agents.follow.catalog:create_follow_agent",
        "privileged" if told else information,
        summary,
        parameters=parameters,
        requires=_TRUTH if told else frozenset(),
        worlds=frozenset({"follow"}),
    )


_TOLD = ("identity", "jacobian", "detections")


def _ablation() -> tuple[AgentCard, ...]:
    """The follower with every combination of its parts told by an oracle."""
    kinds = sorted(product((False, True), repeat=len(_TOLD)), key=sum)
    chosen = [tuple(part for part, told in zip(_TOLD, kind, strict=True) if told) for kind in kinds if any(kind)]
    return tuple(
        _follow(f"phd-servo-told-{'-'.join(told)}", f"the same, told {', '.join(told)}", told=told) for told in chosen
    )


_CARDS = (
    AgentCard(
        "random",
        "servotrack.baselines.agents.random:RandomAgent",
        "model-free",
        "uniform actions: no skill",
        tuning_steps=0,
        worlds=frozenset(get_args(World)),
    ),
    _servo("fixed-jacobian", "model-free", "the Jacobian found by probing at the start, never updated"),
    _servo("broyden", "model-free", "Broyden's rank-one update"),
    _servo("rls", "model-free", "recursive least squares with forgetting"),
    _servo("kf", "model-free", "Kalman filter of the total Jacobian"),
    _servo("ukf", "model-free", "unscented Kalman filter (paper 002, noise blocks as its text defines them)"),
    _servo("ukf-as-printed", "model-free", "unscented Kalman filter with the noise blocks as eq. (21) prints them"),
    _servo("pf", "model-free", "particle filter"),
    _servo("level-kf", "model-free", "Kalman filter that measures the features themselves, not their differences"),
    _servo("student-t-kf", "model-free", "Kalman filter with a Student-t gain"),
    _servo("correntropy-kf", "model-free", "maximum-correntropy Kalman filter"),
    _servo("parametric-ekf", "structure", "extended Kalman filter of the arm's and camera's parameters, mounting bank"),
    _servo("parametric-ukf", "structure", "unscented Kalman filter of the same parameters, mounting bank"),
    _servo("lifted-kf", "structure", "Kalman filter of the lifted planar arm, targets of any swing", law="one-step"),
    _servo("lifted-kf-swinging", "prior", "the same, told that targets swing at 0.5 to 1.5 rad/s", law="one-step"),
    _servo("latency-bank-kf", "model-free", "Kalman filters, one per hypothesis on the unstamped latency"),
    _servo(
        "latency-bank-lifted-kf",
        "structure",
        "lifted Kalman filters, one per hypothesis on the unstamped latency",
        law="one-step",
    ),
    _servo("oracle", "privileged", "the analytic Jacobian: the upper anchor of every score", requires=_TRUTH),
    _servo(
        "informed-bound",
        "privileged",
        "told camera, links and latency, but not the future",
        law="one-step",
        requires=_TRUTH,
    ),
    _observer("gm-phd", "Gaussian-mixture PHD filter, pairwise Markov where the noises depend on each other", **_SETS),
    _observer("gm-phd-hmm", "Gaussian-mixture PHD filter that takes the noises for independent"),
    _observer("gm-phd-anywhere", "the same filter, that also expects a few births anywhere", in_default_suite=False),
    _observer(
        "gm-phd-counting",
        "the same filter, its detection probability and clutter from what it counts, births anywhere",
        in_default_suite=False,
    ),
    _observer("gm-cbmember", "cardinality-balanced multi-Bernoulli filter (paper 004)", **_SETS),
    _observer("gm-cbmember-hmm", "the same with the noises taken for independent"),
    _observer("pmb", "track-oriented Poisson multi-Bernoulli filter with belief propagation", **_SETS),
    _observer("pmb-hmm", "the same with the noises taken for independent"),
    _observer("smc-phd", "particle PHD filter with k-means extraction"),
    _observer("gnn", "Kalman tracks, nearest neighbors by one assignment, 3-of-5 confirmation"),
    _observer("gnn-hmm", "the same with the noises taken for independent"),
    _observer("raw-measurements", "reports every measurement as a target", "model-free", worlds=_SETS["worlds"]),
    _observer("association-oracle", "told which measurement is whose: Kalman filters", "privileged", requires=_TRUTH),
    _video("kalman-hungarian", "Kalman tracks of boxes, matched by overlap (SORT)"),
    _video("gm-phd-paper", "Gaussian-mixture PHD filter with paper 000's Table 1"),
    _video("sort", "SORT of the package trackers", in_default_suite=False),
    _video("bytetrack", "ByteTrack of the package trackers", in_default_suite=False),
    _video("oc-sort", "OC-SORT of the package trackers", in_default_suite=False),
    _video("bot-sort", "BoT-SORT of the package trackers, without camera motion", in_default_suite=False),
    _video("c-biou", "C-BIoU of the package trackers", in_default_suite=False),
    _video("people-oracle", "reports the true boxes", "privileged", requires=_TRUTH),
    _color("monte-carlo-color", "random boxes weighted by their color histograms (paper 001)"),
    _color("monte-carlo-color-plus", "the same idea with gradients, spatial colors, background weights and inertia"),
    _color("color-particle-filter", "bootstrap particle filter on color histograms, second-order motion"),
    _color("kernel-mean-shift", "Comaniciu's mean shift with scales"),
    _color("opencv-meanshift", "OpenCV's mean shift on the back-projected hue"),
    _color("opencv-camshift", "OpenCV's CamShift on the back-projected hue"),
    _color("mil", "OpenCV's multiple-instance learning tracker", in_default_suite=False),
    _color("first-box", "stays where the object was first: no skill"),
    _color("box-oracle", "told the true box", "privileged", parameters={"tracker": "true-box"}, requires=_TRUTH),
    _sonar("hmm-row", "HMM track-before-detect, likelihood of the whole row with what other targets explain"),
    _sonar("hmm-cell", "HMM track-before-detect, likelihood of one cell (paper 003)"),
    _sonar("viterbi", "path of most integrated power, one target after the other, each taken out of the record"),
    _sonar("peak-nearest-neighbor", "peaks of each record, joined to the nearest track"),
    _sonar("peak-kalman-hungarian", "peaks of each record, Kalman tracks, one assignment per record"),
    _sonar("bearing-oracle", "told the true bearings", "privileged", requires=_TRUTH),
    _follow("phd-servo", "GM-PHD of everybody with colors, lifted Kalman servo on the one to follow"),
    _follow(
        "nearest-servo", "nearest detection to the last one, Kalman filter servo", "model-free", identity="nearest"
    ),
    *_ablation(),
)

AGENTS: dict[str, AgentCard] = {card.name: card for card in (*_CARDS, *shipped_agents())}


def agent_card(name: str) -> AgentCard:
    """The card of an agent.

    Args:
        name: A registered name, one with a control law ("kf+pi"), the .json or .onnx file of a learned agent, or
            "module:callable" for an agent of your own. The callable gets the environment and returns an `Agent`; it may
            carry the attributes `information`, `requires` and `tuning_steps`.

    Raises:
        ValueError: Nothing has that name; the message suggests the nearest one.
        AgentFileError: A file of a learned agent that cannot be used.
    """
    if name.endswith((".json", ".onnx")):
        return agent_in_file(Path(name))
    if ":" in name:
        return _foreign_card(name)
    base, plus, law = name.partition("+")
    if base not in AGENTS:
        raise ValueError(f"no agent is called {base!r}{_suggestion(base, tuple(AGENTS))}")
    card = AGENTS[base]
    if not plus:
        return card
    if not card.laws:
        raise ValueError(f"agent {base!r} has no control law to choose, got {name!r}; use {base!r}")
    if law not in LAWS:
        raise ValueError(f"no control law is called {law!r}{_suggestion(law, LAWS)}")
    if law == card.parameters["law"]:
        return card
    return replace(card, name=name, summary=f"{card.summary}; {law} law", parameters={**card.parameters, "law": law})


def create_agent(agent: str | AgentCard, env: Any) -> Agent:
    """Make an agent for an environment; it reads the environment's spaces and public attributes, nothing else.

    Args:
        agent: What `agent_card` takes, or a card.
        env: A Gymnasium environment or vector environment.

    Raises:
        ValueError: An unknown name, or an agent that does not fit the environment.
    """
    card = agent if isinstance(agent, AgentCard) else agent_card(agent)
    made = _load(card.factory)(env, **card.parameters)
    if not callable(getattr(made, "predict", None)):
        raise ValueError(
            f"agent {card.name!r} must have predict(observation, state, episode_start, deterministic), "
            f"got {type(made).__name__}; return an object that has it"
        )
    return made


def _foreign_card(name: str) -> AgentCard:
    factory = _load(name)
    return AgentCard(
        name=name,
        factory=name,
        information=getattr(factory, "information", "undeclared"),
        summary=(factory.__doc__ or name).strip().splitlines()[0],
        requires=frozenset(getattr(factory, "requires", ())),
        tuning_steps=getattr(factory, "tuning_steps", None),
    )


def _load(path: str) -> Callable[..., Any]:
    module_name, _, attribute = path.partition(":")
    try:
        found = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"agent {path!r} cannot be imported ({error}); give module:callable") from error
    if not callable(found):
        raise ValueError(f"agent {path!r} must be callable with the environment, got {type(found).__name__}")
    return found


def _suggestion(name: str, known: tuple[str, ...]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
