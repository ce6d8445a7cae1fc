"""Report of hmm_sonar_readings: claims of Jiang and Zhou (2016) under every reading of what the text leaves open."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.boxes import Effect
from servotrack.baselines.papers.claims import (
    SIGNS_NOTE,
    Finding,
    audited,
    ratio_effect,
)
from servotrack.baselines.papers.hmm_sonar.experiment import ROW, growth_of_cost
from servotrack.baselines.papers.hmm_sonar.readings import (
    FEW_RECORDS,
    PAPER_NAME,
    RECORDS,
    TURN_RECORDS,
    ReadingsBox,
    clean,
    kept,
    timely,
    tracked,
)
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.estimators.types import Array

COMMAND = "servotrack reproduce hmm_sonar_readings"
TONE = 0
"""Column of the tonal target."""
NUMBERS = (1, 3, 6)
"""Numbers of targets that are timed."""
TIME_TOLERANCE = 1.0
"""Largest error of a start or an end that counts as found, records of 1 s."""
NOTE = (
    "The displayed equations of the paper are lost in the text at hand, so that several methods fit its words. Records "
    "of SonarTracking-v0 on test seeds, the same for all readings, tracked by chains of single cells. Records at each "
    f"point: {RECORDS} of each of the two variants of the simulation with b = z and L known, {FEW_RECORDS} elsewhere "
    f"and 20 dB below the paper's signal-to-noise ratio; {TURN_RECORDS} of one turning target, with L known. "
    f"{SIGNS_NOTE}"
)


def reproduce(request: Request) -> None:
    """Run all readings; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of timed records, the readings have their own numbers.
    """
    with progress_bars() as progress:
        box = ReadingsBox(request.output / "readings", progress)
        bar = progress.add_task("timing", total=1)
        seconds = growth_of_cost(ROW, seeds.take("tune", request.runs), NUMBERS)
        progress.advance(bar)
    claims, tables = audited(PAPER_NAME, findings(box, seconds), COMMAND, request.claims)
    publish(request, tables, claims, "", NOTE, {})


def findings(box: ReadingsBox, seconds: Mapping[int, Array]) -> list[Finding]:
    """Return the findings about the claims that depend on the reading; the shipped one comes first.

    Args:
        box: Scores of all readings of the paper.
        seconds: Durations of tracking a record of 60 s by number of targets, one per record, s.
    """
    crossing, starts, automatic = (box.points(box.clear, effect) for effect in (kept, timely(TIME_TOLERANCE), clean))
    faint = box.points(box.faint, tracked(TONE, "tone tracked, offset -20 dB"))
    excluded = box.exclusion_points()
    turns = box.turning_points(tracked(None, "turning target tracked"))
    false = np.mean([scores.false_tracks for scores in box.clear["ratio", "uninformative", "tested"]])
    numbers = sorted(seconds)
    cost: Effect = ratio_effect(
        seconds[numbers[-1]], seconds[numbers[0]], f"time of a record, {numbers[-1]} / {numbers[0]} targets"
    )
    return [
        Finding(
            "sonar-crossing", crossing[0].effects,
            "The ratio that the main tables use is this project's; as the text can be read, b = z and L known, both "
            "tracks are kept. Structure: a single cell cannot tell a target from another one's skirt.",
            crossing,
        ),
        Finding(
            "sonar-start-end", starts[0].effects,
            "Where the chains are on the targets, the test of existence finds their ends to the record.", starts,
        ),
        Finding(
            "sonar-automatic", automatic[0].effects,
            f"With L tested and the ratio {false:.1f} false tracks a record, of at most 10, for 12 chains are the cap; "
            "with L known there is hardly a place for a false track.",
            automatic,
        ),
        Finding(
            "sonar-low-snr", faint[0].effects,
            "The tone 20 dB below the paper's ratio; with b = z it does not raise the evidence as far as the test of "
            "existence asks for.",
            faint,
        ),
        Finding(
            "sonar-turning", turns[0].effects, "Structure: the chain's rate may change by 0.3 deg/s from row to row.",
            turns,
        ),
        Finding(
            "sonar-exclusion", excluded[0].effects,
            "Structure: without exclusion the chains follow the loudest ridge.", excluded,
        ),
        Finding(
            "sonar-cost", (cost,),
            "60 s of record: " + ", ".join(f"{n} targets {1e3 * np.median(seconds[n]):.0f} ms" for n in numbers) + ".",
        ),
    ]  # fmt: skip
