"""Families of agents that `servotrack tune` can search: their environment, grids, defaults and how values are set.

To make the agents of another world tunable, give them a grid in `agents/<family>/tuning_grid.py` and add a family here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from servotrack.baselines.agents.clutter import tuning_grid as clutter_grid
from servotrack.baselines.agents.clutter.catalog import track_filter
from servotrack.baselines.agents.color import tuning_grid as color_grid
from servotrack.baselines.agents.color.catalog import color_tracker
from servotrack.baselines.agents.follow import tuning_grid as follow_grid
from servotrack.baselines.agents.hyper_parameters import value_at
from servotrack.baselines.agents.people import tuning_grid as people_grid
from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.agents.servo import tuning_grid as servo_grid
from servotrack.baselines.agents.servo.catalog import controller_path, servo_controller
from servotrack.baselines.agents.sonar import tuning_grid as sonar_grid
from servotrack.baselines.agents.sonar.catalog import sonar_tracker
from servotrack.baselines.agents.tuning_record import Values
from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.envs.track.sonar import array_model
from servotrack.envs.track.sonar.config import sonar_config
from servotrack.estimators.follow import CrowdFollower, PersonFollower
from servotrack.estimators.jacobian import ServoController

Grid = Mapping[str, Sequence[Any]]


@dataclass(frozen=True)
class TuningFamily:
    """Agents that are tuned in one environment.

    Attributes:
        env_id: Gymnasium id.
        levels: Levels of the environment that every setting is measured on.
        grids: Values tried, by agent and hyper-parameter.
        create: Creates the estimator of an agent with its default values.
        insert: Returns a card whose agent is created with other values.
        borrowed: Agents that use the values of another agent.
        untuned: Agents that have nothing to tune.
        path: Path into what `create` returns, of a path in the grids.
    """

    env_id: str
    levels: tuple[int, ...]
    grids: Mapping[str, Grid]
    create: Callable[[str], object]
    insert: Callable[[AgentCard, Values], AgentCard]
    borrowed: Mapping[str, str] = field(default_factory=dict)
    untuned: frozenset[str] = frozenset()
    path: Callable[[str], str] = str

    def default_values(self, agent: str) -> Values:
        """Return the default of each hyper-parameter in an agent's grid."""
        estimator = self.create(agent)
        return {path: value_at(estimator, self.path(path)) for path in self.grids[agent]}


def _as_mapping(card: AgentCard, values: Values) -> AgentCard:
    return replace(card, parameters={**card.parameters, "values": values})


def _as_keywords(card: AgentCard, values: Values) -> AgentCard:
    return replace(card, parameters={**card.parameters, **values})


def _controller(agent: str) -> ServoController:
    return servo_controller(agent, agent_card(agent).parameters["law"], 1.0)


FAMILIES = (
    TuningFamily(
        "UncalibServo-v0",
        (0, 1, 2, 3, 4, 5),
        servo_grid.GRIDS,
        _controller,
        _as_mapping,
        servo_grid.BORROWED,
        servo_grid.UNTUNED,
        controller_path,
    ),
    TuningFamily("UncalibServo-v0", (6,), servo_grid.UNSTAMPED_GRIDS, _controller, _as_mapping, path=controller_path),
    TuningFamily(
        "ClutterTracking-v0",
        (0, 1, 2, 3, 4, 5, 6, 7),
        clutter_grid.GRIDS,
        # The searched defaults are those of the filters' classes, the same at every level.
        lambda agent: track_filter(agent, scene_model_of(clutter_config(0))),
        _as_mapping,
        clutter_grid.BORROWED,
    ),
    TuningFamily("ColorTracking-v0", tuple(range(8)), color_grid.GRIDS, color_tracker, _as_keywords),
    TuningFamily(
        "SonarTracking-v0",
        (0, 1, 2, 3, 4, 5),
        sonar_grid.GRIDS,
        lambda agent: sonar_tracker(agent, array_model.scene_model_of(sonar_config(0))),
        _as_mapping,
    ),
    TuningFamily("PedestrianTracking-v0", (0, 1, 2, 3, 4, 5), people_grid.GRIDS, create_tracker, _as_mapping),
    TuningFamily(
        "PedestrianServo-v0",
        (0, 1, 2, 3, 4, 5, 6),
        follow_grid.GRIDS,
        lambda agent: PersonFollower(),
        _as_mapping,
        follow_grid.BORROWED,
    ),
    TuningFamily(
        "PedestrianServo-v0",
        (0, 1, 2, 3, 4, 5, 6),
        follow_grid.CROWD_GRIDS,
        lambda agent: CrowdFollower(),
        _as_mapping,
    ),
)
"""All families. Where two of them hold an agent of the same name, the first is the default."""


def family_of(agent: str, env_id: str | None = None) -> TuningFamily:
    """Return the family whose grids hold an agent.

    Args:
        agent: Name of the agent.
        env_id: Environment of the family; None for the first family that holds the agent.

    Raises:
        ValueError: An unknown agent, one without a grid, or an environment in which it is not tuned.
    """
    agent_card(agent)
    holding = [family for family in FAMILIES if agent in family.grids]
    if found := next((family for family in holding if env_id in (None, family.env_id)), None):
        return found
    if holding:
        raise ValueError(
            f"env_id must be {' or '.join(family.env_id for family in holding)} for agent {agent!r}, got {env_id!r}"
        )
    lenders = [family.borrowed[agent] for family in FAMILIES if agent in family.borrowed]
    reason = f"it uses the values of {lenders[0]}" if lenders else "nothing of it can be tuned"
    known = ", ".join(dict.fromkeys(name for family in FAMILIES for name in family.grids))
    raise ValueError(f"agent {agent!r} has no values of its own to tune ({reason}); choose of {known}")


def common_family(agents: Sequence[str], env_id: str | None = None) -> TuningFamily:
    """Return the family of several agents.

    Args:
        agents: Names of the agents.
        env_id: Environment of the family; None for the first family that holds all the agents.

    Raises:
        ValueError: An unknown agent, one without a grid, or agents of different families.
    """
    first = {agent: family_of(agent, env_id) for agent in agents}
    for family in FAMILIES:
        if agents and all(agent in family.grids for agent in agents) and env_id in (None, family.env_id):
            return family
    found = dict.fromkeys(family.env_id for family in first.values())
    raise ValueError(
        f"agents must be at least one, all tuned in the same environment, got {', '.join(agents) or 'none'} "
        f"({', '.join(found) or 'no environment'}); run `servotrack tune` once for each environment"
    )
