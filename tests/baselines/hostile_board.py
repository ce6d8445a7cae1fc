"""A board whose agents, worlds and texts have hostile names: `python hostile_board.py FOLDER` writes its page."""

from __future__ import annotations

import sys
from pathlib import Path

from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.leaderboard.site.entries import Entry
from servotrack.baselines.leaderboard.site.write import write_site

NAMES = (
    "</script><script>hacked=1</script>",
    '"><img src=x onerror="hacked=1">',
    "javascript:hacked=1",
    "__proto__",
    "constructor",
    "'; hacked=1; //",
    "]]>--><!--<svg onload=hacked=1>",
    "\u2028hacked=1\u2029\u202e\x00",
    "a" * 2000,
    "%3Cscript%3E&amp;task=x#/race?",
)


def hostile_entries() -> list[Entry]:
    """Entries of two environments whose strings all come from `NAMES`."""
    entries = []
    for number, env_id in enumerate(("<b>Evil-v0", "__proto__")):
        for place, name in enumerate(NAMES):
            rows = [{"seed": seed, "return": float(seed + place), "length": 5} for seed in range(4)]
            card = {"summary": name, "information": name, "requires": [], "tuning_steps": place}
            record = {"versions": {"servotrack": name}, "machine": {"system": name}, "created": name}
            cell = CellResults(env_id, {"level": number, "x": NAMES[number]}, name, card, 5, rows, [1e-4], record)
            entries.append(Entry(NAMES[0], cell, name, True, lambda cell, seeds: {}))  # type: ignore[arg-type]
    return entries


if __name__ == "__main__":
    write_site(hostile_entries(), Path(sys.argv[1]), NAMES[0])
