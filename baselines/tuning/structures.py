"""Search spaces over the structure of classical agents: random draws, small changes, and the card of a candidate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.tuning.families import family_of
from servotrack.baselines.worlds import world_of_id

Structure = dict[str, Any]
"""Description of a candidate, as JSON can hold it."""


class StructureSpace(Protocol):
    """Candidates of a search."""

    def draw(self, rng: np.random.Generator) -> Structure:
        """Draw a candidate without any knowledge of good ones."""

    def changed(self, structure: Structure, rng: np.random.Generator) -> Structure:
        """Return a candidate near another one."""

    def card(self, structure: Structure) -> AgentCard:
        """Return the card of a candidate's agent."""


@dataclass(frozen=True)
class Number:
    """Range of a number.

    Attributes:
        low: Smallest value.
        high: Largest value.
        log: True draws the logarithm uniformly.
        from_one: True describes one minus the number, for probabilities near 1.
        whole: True rounds to whole numbers.
    """

    low: float
    high: float
    log: bool = True
    from_one: bool = False
    whole: bool = False

    def draw(self, rng: np.random.Generator) -> float:
        """Draw a value uniformly."""
        return self._value(rng.uniform(0.0, 1.0))

    def near(self, value: float, rng: np.random.Generator, width: float = 0.15) -> float:
        """Draw a value near another one; `width` is a share of the range, larger values go farther."""
        value = 1.0 - value if self.from_one else value
        low, high, at = (
            (math.log(x) for x in (self.low, self.high, value)) if self.log else (self.low, self.high, value)
        )
        return self._value(float(np.clip((at - low) / (high - low) + width * rng.standard_normal(), 0.0, 1.0)))

    def _value(self, share: float) -> float:
        found = self.low * (self.high / self.low) ** share if self.log else self.low + share * (self.high - self.low)
        # Four digits: a record stays readable, and nothing depends on more.
        found = 1.0 - float(f"{found:.4g}") if self.from_one else float(f"{found:.4g}")
        return round(found) if self.whole else float(f"{found:.6g}")


_LIFTED = {
    "model_stay": Number(0.005, 0.2, from_one=True),
    "noise_stay": Number(0.004, 0.05, from_one=True),
    "encoder_noise": Number(0.0002, 0.004),
    "optics_error": Number(0.005, 0.1),
    "outlier_rate": Number(0.003, 0.1),
    "drift": Number(0.03, 1.0),
}
_KALMAN = {
    "walk.joint_noise": Number(1.0, 30.0),
    "walk.time_noise": Number(5.0, 200.0),
    "measurement_noise": Number(0.5, 15.0),
    "prior.joint_spread": Number(100.0, 800.0),
    "prior.time_spread": Number(50.0, 800.0),
}
_LAWS: Mapping[str, Mapping[str, Number]] = {
    "pi": {"law.gain": Number(0.3, 1.0, log=False), "law.integral_gain": Number(0.2, 4.0)},
    "proportional": {"law.gain": Number(0.3, 1.0, log=False)},
    "one-step": {"law.gain": Number(0.3, 1.0, log=False), "law.max_step": Number(0.05, 0.4)},
}
_PROBING = {
    "excitation.steps": Number(1, 8, log=False, whole=True),
    "excitation.amplitude": Number(0.01, 0.1),
}
_MODELS: Mapping[str, Mapping[str, Number]] = {
    "constant velocity": {"jump": Number(5.0, 1000.0)},
    "constant acceleration": {"jerk": Number(5.0, 500.0), "jump": Number(1.0, 500.0)},
    "oscillation": {"jerk": Number(2.0, 150.0), "recall": Number(0.1, 30.0)},
}
_FIXED: Mapping[str, Mapping[str, float]] = {
    # Acceleration that decays at once leaves the velocity constant between jumps.
    "constant velocity": {"jerk": 10.0, "damping": 10.0}, "constant acceleration": {}, "oscillation": {},
}  # fmt: skip
_FIRST_AGE, _LAST_AGE = Number(0.0, 0.03, log=False), Number(0.04, 0.13, log=False)
_MOST_MODELS, _MOST_AGES = 4, 5


def _model(rng: np.random.Generator) -> dict[str, Any]:
    kind = str(rng.choice(list(_MODELS)))
    return {**_FIXED[kind], **{name: number.draw(rng) for name, number in _MODELS[kind].items()}}


def _kind_of_model(model: Mapping[str, float]) -> str:
    return (
        "oscillation" if "recall" in model else "constant velocity" if "damping" in model else "constant acceleration"
    )


def _ages(rng: np.random.Generator) -> list[float]:
    """Draw the assumed ages of a frame: none in half of the draws, else a few at equal distances."""
    if rng.random() < 0.5:
        return [0.0]
    count = int(rng.integers(2, _MOST_AGES + 1))
    return [round(float(age), 4) for age in np.linspace(_FIRST_AGE.draw(rng), _LAST_AGE.draw(rng), count)]


