"""Tables of monte_carlo_color, and verdicts on the paper's claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.statistics import Interval, PairedDifference, bootstrap_mean, paired_difference
from servotrack.baselines.papers.claims import Claim, Verdict, judge_smaller
from servotrack.baselines.papers.monte_carlo_color.experiment import (
    DEVIATIONS,
    HUES,
    MEAN_SHIFT,
    PAPER,
    PARTICLES,
    PLUS,
    SAMPLES,
    SLOW_TRACKERS,
    THRESHOLDS,
    TRACKERS,
    Measures,
    deviation_name,
    samples_name,
    threshold_name,
)
from servotrack.baselines.reporting.grid import Grid
from servotrack.envs.track.color.config import PAPER_SCENARIOS
from servotrack.envs.track.color.scoring import failures, precision, success_curve
from servotrack.estimators.types import Array

Found = Mapping[str, Mapping[str, Measures]]

PAPER_NAME = "monte_carlo_color"
COMMAND = f"servotrack reproduce {PAPER_NAME}"
FRAME_RATE = 25.0
"""Frame rate of the paper's video, which it calls real time, 1/s."""
TRACKED_OVERLAP = 0.5
"""Smallest overlap of a tracked frame."""
TRACKED_SHARE = 0.5
"""Smallest share of tracked frames for "the tracker masters a scenario"."""


def aucs(measures: Measures) -> Array:
    """Return the AUC of every film, shape (films,)."""
    return np.array([success_curve(iou).mean() for iou in measures.iou])


def tracked(measures: Measures) -> Array:
    """Return the share of tracked frames of every film, shape (films,)."""
    return (measures.iou > TRACKED_OVERLAP).mean(axis=1)


def over_scenarios(found: Found, method: str) -> Array:
    """Return the AUC of every film of all scenarios, in the order of the scenarios."""
    return np.concatenate([aucs(found[scenario][method]) for scenario in PAPER_SCENARIOS])


def auc_grid(found: Found) -> Grid:
    """Return the AUC by scenario and tracker, with its interval over films, as a table."""
    rows = []
    for name in (*TRACKERS, *SLOW_TRACKERS):
        cells = [_interval(bootstrap_mean(aucs(found[scenario][name]))) for scenario in PAPER_SCENARIOS]
        rows.append([name, *cells, _interval(bootstrap_mean(over_scenarios(found, name)))])
    return Grid(["tracker", *PAPER_SCENARIOS, "all"], rows, 1)


def quality_grid(found: Found, seconds: Mapping[str, float]) -> Grid:
    """Return precision, failures and speed of all trackers as a table."""
    rows = []
    for name in (*TRACKERS, *SLOW_TRACKERS):
        films = [(found[s][name].iou[k], found[s][name].center_error[k]) for s in PAPER_SCENARIOS
                 for k in range(len(found[s][name].iou))]  # fmt: skip
        precise = bootstrap_mean([precision(error) for _, error in films])
        lost = bootstrap_mean([failures(iou) for iou, _ in films])
        rows.append([name, str(len(films)), _interval(precise), _interval(lost), f"{1.0 / seconds[name]:.0f}"])
    return Grid(["tracker", "films", "within 20 px", "times lost per film", "frames/s"], rows, 1)


def sensitivity_grid(found: Found) -> Grid:
    """Return AUC and box size of the paper's tracker with one value changed, as a table."""
    groups = (
        ("sigma_0", [(f"{v:g}", deviation_name(v)) for v in DEVIATIONS]),
        ("update above", [("never" if v == 1.0 else f"{v:g}", threshold_name(v)) for v in THRESHOLDS]),
        ("samples", [(str(v), samples_name(v)) for v in SAMPLES]),
    )
    rows = []
    for title, variants in groups:
        for value, name in variants:
            size = bootstrap_mean(end_sizes(found, name))
            cells = [f"{aucs(found[scenario][name]).mean():.3f}" for scenario in PAPER_SCENARIOS]
            rows.append([title, value, *cells, _interval(bootstrap_mean(over_scenarios(found, name))), _interval(size)])
    return Grid(["parameter", "value", *PAPER_SCENARIOS, "all", "size at the end"], rows, 2)


