"""Tables of the pairwise_markov experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servotrack.baselines.papers.pairwise_markov.experiment import NARROW_CUTOFF, Measures
from servotrack.baselines.papers.pairwise_markov.plan import CLUTTER_RATES, METHODS, STRUCTURES, excess, run_means
from servotrack.baselines.reporting.grid import Grid
from servotrack.estimators.types import Array


def _mean(values: Array, digits: int = 2, sign: str = "") -> str:
    """Mean with its standard error."""
    error = values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():{sign}.{digits}f} ± {error:.{digits}f}"


def table1(rates: Sequence[Mapping[str, Measures]], seconds: Mapping[tuple[str, float], Array]) -> Grid:
    """Return the paper's table 1: OSPA and time per step by clutter rate."""
    headings = ["method"]
    for rate in CLUTTER_RATES:
        headings += [f"clutter {rate:g}", "ms"]
    rows = []
    for name in METHODS:
        row = [name]
        for rate, measures in zip(CLUTTER_RATES, rates, strict=True):
            row += [_mean(run_means(measures[name])), f"{1e3 * np.median(seconds[name, rate]):.3f}"]
        rows.append(row)
    return Grid(headings, rows, 1)


def means(found: Sequence[Mapping[str, Measures]], methods: Sequence[str], labels: Sequence[str]) -> Grid:
    """Return the mean OSPA of methods under several conditions."""
    rows = [[name, *(_mean(run_means(measures[name])) for measures in found)] for name in methods]
    return Grid(["method", *labels], rows, 1)


_COMPARED = (
    ("PHD: PMM - HMM", "PHD-PMM", "PHD-HMM"),
    ("CBMeMBer: PMM - HMM", "CBMeMBer-PMM", "CBMeMBer-HMM"),
    ("PMB: PMM - HMM", "PMB-PMM", "PMB-HMM"),
    ("HMM: CBMeMBer - PHD", "CBMeMBer-HMM", "PHD-HMM"),
    ("PMM: CBMeMBer - PHD", "CBMeMBer-PMM", "PHD-PMM"),
    ("PMM: PMB - PHD", "PMB-PMM", "PHD-PMM"),
    ("PMM: PMB - CBMeMBer", "PMB-PMM", "CBMeMBer-PMM"),
)


def differences(found: Sequence[Mapping[str, Measures]], labels: Sequence[str]) -> Grid:
    """Return paired differences of OSPA under several conditions."""
    rows = [[title, *(_mean(run_means(m[a]) - run_means(m[b]), 3, "+") for m in found)] for title, a, b in _COMPARED]
    return Grid(["difference", *labels], rows, 1)


def number_grid(found: Sequence[Mapping[str, Measures]], labels: Sequence[str]) -> Grid:
    """Return the errors of extracted and expected numbers of targets while ten targets exist."""
    rows = []
    for name in METHODS:
        for kind, which in (("extracted", "number"), ("own mean", "expected")):
            rows.append([name, kind, *(_mean(excess(m[name], which), 2, "+") for m in found)])
    return Grid(["method", "number", *labels], rows, 2)


def extraction_grid(measures: Mapping[str, Measures]) -> Grid:
    """Return OSPA and number errors of each extraction rule."""
    rows = [
        [
            name,
            _mean(run_means(m)),
            _mean(excess(m), 2, "+"),
            _mean(excess(m, "expected"), 2, "+"),
        ]
        for name, m in measures.items()
    ]
    return Grid(["method and rule", "OSPA m", "extracted too many", "own mean too many"], rows, 1)


def metrics_grid(measures: Mapping[str, Measures]) -> Grid:
    """Return the scores of the same runs under other metrics."""
    headings = ["method", "OSPA c 100 p 1", "OSPA c 100 p 2", f"OSPA c {NARROW_CUTOFF:g} p 1", "GOSPA c 100 p 2"]
    rows = []
    for name in METHODS:
        m = measures[name]
        columns = (m.ospa, m.ospa_squared, m.ospa_narrow, m.gospa)
        rows.append([name, *(_mean(values.mean(axis=1)) for values in columns)])
    return Grid(headings, rows, 1)


def structure_grid(found: Mapping[str, Mapping[str, Measures]]) -> Grid:
    """Return the gain of the pairwise Markov model under each reading of the paper's letters a, b, c, d."""
    headings = ["structure", "sigma_v", "sigma_w", *METHODS, "PHD: PMM - HMM", "CBMeMBer: PMM - HMM", "PMB: PMM - HMM"]
    rows = []
    for name, world in STRUCTURES.items():
        m = found[f"structure-{name}"]
        row = [name, f"{world['acceleration_noise']:g}", f"{world['position_noise']:g}"]
        row += [f"{run_means(m[method]).mean():.2f}" for method in METHODS]
        for family in ("PHD", "CBMeMBer", "PMB"):
            row.append(_mean(run_means(m[f"{family}-PMM"]) - run_means(m[f"{family}-HMM"]), 3, "+"))
        rows.append(row)
    return Grid(headings, rows, 1)


def identity_grid(measures: Mapping[str, Measures]) -> Grid:
    """Return trajectory scores and their differences from the nearest-neighbor tracker."""
    reference = measures["GNN-PMM"]
    rows = []
    for name, m in measures.items():
        row = [name, _mean(run_means(m)), _mean(m.ospa2), _mean(m.trajectory_gospa, 0)]
        if name == "GNN-PMM":
            row += ["", ""]
        else:
            row += [_mean(m.ospa2 - reference.ospa2, 2, "+")]
            row += [_mean(m.trajectory_gospa - reference.trajectory_gospa, 0, "+")]
        rows.append(row)
    return Grid(["method", "OSPA", "OSPA(2)", "trajectory GOSPA", "OSPA(2) - GNN", "trajectory GOSPA - GNN"], rows, 1)
