"""Report of gm_phd_video: count accuracy, identities, speed, figures 2 and 3, and claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.boxes import Effect, effects_at
from servotrack.baselines.papers.claims import (
    SIGNS_NOTE,
    Finding,
    audited,
    mean_effect,
    paired_effect,
)
from servotrack.baselines.papers.gm_phd_video.alternatives import cost_slopes
from servotrack.baselines.papers.gm_phd_video.box import SEQUENCES, AlternativesBox
from servotrack.baselines.papers.gm_phd_video.events import KINDS, WINDOW, find_events, handled
from servotrack.baselines.papers.gm_phd_video.experiment import (
    COUNTED_FRAMES,
    METHODS,
    count_right,
    run_methods,
    scores,
)
from servotrack.baselines.papers.gm_phd_video.figures import draw_counts, draw_frames
from servotrack.baselines.papers.gm_phd_video.pictures import paper_pictures
from servotrack.baselines.papers.parts import Arrays, part, shown_parts_of_seeds
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.grid import Grid
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.estimators.types import Array

PAPER_NAME = "gm_phd_video"
COMMAND = f"servotrack reproduce {PAPER_NAME}"
PAPER, AS_PRINTED = "GM-PHD, table 1, our detector", "GM-PHD, table 1"
TUNED, UNFILTERED = "GM-PHD, tuned", "no filter"
SHOWN_COUNTS = (AS_PRINTED, UNFILTERED, PAPER, TUNED, "PMB")
PAPER_COUNT_RIGHT = 0.827
PAPER_RATES = {"detection": 9.6, "filter": 17.2, "both": 6.25}
"""Frames per second in the paper, on a 2.2 GHz processor of 2009."""
NOTE = (
    "The paper's sequence is a recording of the CAVIAR project; here its schedule of people is played by the "
    "pedestrian scene, drawn anew for every seed of the test range. Count right: share of the first "
    f"{COUNTED_FRAMES} frames in which the number reported is the number of people present, hidden ones included. A "
    "match of MOTA, IDF1 and HOTA is a center within 0.6 of the true height; people count if at least a fifth of them "
    "is visible. Brackets: 95 % intervals over seeds. Assumed, for the paper is silent: births of weight 0.05 at "
    "unexplained measurements, spawning of weight 0.02, and threshold, learning rate and smallest blob of its "
    "detector. An event is handled if the number is right in at least half of the "
    f"{WINDOW} frames after it, and if the person who appears is reported in them, or those who part carry the "
    "identities that they had before they merged. Without a filter every box is an identity of its own, which MOTA "
    "and IDF1 punish. `servotrack reproduce gm_phd_video_readings` judges the claims on counts and events. Box: "
    f"{SEQUENCES} rendered sequences. {SIGNS_NOTE}"
)


class Measured(NamedTuple):
    """Measurements of one method, one entry per sequence.

    Attributes:
        count_right: Share of frames with the right number of people.
        mota, idf1, hota: Scores, from 0 to 1; MOTA may be negative.
        switches: Number of identity switches.
        detection, filter: Time per frame, s.
        handled, happened: Number of events of each of `KINDS` that the method handled, and of all. Shape (number of
            sequences, 4).
    """

    count_right: Array
    mota: Array
    idf1: Array
    hota: Array
    switches: Array
    detection: Array
    filter: Array
    handled: Array
    happened: Array


def reproduce(request: Request) -> None:
    """Reproduce Wu and Hu 2010; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of rendered sequences.
    """
    with progress_bars() as progress:
        folder = request.output / PAPER_NAME
        played = shown_parts_of_seeds(
            progress, "rendered sequences", folder, request.runs, _played, methods=METHODS, events=KINDS
        )
        box = AlternativesBox(folder / "box", progress)
        slopes = cost_slopes()
        measured = _gathered(played)
        tables = {
            "The paper's sequence, rendered": quality_grid(measured),
            "Events": events_grid(measured),
            "Speed": speed_grid(measured),
        }
        if request.recordings:
            bar = progress.add_task("your sequences", total=len(request.recordings))
            for recording in request.recordings:
                own = part(
                    folder / sequences.part_name(recording),
                    sequences.setting_of_recording(recording, methods=METHODS, events=KINDS),
                    lambda recording=recording: _measured(sequences.recorded(recording)),  # type: ignore[misc]
                )
                tables[f"Your sequence {recording.source}"] = quality_grid(_gathered([own]))
                progress.advance(bar)
        pictures = paper_pictures(seeds.take("test", 1)[0], METHODS[PAPER])
    found = findings(measured, box, slopes)
    claims, audit = audited(PAPER_NAME, found, COMMAND, request.claims)
    first = played[0]
    shown = {name: first[f"{name}/counts"] for name in SHOWN_COUNTS}
    figures = {
        "figure2": draw_frames(pictures),
        "figure3": draw_counts(first["numbers"], shown, float(first["frame_rate"])),
    }
    publish(request, {**tables, **audit}, claims, f", {request.runs} sequences", NOTE, figures)


def _played(seed: int) -> Arrays:
    return _measured(sequences.rendered(seed, script=sequences.SCRIPT))


def _measured(sequence: sequences.Sequence) -> Arrays:
    """Run all methods over a sequence; return the entries of `Measured` and the counts of each, and the true counts."""
    outcomes = run_methods(sequence.frames, sequence.size, sequence.frame_rate, METHODS, sequence.background)
    arrays: dict[str, object] = {"numbers": sequence.numbers, "frame_rate": sequence.frame_rate}
    events = find_events(sequence.truth, len(sequence.numbers))
    kinds = np.array([KINDS.index(event.kind) for event in events], np.int64)
    for name, outcome in outcomes.items():
        score = scores(outcome, sequence.truth)
        good = np.array(handled(events, sequence.truth, sequence.numbers, outcome.tracks, outcome.counts), np.bool_)
        row = (
            count_right(outcome, sequence.numbers), score.mota, score.idf1, score.hota, score.identity_switches,
            outcome.detection_seconds, outcome.filter_seconds, np.bincount(kinds[good], minlength=len(KINDS)),
            np.bincount(kinds, minlength=len(KINDS)),
        )  # fmt: skip
        arrays |= {f"{name}/{field}": value for field, value in zip(Measured._fields, row, strict=True)}
        arrays[f"{name}/counts"] = outcome.counts
    return arrays


def _gathered(played: Sequence[Arrays]) -> dict[str, Measured]:
    """Return the measurements of every method, one entry per sequence."""
    return {
        name: Measured(*(np.array([one[f"{name}/{field}"] for one in played], float) for field in Measured._fields))
        for name in METHODS
    }


def quality_grid(measured: Mapping[str, Measured]) -> Grid:
    """Return count accuracy, scores and identity switches of all methods as a table."""
    headings = ["method", "detector", "filter", "count right %", "MOTA", "IDF1", "HOTA", "identity switches"]
    rows = [["paper", "", "", f"{100 * PAPER_COUNT_RIGHT:.1f}", "", "", "", ""]]
    for name, m in measured.items():
        detector, tracker = METHODS[name]
        rows.append([
            name, detector, tracker, _interval(100 * m.count_right, 1), _interval(m.mota, 2), _interval(m.idf1, 2),
            _interval(m.hota, 2), _interval(m.switches, 1),
        ])  # fmt: skip
    return Grid(headings, rows, 3)


def events_grid(measured: Mapping[str, Measured]) -> Grid:
    """Return the share of events of each kind that every method handled, as a table."""
    rows = []
    for name, m in measured.items():
        detector, tracker = METHODS[name]
        shares = [
            f"{good:.0f} of {all_of:.0f}" for good, all_of in zip(m.handled.sum(0), m.happened.sum(0), strict=True)
        ]
        rows.append([name, detector, tracker, *shares])
    return Grid(["method", "detector", "filter", *KINDS], rows, 3)


def speed_grid(measured: Mapping[str, Measured]) -> Grid:
    """Return frames per second of detection, filter and both as a table."""
    rows = [["paper, 2.2 GHz", *(f"{PAPER_RATES[part]:g}" for part in ("detection", "filter", "both"))]]
    for name, m in measured.items():
        detection, filtering = float(np.median(m.detection)), float(np.median(m.filter))
        rows.append([name, *(f"{1.0 / seconds:,.0f}" for seconds in (detection, filtering, detection + filtering))])
    return Grid(["method", "detection frames/s", "filter frames/s", "both frames/s"], rows, 1)


def findings(measured: Mapping[str, Measured], box: AlternativesBox, slopes: tuple[Effect, ...]) -> list[Finding]:
    """Return the findings about the paper's claims.

    Args:
        measured: Measurements by method.
        box: Results of the box of open assumptions.
        slopes: Effects of the filter's cost, see `cost_slopes`.
    """
    paper, tuned = measured[PAPER], measured[TUNED]

    def compare(first: Array, second: Array, unit: str, what: str, scale: float = 1.0) -> Effect:
        return paired_effect(first, second, unit, what, scale)

    updates = box.updates()
    rates = 1.0 / (paper.detection + paper.filter)
    return [
        Finding(
            "phd-video-identity",
            (compare(tuned.switches, measured["Kalman + Hungarian"].switches, "switches",
                     "identity switches, GM-PHD tuned - Kalman + Hungarian, same detections"),),
            "Structure: the filter itself has no identities; they come from labels that its components carry.",
        ),
        Finding(
            "phd-video-masked-update", effects_at(updates, threshold=25.0, learning_rate=0.02),
            "Structure: the mask keeps people out of the background, and keeps false foreground in the foreground for "
            "good, see docs/video.md.", updates,
        ),
        Finding(
            "phd-video-particles", box.particles(),
            "On the same detections, 1000 particles per person, births anywhere in the frame.",
        ),
        Finding(
            "phd-video-linear-cost", slopes,
            "Below 1 because each step has a fixed part; at most linear.",
        ),
        Finding(
            "phd-video-speed",
            (mean_effect(rates, "frames/s", "detection and filter together, one thread"),),
            "The paper's processor is one of 2009.",
        ),
    ]  # fmt: skip


def _interval(values: Array, digits: int) -> str:
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    mean = bootstrap_mean(values)
    return f"{mean.value:.{digits}f} [{mean.low:.{digits}f}, {mean.high:.{digits}f}]"
