"""Tables of a tuning record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.agents.tuning_record import TunedAgent, TuningRecord
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.reporting.plain_text import markdown_code
from servotrack.baselines.tuning.families import FAMILIES
from servotrack.baselines.worlds import world_of_id


def tuning_grid(record: TuningRecord) -> Grid:
    """Return a table with one row per hyper-parameter of every searched agent."""
    headings = ["agent", "hyper-parameter", "tried", "chosen", "from", "settings", "objective", "environment steps"]
    rows = []
    for name, tuned in record.agents.items():
        for i, (path, choices) in enumerate(tuned.grid.items()):
            chosen, start = tuned.chosen[path], tuned.start[path]
            cells = [markdown_code(path), ", ".join(f"{c:g}" for c in choices), f"{chosen:g}"]
            cells.append("" if chosen == start else f"{start:g}")
            whole = [str(len(tuned.candidates)), _objective(tuned), f"{tuned.environment_steps:,}"]
            rows.append([name if i == 0 else "", *cells, *(whole if i == 0 else [""] * 3)])
    return Grid(headings, rows, 3, markdown=(1,))


def steps_grid(record: TuningRecord) -> Grid:
    """Return a table of the environment steps behind every agent's values, borrowed ones included."""
    families = [family for family in FAMILIES if family.env_id == record.protocol["env_id"]]
    # Two families may share an environment, at other levels.
    families = [family for family in families if family.grids.keys() & record.agents.keys()] or families
    names = {name for family in families for name in (*family.grids, *family.borrowed, *family.untuned)}
    steps = {name: record.tuning_steps(name) for name in AGENTS if name in names}
    return Grid(["agent", "tuning steps"], [[n, "?" if s is None else f"{s:,}"] for n, s in steps.items()], 1)


def markdown_tuning(record: TuningRecord) -> str:
    """Return both tables as Markdown, with the protocol and the commands that wrote the record."""
    protocol = record.protocol
    commands = sorted({tuned.provenance["command"] for tuned in record.agents.values()})
    versions = sorted({tuned.provenance["versions"]["servotrack"] for tuned in record.agents.values()})
    seeds = protocol["seeds"]
    return (
        f"{as_markdown(tuning_grid(record))}\n"
        f"{protocol['env_id']}, levels {', '.join(map(str, protocol['levels']))}, {len(seeds)} seeds each "
        f"({seeds[0]} to {seeds[-1]}). Objective: {_cost(protocol)}; where it changed, "
        f"before → after. Written by {', '.join(map(markdown_code, commands))}, "
        f"servotrack {', '.join(versions)}.\n\n{as_markdown(steps_grid(record))}"
    )


def _cost(protocol: Mapping[str, Any]) -> str:
    """Return the cost of an episode in words."""
    world = world_of_id(protocol["env_id"])
    if world.kind == "servo":
        return f"mean of ln(steady error in m) + {protocol['failure_cost']:g} per failure"
    return (
        f"mean of -{world.headline.heading}" if world.headline.high_is_good else f"mean of ln({world.headline.title})"
    )


def _objective(tuned: TunedAgent) -> str:
    before, after = tuned.objective(tuned.start), tuned.objective(tuned.chosen)
    return f"{after:.3f}" if tuned.start == tuned.chosen else f"{before:.3f} → {after:.3f}"
