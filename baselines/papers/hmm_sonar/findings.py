"""Tables of hmm_sonar, and findings about the paper's claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.statistics import (
    wilson_interval,
)
from servotrack.baselines.papers.claims import Finding, effect_of, paired_effect
from servotrack.baselines.papers.hmm_sonar.experiment import (
    CELL,
    HUNGARIAN,
    METHODS,
    NOISE,
    NOISE_RUNS,
    OFFSETS,
    ROW,
    SIMULATIONS,
    SLOW_STRIDE,
    TRIAL,
    VITERBI,
    Measures,
    simulation,
)
from servotrack.baselines.reporting.grid import Grid
from servotrack.estimators.types import Array

Found = Mapping[str, Mapping[str, Measures]]

PAPER_NAME = "hmm_sonar"
COMMAND = f"servotrack reproduce {PAPER_NAME}"
TONE, BROADBAND = 0, 1
"""Column numbers of the paper's targets."""
TIME_TOLERANCE = 1.0
"""Largest error of a start or an end that counts as found, records of 1 s."""
FAINT_OFFSET = -20
"""Offset of the signal-to-noise ratio at which faint targets are judged, dB."""

CONTRADICTIONS = Grid(
    ["what the paper says", "what follows", "what was chosen"],
    [
        [
            "Target 1 moves from 45 to 85 deg at 1 deg/s from 10 to 48 s.",
            "38 s at 1 deg/s end at 83 deg.",
            "Start, rate and times as stated.",
        ],
        [
            "Target 2 moves from 105 to 65 deg at 1 deg/s from 10 to 45 s.",
            "35 s at 1 deg/s end at 70 deg.",
            "Start, rate and times as stated.",
        ],
        [
            "The tracks cross at 30 s (figure 2).",
            "At those rates they meet at 75 deg after 40 s.",
            "Two variants: `rates` crosses at 40 s; `cross30` moves at 1.5 deg/s and crosses at 30 s.",
        ],
        [
            "Target 1 ends at 48 s (set-up), and at 45 s (figure 3).",
            "45 s is the end of target 2.",
            "48 s; starts and ends are measured for both.",
        ],
        [
            "SNRs of -15 and -10 dB.",
            "Not said: of what, per what, in which band.",
            "Target 1 and target 2, per element, over 0 to 6 kHz. They stand 270 and 860 standard deviations out of "
            "the noise of a record, so that offsets down to -24 dB are run, too.",
        ],
        [
            "A broadband target of 1000 Hz bandwidth.",
            "Not said: which band, and which band the receiver sums over.",
            "Target: 500 to 1500 Hz; receiver: 500 to 1600 Hz in bins of 10 Hz, 10 snapshots in a record of 1 s.",
        ],
        [
            "L chains run in parallel.",
            "Not said: how L is known.",
            "Chains are started until new ones fail the sequential test twice.",
        ],
        [
            "State grid, transition probabilities, threshold of the test.",
            "Not given.",
            "0.25 deg and 0.5 deg/s; all else chosen on scenes of our own and on tune seeds.",
        ],
    ],
    3,
    markdown=(2,),
)


def coverage(measures: Measures, target: int | None = None) -> Array:
    """Return the share of target records that were tracked in each run, of all targets or of one, shape (runs,)."""
    columns = slice(None) if target is None else slice(target, target + 1)
    present = measures.present[:, columns].sum(axis=1)
    return measures.tracked[:, columns].sum(axis=1) / np.maximum(present, 1)


def bearing_error(measures: Measures, target: int | None = None) -> float:
    """Return the root mean square bearing error while tracked, over all runs, deg; NaN if nothing was tracked."""
    columns = slice(None) if target is None else slice(target, target + 1)
    tracked = measures.tracked[:, columns].sum()
    return float(np.sqrt(measures.squared_error[:, columns].sum() / tracked)) if tracked else float("nan")


def in_time(measures: Measures) -> Array:
    """Return the share of starts and ends found within `TIME_TOLERANCE` in each run, shape (runs,)."""
    there = measures.present > 0
    found = (np.abs(measures.start) <= TIME_TOLERANCE).astype(np.float64) + (np.abs(measures.end) <= TIME_TOLERANCE)
    return (np.where(there, found, 0.0) / 2.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)


