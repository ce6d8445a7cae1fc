"""Findings about the claims of pairwise_markov, and about one of gm_phd_video, from the runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from servotrack.baselines.evaluation.statistics import PairedDifference, paired_difference
from servotrack.baselines.papers.boxes import Effect, Point
from servotrack.baselines.papers.claims import Finding, mean_effect, paired_effect, ratio_effect
from servotrack.baselines.papers.pairwise_markov.experiment import PAPER_METHODS, Measures
from servotrack.baselines.papers.pairwise_markov.plan import (
    CLUTTER_RATES,
    DETECTION_PROBABILITIES,
    PAPER_RATE,
    TEN_TARGET_SCANS,
    box_conditions,
    clutter_name,
    detection_name,
    excess,
    recovery,
    run_means,
)
from servotrack.estimators.types import Array

PAPER_NAME = "pairwise_markov"
COMMAND = f"servotrack reproduce {PAPER_NAME}"

Found = Mapping[str, Mapping[str, Measures]]
Seconds = Mapping[tuple[str, float], Array]


class Compared(NamedTuple):
    """Effects of one condition about which the paper claims something.

    Attributes:
        models: OSPA under the PMM minus that under the HMM, of both filters, m.
        phd_number, cbmember_number: Extracted number minus ten, under both models, targets.
        count_errors: Absolute error of the extracted number, CBMeMBer minus PHD, under both models, targets.
        filters: OSPA of CBMeMBer minus that of PHD, under both models, m.
        model_number: Extracted number under the PMM minus that under the HMM, of both filters, targets.
        pmb: OSPA of PMB-PMM minus that of each of the paper's filters, m.
        recovery: Scans in a row with a wrong number, CBMeMBer under both models.
    """

    models: tuple[Effect, ...]
    phd_number: tuple[Effect, ...]
    cbmember_number: tuple[Effect, ...]
    count_errors: tuple[Effect, ...]
    filters: tuple[Effect, ...]
    model_number: tuple[Effect, ...]
    pmb: tuple[Effect, ...]
    recovery: tuple[Effect, ...]


BOXED: Mapping[str, str] = {
    "pmm-beats-hmm": "models",
    "pmm-phd-underestimates": "phd_number",
    "pmm-cbmember-unbiased": "cbmember_number",
    "pmm-cbmember-counts-better": "count_errors",
    "pmm-cbmember-beats-phd": "filters",
    "pmm-number-alike": "model_number",
    "pmm-pmb-beats-all-four": "pmb",
    "pmm-quick-recovery": "recovery",
}
"""Claims that are judged at every point of the box, with the effects that decide."""


def compared(measures: Mapping[str, Measures], true: Array, where: str) -> Compared:
    """Return the effects of one condition.

    Args:
        measures: Measurements by method.
        true: True number of targets in each scan, shape (T,).
        where: Condition in words.
    """
    models = ("PMM", "HMM")

    def ospa(first: str, second: str) -> Effect:
        values = run_means(measures[first]), run_means(measures[second])
        return paired_effect(*values, "m", f"OSPA, {first} - {second}, {where}")

    def number(name: str) -> Effect:
        measured = f"extracted number - 10, {name}, last 20 scans, {where}"
        return mean_effect(excess(measures[name]), "targets", measured)

    def count_error(model: str) -> Effect:
        pair = [
            np.abs(measures[f"{family}-{model}"].number[:, TEN_TARGET_SCANS] - 10.0).mean(axis=1)
            for family in ("CBMeMBer", "PHD")
        ]
        measured = f"absolute error of the number, CBMeMBer-{model} - PHD-{model}, last 20 scans, {where}"
        return paired_effect(pair[0], pair[1], "targets", measured)

    def alike(family: str) -> Effect:
        pair = excess(measures[f"{family}-PMM"]), excess(measures[f"{family}-HMM"])
        measured = f"extracted number, {family}-PMM - {family}-HMM, last 20 scans, {where}"
        return paired_effect(*pair, "targets", measured)

    def wrong(name: str) -> Effect:
        spells = recovery(measures[name], true)
        measured = f"scans in a row with a wrong number, {name}, {where}"
        return mean_effect(spells if len(spells) else np.zeros(1), "scans", measured)

    return Compared(
        tuple(ospa(f"{family}-PMM", f"{family}-HMM") for family in ("PHD", "CBMeMBer")),
        tuple(number(f"PHD-{model}") for model in models),
        tuple(number(f"CBMeMBer-{model}") for model in models),
        tuple(count_error(model) for model in models),
        tuple(ospa(f"CBMeMBer-{model}", f"PHD-{model}") for model in models),
        tuple(alike(family) for family in ("PHD", "CBMeMBer")),
        tuple(ospa("PMB-PMM", name) for name in PAPER_METHODS),
        tuple(wrong(f"CBMeMBer-{model}") for model in models),
    )


def findings(found: Found, seconds: Seconds, true: Array) -> list[Finding]:
    """Return the findings about the claims.

    Args:
        found: Measurements by condition and method.
        seconds: Median durations of a step in each timed run, by method and clutter rate, s.
        true: True number of targets in each scan, shape (T,).
    """
    paper = found[clutter_name(PAPER_RATE)]
    main = compared(paper, true, "clutter 20")
    rates = [compared(found[clutter_name(rate)], true, f"clutter {rate:g}").models for rate in CLUTTER_RATES]
    box = [(at, compared(found[condition.name], true, "")) for at, condition in box_conditions()]
    own = excess(paper["PHD-PMM"], "expected")
    summed = excess(found["extraction"]["PHD-PMM sum"])
    over_phd = {p: _ospa(found[detection_name(p)], "CBMeMBer-PMM", "PHD-PMM") for p in DETECTION_PROBABILITIES}
    step = {name: float(1e3 * np.median(seconds[name, PAPER_RATE])) for name in (*PAPER_METHODS, "SMC-PHD")}
    swept = ", ".join(f"{d.value:+.2f} [{d.low:+.2f}, {d.high:+.2f}] at p_D = {p:.2f}" for p, d in over_phd.items())
    phd_spells = recovery(paper["PHD-PMM"], true).mean()

    def boxed(claim: str, finding: str, effects: tuple[Effect, ...] = ()) -> Finding:
        points = tuple(Point(at, getattr(effects_there, BOXED[claim])) for at, effects_there in box)
        return Finding(claim, effects or getattr(main, BOXED[claim]), finding, points)

    return [
        boxed(
            "pmm-beats-hmm",
            "Information: the PMM knows how measurement errors depend on each other; where they hardly do, or where "
            "misses and clutter dominate, there is little to know.",
            tuple(effect for pair in rates for effect in pair),
        ),
        boxed(
            "pmm-phd-underestimates",
            f"Information: a missed target loses its weight at once. The filter's own mean is {own.mean():+.2f} off; "
            f"its rounded sum, the other rule of extraction, {summed.mean():+.2f}.",
        ),
        boxed(
            "pmm-cbmember-unbiased",
            "Structure: two misses in a row lose a target, for r_U = (1 - r) / (1 - r p_D) is small where r is large; "
            "the bias vanishes with the misses.",
        ),
        boxed(
            "pmm-cbmember-counts-better",
            "Both miss about the targets that a scan misses; which of them counts better follows from p_D.",
        ),
        boxed("pmm-cbmember-beats-phd", f"Structure S1, sigma_w 1.5, 100 runs each, PMM: {swept}."),
        boxed("pmm-number-alike", "Detections decide the number, not the noise model."),
        boxed(
            "pmm-pmb-beats-all-four",
            "Structure: a filter that keeps tracks and sums over associations makes the debate between PHD and "
            "CBMeMBer second-order.",
        ),
        boxed(
            "pmm-quick-recovery",
            f"PHD-PMM: {phd_spells:.1f} scans. Most errors of the number last one scan.",
        ),
        Finding(
            "pmm-cbmember-cheaper", (_step_difference(seconds, "CBMeMBer-PMM", "PHD-PMM"),),
            f"In compiled array code a step at clutter 20 takes {step['CBMeMBer-PMM']:.3f} ms against "
            f"{step['PHD-PMM']:.3f} ms.",
        ),
        Finding(
            "pmm-costs-more",
            tuple(_step_difference(seconds, f"{family}-PMM", f"{family}-HMM") for family in ("PHD", "CBMeMBer")),
            "At clutter 20: " + ", ".join(f"{name} {step[name]:.3f} ms" for name in PAPER_METHODS) + ".",
        ),
        Finding(
            "pmm-same-order", (_step_ratio(seconds, "CBMeMBer-PMM", "CBMeMBer-HMM"),),
            "Structure: both have the same number of Gaussian components, those of the PMM in two dimensions more.",
        ),
        Finding(
            "phd-particles-worse",
            (
                paired_effect(
                    run_means(found["particles"]["SMC-PHD"]), run_means(found["particles"]["PHD-HMM"]), "m",
                    "OSPA, SMC-PHD - PHD-HMM, clutter 20, p_D 0.98",
                ),
                paired_effect(
                    seconds["SMC-PHD", PAPER_RATE], seconds["PHD-HMM", PAPER_RATE], "ms",
                    "median step, SMC-PHD - PHD-HMM, clutter 20", 1e3,
                ),
            ),
            f"On points in clutter. Median step: SMC-PHD {step['SMC-PHD']:.2f} ms, PHD-HMM {step['PHD-HMM']:.3f} ms.",
        ),
    ]  # fmt: skip


def _ospa(measures: Mapping[str, Measures], first: str, second: str) -> PairedDifference:
    return paired_difference(run_means(measures[first]), run_means(measures[second]))


def _durations(seconds: Seconds, name: str) -> Array:
    """Median step durations of all timed runs at all clutter rates, s."""
    return np.concatenate([seconds[name, rate] for rate in CLUTTER_RATES])


def _step_difference(seconds: Seconds, first: str, second: str) -> Effect:
    pair = _durations(seconds, first), _durations(seconds, second)
    measured = f"median step, {first} - {second}, all clutter rates"
    return paired_effect(*pair, "us", measured, 1e6)


def _step_ratio(seconds: Seconds, first: str, second: str) -> Effect:
    measured = f"median step, {first} / {second}, all clutter rates"
    return ratio_effect(_durations(seconds, first), _durations(seconds, second), measured)
