"""What every agent is: something that speaks Stable-Baselines3's `predict`, and a card that says what it was told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

from numpy.typing import NDArray

from servotrack.estimators.types import Mask

Observation: TypeAlias = "NDArray[Any] | Mapping[str, NDArray[Any]]"

Information = Literal["model-free", "structure", "prior", "calibrated", "privileged", "undeclared"]
"""What an agent was told: nothing; the model's structure; the randomization's ranges; this very system; the truth."""

TRUTH = frozenset({"truth"})
"""Value of `requires` for agents that see the truth."""


@runtime_checkable
class Agent(Protocol):
    """Policies, observers and learned agents alike; `stable_baselines3.common.evaluation.evaluate_policy` runs them."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action.

        Args:
            observation: One observation, or a batch with a leading axis (vector environments).
            state: What the last call returned; None forgets everything.
            episode_start: Rows whose episode begins with this observation; only these forget. Shape (N,), bool.
            deterministic: Whether a stochastic policy returns its mode.

        Returns:
            The action (with the observation's leading axis) and the new state.
        """


@dataclass(frozen=True)
class AgentCard:
    """One row of the table of agents.

    Attributes:
        name: Lower case, words joined by hyphens.
        factory: "module:callable"; called with the environment and `parameters`, it returns an `Agent`.
        parameters: Keyword arguments of the factory.
        information: What the agent was told.
        requires: Names of what the evaluator must add to the observation; only "truth" exists.
        tuning_steps: Environment steps that its hyper-parameters or weights were tuned or trained with; None: nobody
            counted them.
        summary: One line for people.
        laws: Whether a control law can be chosen ("name+law").
        worlds: Which worlds it can act in; a name of several means the same algorithm in each.
        in_default_suite: Whether `servotrack bench` measures it unless told otherwise.
        information_in: Where it was told something else.
        trained_in: Environments, as `describe_environment` writes them, that it has networks for, and the environment
            steps that each took; None for agents that need no training.
    """

    name: str
    factory: str
    information: Information
    summary: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    requires: frozenset[str] = frozenset()
    tuning_steps: int | None = None
    laws: bool = False
    worlds: frozenset[str] = frozenset({"servo"})
    in_default_suite: bool = True
    information_in: Mapping[str, Information] = field(default_factory=dict)
    trained_in: Mapping[str, int] | None = None

    def as_record(self, kind: str, environment: str) -> dict[str, Any]:
        """What results in an environment keep of it.

        Args:
            kind: Kind of world.
            environment: Id and arguments in one line.
        """
        return {
            "summary": self.summary,
            "information": self.information_in.get(kind, self.information),
            "requires": sorted(self.requires),
            "tuning_steps": (self.trained_in or {}).get(environment, self.tuning_steps),
        }

    @property
    def privileged(self) -> bool:
        """Whether the agent sees what no real robot could give."""
        return "truth" in self.requires
