"""Agents in tables: all by name, and the shipped learned ones with what they cost and what their runs reached."""

from __future__ import annotations

from servotrack.baselines.agents.learned.card import LearnedCard
from servotrack.baselines.agents.learned.shipped import SHIPPED, shipped_cards
from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.reporting.grid import Grid
from servotrack.baselines.worlds import WORLDS


def agents_grid(world: str = "") -> Grid:
    """All agents, or those of one kind of world.

    Args:
        world: A kind of `servotrack.baselines.worlds.WORLDS`; "" for all.

    Raises:
        ValueError: An unknown kind.
    """
    if world and world not in WORLDS:
        raise ValueError(f"world must be one of {', '.join(WORLDS)}, got {world!r}")
    rows = [
        [card.name, card.information, ", ".join(sorted(card.worlds)), card.summary]
        for card in AGENTS.values()
        if not world or world in card.worlds
    ]
    return Grid(["agent", "information", "worlds", "summary"], rows, 4)


def shipped_grid() -> Grid:
    """One row per network, by environment."""
    headings = ["agent", "trained in", "runs", "steps each", "minutes each", "score of the runs, tune seeds", "kB"]
    rows = [_row(card) for card in sorted(shipped_cards().values(), key=lambda card: (card.environment, card.name))]
    return Grid(headings, rows, 2)


def _row(card: LearnedCard) -> list[str]:
    runs = card.training.get("runs", [])
    scores = [run["score"] for run in runs if "score" in run]
    minutes = [run["seconds"] / 60.0 for run in runs]
    return [
        card.name,
        ", ".join(card.environments),
        str(len(runs)),
        f"{card.steps / max(len(runs), 1):,.0f}",
        _range(minutes, 1),
        _range(scores, 3),
        f"{(SHIPPED / card.network).stat().st_size / 1e3:.0f}",
    ]


def _range(values: list[float], digits: int) -> str:
    return f"{min(values):.{digits}f} to {max(values):.{digits}f}" if values else ""
