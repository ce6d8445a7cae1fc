"""Tables of hmm_sonar, and findings about the paper's claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.statistics import (
    wilson_interval,
)
from servotrack.baselines.papers.boxes import Effect
from servotrack.baselines.papers.claims import Finding, effect_of, mean_effect, paired_effect, ratio_effect
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
from servotrack.baselines.papers.hmm_sonar.readings import ReadingsBox, clean, kept, timely, tracked
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


def findings(found: Found, seconds: Mapping[int, Array], box: ReadingsBox) -> list[Finding]:
    """Return the findings about the claims.

    Args:
        found: Measurements by condition and method.
        seconds: Durations of tracking a record of 60 s by number of targets, one per record, s.
        box: Scores of all readings of the paper.
    """
    clear = [found[simulation(variant, 0)] for variant in SIMULATIONS]
    faint = [found[simulation(variant, FAINT_OFFSET)] for variant in SIMULATIONS]

    def of_both(conditions: Sequence[Mapping[str, Measures]], method: str, value: Any) -> Array:
        return np.concatenate([value(condition[method]) for condition in conditions])

    def through(method: str) -> Effect:
        both, crossings = (of_both(clear, method, lambda m, a=a: getattr(m, a)).sum() for a in ("kept", "crossings"))
        interval = wilson_interval(int(both), max(int(crossings), 1))
        return effect_of(interval, "of crossings", f"both tracks kept, {method}, offset 0 dB", int(crossings))

    def without_false(method: str) -> Effect:
        false = of_both(clear, method, lambda m: m.false_tracks)
        interval = wilson_interval(int((false == 0).sum()), len(false))
        return effect_of(interval, "of records", f"without a false track, {method}, offset 0 dB", len(false))

    timely_starts = of_both(clear, CELL, in_time)
    trial = {name: found[TRIAL][name] for name in (CELL, ROW)}
    trial_kept = {name: wilson_interval(int(m.kept.sum()), max(int(m.crossings.sum()), 1)) for name, m in trial.items()}
    weak = {name: of_both(faint, name, lambda m: coverage(m, TONE)) for name in METHODS}
    before = of_both(faint, ROW, coverage), of_both(faint, HUNGARIAN, coverage)
    better = (
        np.concatenate([condition[ROW].count_right[::SLOW_STRIDE] for condition in clear]),
        of_both(clear, CELL, lambda m: m.count_right),
    )
    numbers = sorted(seconds)
    at_faint = f"offset {FAINT_OFFSET} dB"
    crossing = box.points(box.clear, kept)
    excluded = box.exclusion_points()
    turns = box.turning_points(tracked(None, "turning target tracked"))
    return [
        Finding(
            "sonar-crossing", (through(CELL),),
            f"With the row's likelihood {_percent(through(ROW).value)} %. As the text can be read, b = z and L known, "
            "both tracks are kept; the ratio that the main tables use is this project's. The equations are lost.",
            crossing,
        ),
        Finding(
            "sonar-start-end",
            (mean_effect(timely_starts, "of starts and ends", f"within {TIME_TOLERANCE:g} s, {CELL}, offset 0 dB"),),
            f"With the row's likelihood {_percent(of_both(clear, ROW, in_time).mean())} %.",
            box.points(box.clear, timely(TIME_TOLERANCE)),
        ),
        Finding(
            "sonar-automatic", (without_false(CELL),),
            f"With the row's likelihood {_percent(without_false(ROW).value)} %; in an hour of noise "
            f"{NOISE_RUNS * found[NOISE][CELL].false_tracks.mean():.0f} false tracks, with the row's "
            f"{NOISE_RUNS * found[NOISE][ROW].false_tracks.mean():.0f}. With L tested, 12 chains are the cap, so that "
            "10 false tracks are what can be reported; with L known there is no place for a false track.",
            box.points(box.clear, clean),
        ),
        Finding(
            "sonar-many-targets",
            (effect_of(trial_kept[CELL], "of crossings", f"both tracks kept, {CELL}, sea trial's stand-in",
                   len(trial[CELL].kept)),),
            f"With the row's likelihood {_percent(trial_kept[ROW].value)} %, and the number of targets is right in "
            f"{_percent(trial[ROW].count_right.mean())} % of the records instead of "
            f"{_percent(trial[CELL].count_right.mean())} %.",
            box.trial_points(kept),
        ),
        Finding(
            "sonar-low-snr",
            (mean_effect(weak[CELL], "of rows", f"tone tracked, {CELL}, {at_faint}"),),
            f"With {of_both(faint, CELL, lambda m: m.false_tracks).mean():.1f} false tracks a run. Others: "
            + ", ".join(f"{name} {weak[name].mean():.2f}" for name in METHODS if name != CELL) + ".",
            box.points(box.faint, tracked(TONE, f"tone tracked, {at_faint}")),
        ),
        Finding(
            "sonar-turning", turns[0].effects,
            "Structure: the chain's rate may change by 0.3 deg/s from row to row.", turns,
        ),
        Finding(
            "sonar-exclusion", excluded[0].effects,
            "Structure: without exclusion all chains follow the loudest ridge.", excluded,
        ),
        Finding(
            "sonar-integration", (through(VITERBI),),
            f"At {at_faint} it tracks the tone in {_percent(weak[VITERBI].mean())} % of the records: integration finds "
            "what is there. Structure: the path of most power past a crossing is as good with the other target.",
        ),
        Finding(
            "sonar-track-before-detect",
            (paired_effect(*before, "of rows", f"targets tracked, {ROW} - {HUNGARIAN}, {at_faint}"),),
            "Information: a ridge that no single record shows is plain over ten of them.",
        ),
        Finding(
            "sonar-cost",
            (ratio_effect(seconds[numbers[-1]], seconds[numbers[0]],
                          f"time of a record, {numbers[-1]} / {numbers[0]} targets"),),
            "60 s of record: " + ", ".join(f"{n} targets {1e3 * np.median(seconds[n]):.0f} ms" for n in numbers) + ".",
        ),
        Finding(
            "sonar-row-beats-cell",
            (paired_effect(*better, "of rows", f"number of targets right, {ROW} - {CELL}, offset 0 dB"),),
            f"False tracks a run {of_both(clear, ROW, lambda m: m.false_tracks).mean():.2f} against "
            f"{of_both(clear, CELL, lambda m: m.false_tracks).mean():.2f}.",
        ),
    ]  # fmt: skip


def _share(part: Array, whole: Array) -> float:
    return float(part.sum() / whole.sum()) if whole.sum() else float("nan")


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{100.0 * share:.0f}"


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2f}"