def simulation_grid(found: Found, variant: str) -> Grid:
    """Return a table of all methods on one variant of the simulation, by offset."""
    headings = [
        "offset dB", "method", "tone tracked %", "band tracked %", "tone error deg", "band error deg",
        "starts and ends within 1 s %", "swaps", "through crossing %", "false tracks", "ms",
    ]  # fmt: skip
    rows = []
    for offset in OFFSETS:
        for name in METHODS:
            m = found[simulation(variant, offset)][name]
            rows.append([
                f"{offset}", name, _percent(coverage(m, TONE).mean()), _percent(coverage(m, BROADBAND).mean()),
                _number(bearing_error(m, TONE)), _number(bearing_error(m, BROADBAND)), _percent(in_time(m).mean()),
                f"{m.swapped.mean():.2f}", _percent(_share(m.kept, m.crossings)), f"{m.false_tracks.mean():.2f}",
                f"{1e3 * np.median(m.seconds):.0f}",
            ])  # fmt: skip
    return Grid(headings, rows, 2)


def trial_grid(found: Found) -> Grid:
    """Return a table of all methods on the substitute of the sea trial and on the hour of noise."""
    headings = [
        "method", "count right %", "tracked %", "error deg", "crossings", "kept %", "swapped %", "false tracks", "ms",
        "false tracks per hour of noise",
    ]  # fmt: skip
    rows = []
    for name in METHODS:
        m, noise = found[TRIAL][name], found[NOISE][name]
        rows.append([
            name, _percent(m.count_right.mean()), _percent(coverage(m).mean()), _number(bearing_error(m)),
            f"{m.crossings.sum():.0f}", _percent(_share(m.kept, m.crossings)),
            _percent(_share(m.swapped, m.crossings)), f"{m.false_tracks.mean():.2f}",
            f"{1e3 * np.median(m.seconds):.0f}", f"{NOISE_RUNS * noise.false_tracks.mean():.0f}",
        ])  # fmt: skip
    return Grid(headings, rows, 1)


def findings(found: Found) -> list[Finding]:
    """Return the findings about the claims that the readings of the paper do not decide, see `readings`.

    Args:
        found: Measurements by condition and method.
    """
    clear = [found[simulation(variant, 0)] for variant in SIMULATIONS]
    faint = [found[simulation(variant, FAINT_OFFSET)] for variant in SIMULATIONS]

    def of_both(conditions: Sequence[Mapping[str, Measures]], method: str, value: Any) -> Array:
        return np.concatenate([value(condition[method]) for condition in conditions])

    kept, crossings = (of_both(clear, VITERBI, lambda m, a=a: getattr(m, a)).sum() for a in ("kept", "crossings"))
    through = wilson_interval(int(kept), max(int(crossings), 1))
    at_faint = f"offset {FAINT_OFFSET} dB"
    weak = of_both(faint, VITERBI, lambda m: coverage(m, TONE)).mean()
    number_right = (
        np.concatenate([condition[ROW].count_right[::SLOW_STRIDE] for condition in clear]),
        of_both(clear, CELL, lambda m: m.count_right),
    )
    trial = {name: found[TRIAL][name] for name in (CELL, ROW)}
    trial_kept = {name: wilson_interval(int(m.kept.sum()), max(int(m.crossings.sum()), 1)) for name, m in trial.items()}
    false = {name: of_both(clear, name, lambda m: m.false_tracks).mean() for name in (ROW, CELL)}
    return [
        Finding(
            "sonar-many-targets",
            (effect_of(trial_kept[CELL], "of crossings", f"both tracks kept, {CELL}, sea trial's stand-in",
                       len(trial[CELL].kept)),),
            f"With the row's likelihood {_percent(trial_kept[ROW].value)} %, and the number of targets is right in "
            f"{_percent(trial[ROW].count_right.mean())} % of the records instead of "
            f"{_percent(trial[CELL].count_right.mean())} %.",
        ),
        Finding(
            "sonar-integration",
            (effect_of(through, "of crossings", f"both tracks kept, {VITERBI}, offset 0 dB", int(crossings)),),
            f"At {at_faint} it tracks the tone in {_percent(weak)} % of the records: integration finds what is there. "
            "Structure: the path of most power past a crossing is as good with the other target.",
        ),
        Finding(
            "sonar-track-before-detect",
            (paired_effect(of_both(faint, ROW, coverage), of_both(faint, HUNGARIAN, coverage), "of rows",
                           f"targets tracked, {ROW} - {HUNGARIAN}, {at_faint}"),),
            "Information: a ridge that no single record shows is plain over ten of them.",
        ),
        Finding(
            "sonar-row-beats-cell",
            (paired_effect(*number_right, "of rows", f"number of targets right, {ROW} - {CELL}, offset 0 dB"),),
            f"False tracks a run {false[ROW]:.2f} against {false[CELL]:.2f}.",
        ),
    ]  # fmt: skip


def _share(part: Array, whole: Array) -> float:
    return float(part.sum() / whole.sum()) if whole.sum() else float("nan")


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{100.0 * share:.0f}"


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2f}"
