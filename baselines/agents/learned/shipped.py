"""Agent cards of learned agents, of the package's own networks and of other files."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, load_card
from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.worlds import kind_of_id, public_attribute

SHIPPED = Path(__file__).parent / "networks"
FACTORY = "servotrack.baselines.agents.learned.agent:create_learned_agent"


@lru_cache(maxsize=1)
def shipped_cards() -> dict[Path, LearnedCard]:
    """Return the cards of the package's own networks by path."""
    return {path: load_card(path) for path in sorted(SHIPPED.glob("*.json"))}


def shipped_agents() -> tuple[AgentCard, ...]:
    """Return one agent card per name; an agent may have networks for several environments."""
    by_name: dict[str, list[LearnedCard]] = {}
    for card in shipped_cards().values():
        by_name.setdefault(card.name, []).append(card)
    return tuple(
        AgentCard(
            name,
            FACTORY,
            cards[0].information,
            cards[0].summary,
            parameters={"name": name},
            worlds=frozenset(kind_of_id(card.env_id) for card in cards),
            trained_in={environment: card.steps for card in cards for environment in card.environments},
        )
        for name, cards in sorted(by_name.items())
    )


def agent_in_file(path: Path) -> AgentCard:
    """Return the agent card of a learned agent in a file; its name is the path.

    Raises:
        AgentFileError: A missing or invalid card, or one for an environment that cannot be loaded.
    """
    card = load_card(path)
    try:
        kind = kind_of_id(card.env_id)
    except Exception as error:  # raised by the code of an environment that is registered in this process
        raise AgentFileError(f"{path}: env_id {card.env_id!r} cannot be loaded here ({error})") from error
    return AgentCard(
        str(path),
        FACTORY,
        card.information,
        card.summary,
        parameters={"path": str(path)},
        tuning_steps=card.steps,
        worlds=frozenset({kind}),
    )


def shipped_file(name: str, env: Any) -> Path:
    """Return the path of the card of one of the package's agents for an environment.

    Raises:
        AgentFileError: The agent was trained in other environments only; the message lists them.
    """
    env_id, level = getattr(env.spec, "id", None), public_attribute(env, "level")
    trained = {path: card for path, card in shipped_cards().items() if card.name == name}
    for path, card in trained.items():
        if card.env_id == env_id and (level in card.levels if card.levels else level == card.env_kwargs.get("level")):
            return path
    raise AgentFileError(
        f"agent {name!r} was trained in {', '.join(e for card in trained.values() for e in card.environments)}, "
        f"not in {env_id}" + ("" if level is None else f" at level {level}")
    )