@dataclass(frozen=True)
class ServoStructures:
    """Jacobian servos of a planar arm: filter, number and kinds of target models, ages, law, probing, all numbers.

    Half of the draws are Kalman filters of the Jacobian, half lifted ones. Source of the parts: see
    `servotrack.baselines.agents.servo.structured.structured_controller`.
    """

    def draw(self, rng: np.random.Generator) -> Structure:
        """Draw every part; see `StructureSpace.draw`."""
        kind, law = str(rng.choice(["kf", "lifted"])), str(rng.choice(list(_LAWS)))
        models = [_model(rng) for _ in range(int(rng.integers(1, _MOST_MODELS + 1)))] if kind == "lifted" else []
        found = {"filter": kind, "law": law, "models": models, "ages": _ages(rng)}
        return {**found, "values": {path: number.draw(rng) for path, number in _numbers(found).items()}}

    def changed(self, structure: Structure, rng: np.random.Generator) -> Structure:
        """Move a third of the numbers, and in a third of the calls each change models, ages or law."""
        found = {**structure, "models": [dict(model) for model in structure["models"]]}
        chosen = rng.random(3) < 1.0 / 3.0
        if chosen[0] and found["filter"] == "lifted":
            found["models"] = _changed_models(found["models"], rng)
        if chosen[1]:
            found["ages"] = _ages(rng)
        if chosen[2]:
            found["law"] = str(rng.choice(list(_LAWS)))
        for model in found["models"]:
            for name, number in _MODELS[_kind_of_model(model)].items():
                if rng.random() < 1.0 / 3.0:
                    model[name] = number.near(model[name], rng)
        old = structure["values"]
        found["values"] = {
            path: number.draw(rng) if path not in old
            else number.near(old[path], rng) if rng.random() < 1.0 / 3.0 else old[path]
            for path, number in _numbers(found).items()
        }  # fmt: skip
        return found

    def card(self, structure: Structure) -> AgentCard:
        """Return the card of a structured servo; see `StructureSpace.card`."""
        return AgentCard(
            "structured",
            "servotrack.baselines.agents.servo.structured:create_structured_servo",
            "structure" if structure["filter"] == "lifted" else "model-free",
            "a Jacobian servo whose structure was searched",
            parameters={"structure": structure},
        )


def _numbers(structure: Mapping[str, Any]) -> dict[str, Number]:
    own = _LIFTED if structure["filter"] == "lifted" else _KALMAN
    return {**own, **_LAWS[structure["law"]], **_PROBING}


def _changed_models(models: list[dict[str, float]], rng: np.random.Generator) -> list[dict[str, float]]:
    """Add, drop or replace one model."""
    at = int(rng.integers(len(models)))
    actions: list[Callable[[], list[dict[str, float]]]] = [lambda: [*models[:at], _model(rng), *models[at + 1 :]]]
    if len(models) < _MOST_MODELS:
        actions.append(lambda: [*models, _model(rng)])
    if len(models) > 1:
        actions.append(lambda: [*models[:at], *models[at + 1 :]])
    return actions[int(rng.integers(len(actions)))]()


@dataclass(frozen=True)
class GridStructures:
    """Agents with a grid in `FAMILIES`: which agent, and a value of its grid for each hyper-parameter.

    Attributes:
        env_id: Gymnasium id.
        agents: Names of the agents to choose from.
    """

    env_id: str
    agents: tuple[str, ...]

    def draw(self, rng: np.random.Generator) -> Structure:
        """Draw an agent and a value of every hyper-parameter; see `StructureSpace.draw`."""
        agent = str(rng.choice(self.agents))
        grid = family_of(agent, self.env_id).grids[agent]
        return {
            "agent": agent,
            "values": {path: choices[int(rng.integers(len(choices)))] for path, choices in grid.items()},
        }

    def changed(self, structure: Structure, rng: np.random.Generator) -> Structure:
        """Draw a third of the values anew; see `StructureSpace.changed`."""
        grid = family_of(structure["agent"], self.env_id).grids[structure["agent"]]
        values = {
            path: choices[int(rng.integers(len(choices)))] if rng.random() < 1.0 / 3.0 else structure["values"][path]
            for path, choices in grid.items()
        }
        return {**structure, "values": values}

    def card(self, structure: Structure) -> AgentCard:
        """Return the agent's card with other values; see `StructureSpace.card`."""
        card = family_of(structure["agent"], self.env_id).insert(agent_card(structure["agent"]), structure["values"])
        return replace(card, name="structured")


FOLLOWERS = ("phd-servo", "crowd-servo")
"""Classical agents that follow one person of many; their hyper-parameters have grids."""


def structures_for(env_id: str) -> StructureSpace:
    """Return the search space of classical agents in a world.

    Args:
        env_id: Gymnasium id.

    Raises:
        ValueError: A world without one.
    """
    kind = world_of_id(env_id).kind
    if kind == "servo":
        return ServoStructures()
    if kind == "follow":
        return GridStructures(env_id, FOLLOWERS)
    raise ValueError(f"env_id must be that of a planar servo or of the follow world, got {env_id!r}")
