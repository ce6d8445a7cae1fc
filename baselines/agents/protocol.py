"""Contract of an agent (`predict` of Stable-Baselines3), and its card: factory, information, cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

from numpy.typing import NDArray

from servotrack.estimators.types import Mask

Observation: TypeAlias = "NDArray[Any] | Mapping[str, NDArray[Any]]"

Information = Literal["model-free", "structure", "prior", "calibrated", "privileged", "undeclared"]
"""Information that an agent receives: none; the model's structure; the randomization's ranges; the parameters of this
system; the truth; not declared."""

TRUTH = frozenset({"truth"})
"""Value of `requires` for agents that see the truth."""


@runtime_checkable
class Agent(Protocol):
    """A policy, observer or learned agent; `stable_baselines3.common.evaluation.evaluate_policy` runs it."""

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
            state: Result of the last call; None starts anew.
            episode_start: Rows whose episode begins with this observation; their state is reset. Shape (N,), bool.
            deterministic: True makes a stochastic policy return its mode.

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
        information: Information that the agent receives.
        requires: Additions to the observation that it needs from the evaluator; only "truth" exists.
        tuning_steps: Environment steps of the tuning or training of its parameters; None: not counted.
        summary: Description in one line.
        laws: True if a control law can be chosen ("name+law").
        worlds: Kinds of worlds it can act in, by the same algorithm.
        in_default_suite: True if `servotrack bench` evaluates it by default.
        information_in: Kinds of worlds in which `information` differs.
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
        """Return the fields that results in an environment keep.

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
        """True if the agent receives the truth, which no real robot has."""
        return "truth" in self.requires
