"""Time of a verification: `python -m servotrack.baselines.board.replay_speed [AGENTS]` replays a whole servo suite.

The suite of the figure has 20 agents, 6 levels and 100 episodes in each cell. All are replayed on one core.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.recording import AgentPlayer
from servotrack.baselines.board.replay import replayed
from servotrack.baselines.board.suites import Suite, load_suite

EPISODES = 100
LEVELS = range(6)
AGENT = "kf"


def main(arguments: Sequence[str]) -> None:
    """Print seconds and steps per second."""
    agents = int(arguments[0]) if arguments else 20
    frozen = load_suite("2027a")
    cells = [cell for cell in frozen.cells if cell.env_id == "UncalibServo-v0" and cell.env_kwargs["level"] in LEVELS]
    suite = Suite("speed", "", frozen.grid, tuple(cells))
    player = AgentPlayer(agent_card(AGENT))
    traces = {}
    for cell in cells:
        seeds = range(200_000, 200_000 + agents * EPISODES)
        traces[cell.name] = [
            episode
            for start in range(0, len(seeds), EPISODES)
            for episode in player.play(suite, cell, seeds[start : start + EPISODES])
        ]
    begin = time.process_time()
    rows = [row for cell in cells for row in replayed(suite, cell, traces[cell.name])]
    seconds = time.process_time() - begin
    steps = sum(len(episode.points) for episodes in traces.values() for episode in episodes)
    print(f"{agents} agents, {len(rows)} episodes, {steps} steps: {seconds:.1f} s, {steps / seconds:.0f} steps/s")


if __name__ == "__main__":
    main(sys.argv[1:])
