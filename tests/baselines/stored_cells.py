"""A small cell of results, for tests of its file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import CellResults

ENV, KWARGS, AGENT = "UncalibServo-v0", {"level": 3}, "kf"


def make_cell(seeds: tuple[int, ...] = (1, 2), **changes: Any) -> CellResults:
    rows = [{"seed": seed, "return": 1.5, "length": 10} for seed in seeds]
    card = {"information": "model-free", "requires": [], "tuning_steps": 0, "summary": "a filter"}
    fields: dict[str, Any] = {"provenance": provenance(), "rows": rows, "max_steps": 252, "env_kwargs": dict(KWARGS)}
    return CellResults(env_id=ENV, agent=AGENT, card=card, **{**fields, **changes})


def unsealed(path: Path, **changes: Any) -> None:
    """Write the file as servotrack 0.1.0 did: format version 1, without digests."""
    document = json.loads(path.read_text()) | {"format_version": 1}
    del document["sha256"]
    for row in document["rows"]:
        del row["sha256"]
    path.write_text(json.dumps(document | changes))
