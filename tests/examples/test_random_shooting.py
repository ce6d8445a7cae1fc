"""The example that plans with exact states."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import random_shooting

from servotrack.baselines.evaluation.evaluate import evaluate


def test_planning_on_the_true_model_beats_an_agent_that_has_to_learn_it() -> None:
    planned = random_shooting.play(level=3, seed=0, horizon=100)
    learned = evaluate("UncalibServo-v0", "kf", [0], {"level": 3, "horizon": 100}, timing=False).rows[0]["steady"]
    assert planned < learned
