"""Every agent by name, in one table; nothing heavy is imported before an agent is created."""

from __future__ import annotations

import difflib
import importlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from servotrack.baselines.agents.learned.shipped import agent_in_file, shipped_agents
from servotrack.baselines.agents.protocol import Agent, AgentCard
from servotrack.baselines.agents.servo.cards import LAWS
from servotrack.baselines.worlds import WORLDS, load

RANDOM = AgentCard(
    "random",
    "servotrack.baselines.agents.random:RandomAgent",
    "model-free",
    "uniform actions: no skill",
    tuning_steps=0,
    worlds=frozenset(WORLDS),
)
_CARDS = [card for world in WORLDS.values() if world.cards for card in load(world.cards)]

AGENTS: dict[str, AgentCard] = {card.name: card for card in (RANDOM, *_CARDS, *shipped_agents())}
"""Every agent by name: the random one, then those of each kind of world, then the shipped learned ones."""

RENAMED: Mapping[str, str] = {"informed-bound": "informed"}
"""New names by old names, which stay for one release with a DeprecationWarning."""


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
    if base in RENAMED:
        warnings.warn(f"agent {base!r} is now called {RENAMED[base]!r}", DeprecationWarning, stacklevel=2)
        base = RENAMED[base]
        name = f"{base}{plus}{law}"
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
        agent: A name that `agent_card` takes, or a card.
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
