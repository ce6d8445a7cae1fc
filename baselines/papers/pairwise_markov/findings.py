"""Verdicts on the claims of pairwise_markov, and on one of gm_phd_video, from the runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.statistics import PairedDifference, paired_difference
from servotrack.baselines.papers.claims import Claim, Verdict, judge_smaller
from servotrack.baselines.papers.pairwise_markov.experiment import PAPER_METHODS, Measures
from servotrack.baselines.papers.pairwise_markov.plan import (
    CLUTTER_RATES,
    DETECTION_PROBABILITIES,
    PAPER_RATE,
    clutter_name,
    detection_name,
    excess,
    run_means,
)
from servotrack.estimators.types import Array

PAPER_NAME = "pairwise_markov"
COMMAND = f"servotrack reproduce {PAPER_NAME}"
EQUAL_NUMBER_TOLERANCE = 0.05
"""Largest difference of mean numbers of targets that count as equal."""


def findings(found: Mapping[str, Mapping[str, Measures]], seconds: Mapping[tuple[str, float], Array]) -> list[Claim]:
    """Return verdicts on the claims.

    Args:
        found: Measurements by condition and method.
        seconds: Median durations of a step in each timed run, by method and clutter rate, s.
    """
    paper = found[clutter_name(PAPER_RATE)]
    sweep = {p: found[detection_name(p)] for p in DETECTION_PROBABILITIES}

    def difference(measures: Mapping[str, Measures], first: str, second: str) -> PairedDifference:
        return paired_difference(run_means(measures[first]), run_means(measures[second]))

    def gains(family: str) -> list[PairedDifference]:
        pair = f"{family}-PMM", f"{family}-HMM"
        return [difference(found[clutter_name(rate)], *pair) for rate in CLUTTER_RATES]

    every = [gain for family in ("PHD", "CBMeMBer") for gain in gains(family)]
    phd, own = paper["PHD-PMM"], excess(paper["PHD-PMM"], "expected")
    summed = excess(found["extraction"]["PHD-PMM sum"])
    under = _against_zero(excess(phd))
    number = _against_zero(excess(paper["CBMeMBer-PMM"]))
    over_phd = {p: difference(m, "CBMeMBer-PMM", "PHD-PMM") for p, m in sweep.items()}
    rival = difference(paper, "CBMeMBer-PMM", "PHD-PMM")
    alike = paired_difference(excess(paper["CBMeMBer-PMM"]), excess(paper["CBMeMBer-HMM"]))
    pmb = {name: difference(paper, "PMB-PMM", name) for name in PAPER_METHODS}
    phd_cost, cb_cost = (
        _step_difference(seconds, "PHD-PMM", "PHD-HMM"),
        _step_difference(seconds, "CBMeMBer-PMM", "CBMeMBer-HMM"),
    )
    rival_cost = _step_difference(seconds, "CBMeMBer-PMM", "PHD-PMM")
    step = {name: float(1e3 * np.median(seconds[name, PAPER_RATE])) for name in (*PAPER_METHODS, "SMC-PHD")}
    particles = found["particles"]
    smc = difference(particles, "SMC-PHD", "PHD-HMM")
    swept = ", ".join(f"{d.value:+.2f} [{d.low:+.2f}, {d.high:+.2f}] at p_D = {p:.2f}" for p, d in over_phd.items())
    return [
        _finding(
            "pmm-beats-hmm", _verdict(all(judge_smaller(gain) == "holds" for gain in every)),
            _effect(difference(paper, "PHD-PMM", "PHD-HMM"), "m", "OSPA, PHD-PMM - PHD-HMM, clutter 20"),
            "Information: the PMM knows how measurement errors depend on each other. CBMeMBer: "
            f"{difference(paper, 'CBMeMBer-PMM', 'CBMeMBer-HMM').value:+.2f} m.",
        ),
        _finding(
            "pmm-phd-underestimates", _verdict(under.high < 0.0),
            _effect(under, "targets", "extracted number - 10, PHD-PMM, last 20 scans, clutter 20"),
            f"Information: a missed target loses its weight at once. The filter's own mean is {own.mean():+.2f} off; "
            f"its rounded sum, the other rule of extraction, {summed.mean():+.2f}.",
        ),
        _finding(
            "pmm-cbmember-unbiased", _verdict(number.low <= 0.0 <= number.high),
            _effect(number, "targets", "extracted number - 10, CBMeMBer-PMM, last 20 scans, clutter 20"),
            "Structure: two misses in a row lose a target, for r_U = (1 - r) / (1 - r p_D) is small where r is large.",
        ),
        _finding(
            "pmm-cbmember-beats-phd", judge_smaller(rival),
            _effect(rival, "m", "OSPA, CBMeMBer-PMM - PHD-PMM, clutter 20, p_D = 0.98"),
            f"Structure, and it depends on p_D: {swept}.",
        ),
        _finding(
            "pmm-cbmember-cheaper", judge_smaller(rival_cost),
            _effect(rival_cost, "us", "median step, CBMeMBer-PMM - PHD-PMM, all clutter rates"),
            f"In compiled array code a step at clutter 20 takes {step['CBMeMBer-PMM']:.3f} ms against "
            f"{step['PHD-PMM']:.3f} ms.",
        ),
        _finding(
            "pmm-costs-more", _verdict(phd_cost.low > 0.0 and cb_cost.low > 0.0),
            _effect(phd_cost, "us", "median step, PHD-PMM - PHD-HMM, all clutter rates"),
            f"CBMeMBer: {cb_cost.value:+.1f} [{cb_cost.low:+.1f}, {cb_cost.high:+.1f}] us. At clutter 20: " + ", ".join(
                f"{name} {step[name]:.3f} ms" for name in PAPER_METHODS
            ) + ".",
        ),
        _finding(
            "pmm-number-alike", _verdict(max(abs(alike.low), abs(alike.high)) < EQUAL_NUMBER_TOLERANCE),
            _effect(alike, "targets", "extracted number, CBMeMBer-PMM - CBMeMBer-HMM, last 20 scans, clutter 20"),
            "Detections decide the number, not the noise model; alike means within "
            f"{EQUAL_NUMBER_TOLERANCE:g} targets.",
        ),
        _finding(
            "pmm-pmb-beats-all-four", _verdict(all(judge_smaller(d) == "holds" for d in pmb.values())),
            _effect(pmb["PHD-PMM"], "m", "OSPA, PMB-PMM - PHD-PMM, clutter 20, p_D = 0.98"),
            "Structure: a filter that keeps tracks and sums over associations makes the debate between PHD and "
            "CBMeMBer second-order.",
        ),
        _finding(
            "phd-particles-worse", _verdict(smc.low > 0.0 and step["SMC-PHD"] > step["PHD-HMM"]),
            _effect(smc, "m", "OSPA, SMC-PHD - PHD-HMM, clutter 20, p_D = 0.98"),
            f"Median step: SMC-PHD {step['SMC-PHD']:.2f} ms, PHD-HMM {step['PHD-HMM']:.3f} ms.",
        ),
    ]  # fmt: skip


def _step_difference(seconds: Mapping[tuple[str, float], Array], first: str, second: str) -> PairedDifference:
    """Difference of median step durations, paired by run, over all clutter rates, us."""

    def durations(name: str) -> Array:
        return 1e6 * np.concatenate([seconds[name, rate] for rate in CLUTTER_RATES])

    return paired_difference(durations(first), durations(second))


def _verdict(holds: bool) -> Verdict:
    return "holds" if holds else "does not hold"


def _against_zero(values: Array) -> PairedDifference:
    return paired_difference(values, np.zeros_like(values))


def _finding(claim: str, verdict: Any, effect: dict[str, Any] | None, finding: str) -> Claim:
    return Claim(claim, PAPER_NAME, "", "", verdict, effect, finding, COMMAND)


def _effect(difference: PairedDifference, unit: str, measured: str) -> dict[str, Any]:
    value, low, high = (float(f"{end:.3g}") + 0.0 for end in difference[:3])
    return {"value": value, "low": low, "high": high, "unit": unit, "measured": measured}
