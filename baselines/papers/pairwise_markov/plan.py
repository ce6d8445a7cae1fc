"""Conditions of the pairwise_markov experiment, and summaries of their runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotrack.baselines.papers.boxes import Value, box_points
from servotrack.baselines.papers.pairwise_markov.experiment import (
    EXTRACTION_METHODS,
    OUR_METHODS,
    PAPER_METHODS,
    Condition,
    Measures,
)
from servotrack.estimators.types import Array

CLUTTER_RATES = (10.0, 20.0, 30.0, 40.0)
DETECTION_PROBABILITIES = (0.90, 0.94, 0.98, 1.0)
PAPER_RATE, PAPER_DETECTION = 20.0, 0.98
STRUCTURES: dict[str, dict[str, Any]] = {
    "S1": {"structure": "S1", "acceleration_noise": 5.0, "position_noise": 1.5},
    "S2": {"structure": "S2", "acceleration_noise": 5.0, "position_noise": 2.5},
    "S3": {"structure": "S3", "acceleration_noise": 5.0, "position_noise": 1.5},
    "S4": {"structure": "S4", "acceleration_noise": 5.0, "position_noise": 10.0},
    "S5": {"structure": "S5", "acceleration_noise": 5.0, "position_noise": 10.0},
    "S6": {"structure": "S6", "acceleration_noise": 5.0, "position_noise": 10.0},
}
TEN_TARGET_SCANS = slice(80, 100)
"""Last scans, which have ten targets, the largest number."""
METHODS = (*PAPER_METHODS, *OUR_METHODS)


BOX_AXES = ("structure", "detection", "position_noise")
BOX_METHODS = (*PAPER_METHODS, "PMB-PMM")


def clutter_name(rate: float) -> str:
    """Return the name of the condition at a clutter rate."""
    return f"clutter-{rate:g}"


def detection_name(probability: float) -> str:
    """Return the name of the condition at a detection probability."""
    return f"detection-{probability:g}"


def box_conditions() -> list[tuple[dict[str, Value], Condition]]:
    """Return the points of the box of open assumptions, each with its condition; points without a covariance lack."""
    found = []
    for at in box_points("pairwise_markov", BOX_AXES):
        world = {**STRUCTURES[str(at["structure"])], "position_noise": at["position_noise"]}
        name = f"box-{at['structure']}-{at['detection']:g}-{at['position_noise']:g}"
        condition = Condition(name, BOX_METHODS, {**world, "detection_probability": at["detection"]})
        try:
            condition.config  # noqa: B018  the configuration checks that the structure has a covariance
        except ValueError:
            continue
        found.append((at, condition))
    return found


def shares(runs: int) -> dict[str, int]:
    """Return the number of runs of each part: `runs` for the paper's table, fewer where differences are larger."""
    return {"all": runs, "part": max(2, runs // 5), "few": max(2, runs // 10), "box": max(2, runs // 20)}


def all_conditions() -> list[tuple[str, Condition]]:
    """Return all conditions, each with its key in `shares`."""
    rates = [
        (
            "all",
            Condition(clutter_name(rate), METHODS, {"clutter_rate": rate, "detection_probability": PAPER_DETECTION}),
        )
        for rate in CLUTTER_RATES
    ]
    sweep = [
        ("part", Condition(detection_name(p), METHODS, {"clutter_rate": PAPER_RATE, "detection_probability": p}))
        for p in DETECTION_PROBABILITIES
    ]
    structures = [("few", Condition(f"structure-{name}", METHODS, world)) for name, world in STRUCTURES.items()]
    return [
        *rates,
        *sweep,
        ("part", Condition("extraction", (*PAPER_METHODS, *EXTRACTION_METHODS))),
        *structures,
        ("part", Condition("identity", (*METHODS, "GNN-PMM"), {}, trajectories=True)),
        ("few", Condition("particles", ("PHD-HMM", "SMC-PHD"))),
        *(("box", condition) for _, condition in box_conditions()),
    ]


def run_means(measures: Measures) -> Array:
    """Return the mean OSPA of each run, shape (R,), m."""
    return measures.ospa.mean(axis=1)


def excess(measures: Measures, which: str = "number") -> Array:
    """Return the mean excess over ten targets in `TEN_TARGET_SCANS`, shape (R,).

    Args:
        measures: Measurements of one method.
        which: "number" for extracted targets, "expected" for the filter's expected number.
    """
    return getattr(measures, which)[:, TEN_TARGET_SCANS].mean(axis=1) - 10.0


def recovery(measures: Measures, true: Array) -> Array:
    """Return the mean number of scans in a row with a wrong extracted number, for each run that has any, shape (k,).

    Args:
        measures: Measurements of one method.
        true: True number of targets in each scan, shape (T,).
    """
    wrong = measures.number != true
    starts = wrong & ~np.pad(wrong, ((0, 0), (1, 0)))[:, :-1]
    times = starts.sum(axis=1)
    return wrong.sum(axis=1)[times > 0] / times[times > 0]
