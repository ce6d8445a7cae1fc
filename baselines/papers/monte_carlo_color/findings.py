"""Tables of monte_carlo_color, and verdicts on the paper's claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.papers.boxes import Effect, Point, box_points
from servotrack.baselines.papers.claims import Finding, mean_effect, paired_effect, ratio_effect
from servotrack.baselines.papers.monte_carlo_color.experiment import (
    ALWAYS,
    BOX_AXES,
    DEVIATIONS,
    FOLLOWING_AXES,
    HUES,
    MEAN_SHIFT,
    NEVER,
    ONE_SCALE,
    PAPER,
    PARTICLES,
    PLUS,
    SAMPLES,
    SLOW_TRACKERS,
    SPREADS,
    THRESHOLDS,
    TRACKERS,
    Measures,
    box_name,
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
TRACKED_OVERLAP = 0.5
"""Smallest overlap of a tracked frame."""


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


def findings(found: Found, deformed: Mapping[str, Measures], steps: Mapping[str, Array]) -> list[Finding]:
    """Return the findings about the claims.

    Args:
        found: Measurements by scenario and method.
        deformed: Measurements by method on films with a deformed head.
        steps: Durations of a step by method and film, see `film_steps`.
    """
    always, never = threshold_name(ALWAYS), threshold_name(NEVER)
    scenes = {**found, "deformation": deformed}

    def better(first: Array, second: Array, measured: str) -> Effect:
        return paired_effect(first, second, "AUC", f"AUC, {measured}")

    def points(effect: Callable[[str, str, str], Effect]) -> tuple[Point, ...]:
        """Points whose effect is a function of the tracker, and of those that always and that never update."""
        return tuple(
            Point(at, (effect(box_name(at), box_name(at, ALWAYS), box_name(at, NEVER)),))
            for at in box_points(PAPER_NAME, BOX_AXES)
        )

    def following(effect: Callable[..., Effect]) -> tuple[Point, ...]:
        """Points over sigma_0 and the spread, whose effect is a function of the tracker."""
        return tuple(
            Point(at, (effect(deviation_name(float(at["sigma_0"]), float(at["spread"]))),))
            for at in box_points(PAPER_NAME, FOLLOWING_AXES)
        )

    def spreads(sigma_0: float) -> tuple[Effect, ...]:
        """Effects of half and of twice the spread on irregular motion, one sigma_0."""
        half, chosen, twice = (aucs(found["irregular"][deviation_name(sigma_0, spread)]) for spread in SPREADS)
        return tuple(
            better(auc, chosen, f"spread {factor} the chosen - the chosen, irregular")
            for auc, factor in ((half, "half"), (twice, "twice"))
        )

    def updates(scenario: str) -> str:
        shares = [aucs(found[scenario][name]).mean() for name in (PAPER, always, never)]
        return "AUC {:.3f} updating above the threshold, {:.3f} always, {:.3f} never".format(*shares)

    def masters(claim: str, scenario: str, why: str) -> Finding:
        def effect(method: str, *_: str) -> Effect:
            measured = f"frames with an overlap above {TRACKED_OVERLAP:g}, {scenario}"
            return mean_effect(tracked(scenes[scenario][method]), "of frames", measured)

        box = points if scenario == "light" else following
        rivals = ", ".join(f"{name} {tracked(scenes[scenario][name]).mean():.2f}" for name in (MEAN_SHIFT, PLUS))
        return Finding(claim, (effect(PAPER),), f"{why} Others: {rivals}.", box(effect))

    def in_scenario(claim: str, scenario: str, rival: str, finding: str) -> Finding:
        """Finding that the paper's tracker is better in a scenario than a rival, or than itself without the update."""
        rivals = {always: 0, never: 1}
        shown = {always: "always updating", never: "never updating"}

        def effect(method: str, *others: str) -> Effect:
            other = others[rivals[rival]] if rival in rivals else rival
            pair = aucs(found[scenario][method]), aucs(found[scenario][other])
            return better(*pair, f"{PAPER} - {shown.get(rival, rival)}, {scenario}")

        box = points if rival in rivals else following
        return Finding(claim, (effect(PAPER, always, never),), finding, box(effect))

    def overall(method: str, *_: str) -> Effect:
        return better(over_scenarios(found, method), over_scenarios(found, MEAN_SHIFT), f"{PAPER} - {MEAN_SHIFT}, all")

    def against(first: str, second: str) -> Effect:
        return better(over_scenarios(found, first), over_scenarios(found, second), f"{first} - {second}, all scenarios")

    def times(first: str, second: str) -> Effect:
        return ratio_effect(steps[first], steps[second], f"median step, {first} / {second}")

    rates = 1.0 / steps[PAPER]
    sizes = end_sizes(found, deviation_name(DEVIATIONS[-1])), end_sizes(found, PAPER)
    light = [aucs(found["light"][name]).mean() for name in (deviation_name(v) for v in DEVIATIONS)]
    return [
        masters("color-irregular", "irregular", "Candidates about the last place need no motion model."),
        masters("color-occlusion", "occlusion", "A box's mean candidate is drawn to whatever passes."),
        masters("color-distractor", "distractor", "Most candidates lie near the target."),
        masters("color-scale", "scale", "Scales are drawn as places are."),
        masters(
            "color-light", "light",
            "Bins are absolute colors: light moves pixels from bin to bin; a wide sigma_0 forgives that "
            f"(AUC {light[0]:.2f} to {max(light):.2f} over sigma_0).",
        ),
        masters("color-deformation", "deformation", "A histogram does not know where in the box a color is."),
        masters("color-pan-zoom", "pan_zoom", "Candidates lie in the frame: a panning camera is motion of the target."),
        in_scenario(
            "color-scale-beats-mean-shift", "scale", MEAN_SHIFT,
            f"Sizes are followed alike, off by {size_error(found['scale'][PAPER]):.0%} where the target is held, the "
            f"mean shift's by {size_error(found['scale'][MEAN_SHIFT]):.0%}.",
        ),
        Finding(
            "color-beats-mean-shift", (overall(PAPER),),
            "Structure: the mean shift's kernel trusts the box's middle, the plain histogram takes in its rim.",
            following(overall),
        ),
        Finding(
            "color-no-motion-information", spreads(DEVIATIONS[1]),
            "Information: the spread is what the method knows about the motion.",
            tuple(Point(at, spreads(float(at["sigma_0"]))) for at in box_points(PAPER_NAME, FOLLOWING_AXES[:1])),
        ),
        Finding(
            "color-cheaper-than-particles", (times(PAPER, PARTICLES),),
            "Structure: histograms of 200 boxes take the time, resampling 200 numbers takes next to none.",
        ),
        Finding(
            "color-more-features", (against(PLUS, PAPER),),
            "Information: gradients and places of colors, and what the background looks like.",
            following(lambda method, *_: against(PLUS, method)),
        ),
        Finding(
            "color-no-resampling", (against(PAPER, PARTICLES),),
            "A new draw about the mean does as resampling does; steps take "
            f"{1e3 * np.median(steps[PAPER]):.2f} ms against {1e3 * np.median(steps[PARTICLES]):.2f} ms.",
        ),
        in_scenario(
            "color-update-light", "light", never,
            f"{updates('light')}: what changes fast falls below the threshold and is not learned.",
        ),
        in_scenario(
            "color-update-gate", "occlusion", always,
            f"{updates('occlusion')}: the reference stays right, but the box is already elsewhere.",
        ),
        Finding(
            "color-mean-shift-scale-cost", (times(MEAN_SHIFT, ONE_SCALE),),
            "Structure: it searches at three scales instead of one.",
        ),
        Finding(
            "color-real-time",
            (mean_effect(rates, "frames/s", "200 samples at 300 x 245, one core"),),
            "The paper's processor is one of 2006.",
        ),
        Finding(
            "color-plus-beats-both", tuple(against(PLUS, rival) for rival in (MEAN_SHIFT, PARTICLES, HUES)),
            "Information: gradients and places of colors, and what the background looks like.",
        ),
        Finding(
            "color-wide-sigma-collapses",
            (paired_effect(*sizes, "of the true size",
                           f"size of the box at the end, sigma_0 = {DEVIATIONS[-1]:g} - the chosen one"),),
            f"Size {sizes[0].mean():.2f} with the wide one, {sizes[1].mean():.2f} with the narrow one: where all "
            "candidates weigh alike, the estimate hardly moves in place or scale.",
        ),
        Finding(
            "color-samples-saturate", (against(samples_name(800), samples_name(200)),),
            "More samples do not repair what the histogram cannot tell.",
        ),
    ]  # fmt: skip


def _interval(interval: Sequence[float]) -> str:
    value, low, high = interval[:3]
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"
