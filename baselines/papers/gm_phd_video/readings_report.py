"""Report of gm_phd_video_readings: claims of Wu and Hu (2010) on counts and events under every reading of its text."""

from __future__ import annotations

from servotrack.baselines.papers.boxes import Value, effects_at
from servotrack.baselines.papers.claims import SIGNS_NOTE, Finding, audited
from servotrack.baselines.papers.gm_phd_video.box import ONE, PAPER_NAME, TWO
from servotrack.baselines.papers.gm_phd_video.events import WINDOW
from servotrack.baselines.papers.gm_phd_video.readings import ReadingsBox
from servotrack.baselines.papers.gm_phd_video.report import PAPER_COUNT_RIGHT
from servotrack.baselines.papers.publish import publish
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.terminal import progress_bars

COMMAND = "servotrack reproduce gm_phd_video_readings"
NOTE = (
    "The filter of table 1 with every value of what the paper leaves open, on the paper's schedule of people, rendered "
    "for test seeds, the same for all. The text does not say what is right while two people are one region. Two "
    "people: the number counts both, and those who part carry the identities that they had. One target: the number "
    "counts one, and those who part need no identities. An event is handled if the number is right in at least half of "
    f"the {WINDOW} frames after it, and if the person who appears is reported in them. {SIGNS_NOTE}"
)


def reproduce(request: Request) -> None:
    """Run all readings; errors as in `servotrack.baselines.papers.reproduce.reproduce_paper`.

    Args:
        request: Request; `runs` is the number of rendered sequences.
    """
    with progress_bars() as progress:
        box = ReadingsBox(request.output / "video-readings", progress, request.runs)
    claims, tables = audited(PAPER_NAME, findings(box), COMMAND, request.claims)
    publish(request, tables, claims, f", {request.runs} sequences", NOTE, {})


def findings(box: ReadingsBox) -> list[Finding]:
    """Return the findings about the claims that depend on the reading.

    Args:
        box: Results of all readings of the paper.
    """
    run: dict[str, Value] = {"detector": "ours", "threshold": 25.0, "birth_weight": 0.05}
    shipped = {**run, "merged": TWO}
    counts, filtering, events = box.counts(PAPER_COUNT_RIGHT), box.filtering(), box.events()
    changes, detections, pruning = box.changes(), box.detections(), box.pruning()
    parted = box.after_occlusions()
    merges = effects_at(events, **{**shipped, "merged": ONE}) if any(p.at["merged"] == ONE for p in events) else ()
    as_one = ", ".join(f"{effect.measured} {effect.value:.0%}" for effect in merges)
    return [
        Finding(
            "phd-video-count", effects_at(counts, **shipped),
            "Tuning of the detector: the filter counts about as well as the detector that feeds it.", counts,
        ),
        Finding(
            "phd-video-filter-helps-count", effects_at(filtering, **shipped),
            "Tuning: with T = 0.2 and these probabilities a component that is missed once is pruned at once.",
            filtering,
        ),
        Finding(
            "phd-video-events", effects_at(events, **shipped),
            "Two people who meet are one region, of which a filter of points makes one target. Where that is right, it "
            f"handles on our detector: {as_one}.", events,
        ),
        Finding(
            "phd-video-errors-at-changes", effects_at(changes, **shipped),
            "Most of the other wrong frames belong to people who meet.", changes,
        ),
        Finding(
            "phd-video-after-occlusion", effects_at(parted, **run),
            "Judged by the number of people, for the filter has no identities: each is detected and born anew.", parted,
        ),
        Finding(
            "phd-video-detector", effects_at(detections, threshold=25.0, merged=TWO),
            "Structure: pixels that the mask calls foreground are never learned, so that false regions stay.",
            detections,
        ),
        Finding(
            "phd-video-pruning", effects_at(pruning, detector="ours", merged=TWO),
            "T = 0.2 against T = 1e-5; components below 0.5 are not reported in either case.", pruning,
        ),
    ]  # fmt: skip