def size_error(measures: Measures) -> float:
    """Return the mean of |ln(box size / true size)| over all frames with some overlap."""
    return float(np.abs(np.log(measures.size[measures.iou > 0.0])).mean())


def end_sizes(found: Found, method: str) -> Array:
    """Return box size over true size, mean of each film's last fifth, films of all scenarios."""
    sizes = [found[scenario][method].size for scenario in PAPER_SCENARIOS]
    return np.concatenate([size[:, -max(1, size.shape[1] // 5) :].mean(axis=1) for size in sizes])


def findings(found: Found, seconds: Mapping[str, float]) -> list[Claim]:
    """Return verdicts on the claims.

    Args:
        found: Measurements by scenario and method.
        seconds: Median duration of a step by tracker, s.
    """
    always, never = threshold_name(0.0), threshold_name(1.0)

    def better(first: Array, second: Array) -> tuple[Verdict, PairedDifference]:
        difference = paired_difference(first, second)
        return judge_smaller(paired_difference(-first, -second)), difference

    def in_scenario(scenario: str, first: str, second: str) -> tuple[Verdict, PairedDifference]:
        return better(aucs(found[scenario][first]), aucs(found[scenario][second]))

    def updates(scenario: str) -> str:
        shares = [aucs(found[scenario][name]).mean() for name in (PAPER, always, never)]
        return "AUC {:.3f} updating above the threshold, {:.3f} always, {:.3f} never".format(*shares)

    def masters(claim: str, scenario: str, why: str) -> Claim:
        share = bootstrap_mean(tracked(found[scenario][PAPER]))
        verdict: Verdict = (
            "holds" if share.low > TRACKED_SHARE else "does not hold" if share.high < TRACKED_SHARE else "open"
        )
        rivals = ", ".join(
            f"{name} {bootstrap_mean(tracked(found[scenario][name])).value:.2f}" for name in (MEAN_SHIFT, PLUS)
        )
        measured = f"share of frames with an overlap above {TRACKED_OVERLAP:g}, {PAPER}, {scenario}"
        return _claim(claim, verdict, share, "of frames", measured, f"{why} Others: {rivals}.")

    scale, scale_gain = in_scenario("scale", PAPER, MEAN_SHIFT)
    alone, alone_gain = better(over_scenarios(found, PAPER), over_scenarios(found, PARTICLES))
    general, general_gain = better(over_scenarios(found, PAPER), over_scenarios(found, MEAN_SHIFT))
    light, light_gain = in_scenario("light", PAPER, never)
    gate, gate_gain = in_scenario("occlusion", PAPER, always)
    plus = {
        rival: better(over_scenarios(found, PLUS), over_scenarios(found, rival))
        for rival in (MEAN_SHIFT, PARTICLES, HUES)
    }
    rate = 1.0 / seconds[PAPER]
    wide, narrow = end_sizes(found, deviation_name(DEVIATIONS[-1])), end_sizes(found, PAPER)
    collapse = paired_difference(wide, narrow)
    many = paired_difference(over_scenarios(found, samples_name(800)), over_scenarios(found, samples_name(200)))
    auc = "AUC, {} - {}, {}"
    return [
        masters("color-irregular", "irregular", "Candidates about the last place need no motion model."),
        masters("color-occlusion", "occlusion", "A box's mean candidate is drawn to whatever passes."),
        masters("color-distractor", "distractor", "Most candidates lie near the target."),
        masters("color-scale", "scale", "Scales are drawn as places are."),
        masters("color-light", "light", "Bins are absolute colors: light moves pixels from bin to bin."),
        masters("color-pan-zoom", "pan_zoom", "Candidates lie in the frame: a panning camera is motion of the target."),
        _claim(
            "color-scale-beats-mean-shift", scale, scale_gain, "AUC", auc.format(PAPER, MEAN_SHIFT, "scale"),
            f"Sizes are followed alike, off by {size_error(found['scale'][PAPER]):.0%} where the target is held, the "
            f"mean shift's by {size_error(found['scale'][MEAN_SHIFT]):.0%}; without changes of scale (irregular) the "
            f"difference is {in_scenario('irregular', PAPER, MEAN_SHIFT)[1].value:+.3f}.",
        ),
        _claim(
            "color-beats-mean-shift", general, general_gain, "AUC", auc.format(PAPER, MEAN_SHIFT, "all scenarios"),
            "Structure: the mean shift's kernel trusts the box's middle, the plain histogram takes in its rim.",
        ),
        _claim(
            "color-no-resampling", "holds" if alone_gain.low > -NEGLIGIBLE_AUC else alone, alone_gain, "AUC",
            auc.format(PAPER, PARTICLES, "all scenarios"),
            "A new draw about the mean does as resampling does; steps take "
            f"{1e3 * seconds[PAPER]:.2f} ms against {1e3 * seconds[PARTICLES]:.2f} ms.",
        ),
        _claim(
            "color-update-light", light, light_gain, "AUC", auc.format(PAPER, "never updating", "light"),
            f"{updates('light')}: what changes fast falls below the threshold and is not learned.",
        ),
        _claim(
            "color-update-gate", gate, gate_gain, "AUC", auc.format(PAPER, "always updating", "occlusion"),
            f"{updates('occlusion')}: the reference stays right, but the box is already elsewhere.",
        ),
        _claim(
            "color-real-time", "holds" if rate > FRAME_RATE else "does not hold", None, "", "",
            f"{rate:.0f} frames/s with 200 samples at 300 x 245, the median step on one core.",
        ),
        _claim(
            "color-plus-beats-both",
            "holds" if all(verdict == "holds" for verdict, _ in plus.values()) else plus[MEAN_SHIFT][0],
            plus[MEAN_SHIFT][1], "AUC", auc.format(PLUS, MEAN_SHIFT, "all scenarios"),
            "Information: gradients and places of colors, and what the background looks like. Against the particle "
            f"filter {plus[PARTICLES][1].value:+.3f}, against OpenCV's meanShift {plus[HUES][1].value:+.3f}.",
        ),
        _claim(
            "color-wide-sigma-collapses", judge_smaller(collapse), collapse, "of the true size",
            f"size of the box at the end, sigma_0 = {DEVIATIONS[-1]:g} - the chosen one, all scenarios",
            f"Size {wide.mean():.2f} with the wide one, {narrow.mean():.2f} with the narrow one: where all candidates "
            "weigh alike, the estimate hardly moves in place or scale.",
        ),
        _claim(
            "color-samples-saturate", "holds" if abs(many.value) < EQUAL_AUC_TOLERANCE else "does not hold", many,
            "AUC",
            "AUC, 800 - 200 samples, all scenarios",
            f"Alike means within {EQUAL_AUC_TOLERANCE:g}: more samples do not repair what the histogram cannot tell.",
        ),
    ]  # fmt: skip


NEGLIGIBLE_AUC = 0.01
"""Loss of AUC that counts as none."""
EQUAL_AUC_TOLERANCE = 0.03
"""Largest difference of AUCs that count as equal."""


def _claim(
    claim: str, verdict: Verdict, effect: Interval | PairedDifference | None, unit: str, measured: str, finding: str
) -> Claim:
    shown: dict[str, Any] | None = None
    if effect is not None:
        value, low, high = (float(f"{end:.3g}") + 0.0 for end in effect[:3])
        shown = {"value": value, "low": low, "high": high, "unit": unit, "measured": measured}
    return Claim(claim, PAPER_NAME, "", "", verdict, shown, finding, COMMAND)


def _interval(interval: Sequence[float]) -> str:
    value, low, high = interval[:3]
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"
