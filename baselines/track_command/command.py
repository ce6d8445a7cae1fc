"""The command `servotrack track`: open the sequence, create detector and tracker by name, run, score, report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from servotrack.baselines.agents.people.catalog import DETECTORS, Detector, create_detector, create_tracker
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.reporting.terminal import print_tables
from servotrack.baselines.running.stopping import Stopped
from servotrack.baselines.track_command.claim import claim_folder
from servotrack.baselines.track_command.inputs import FileInput, Input, PixelInput
from servotrack.baselines.track_command.offline import OFFLINE_TRACKS, write_offline
from servotrack.baselines.track_command.painter import BoxPainter
from servotrack.baselines.track_command.run import FILM, TRACKS, TrackRun, track
from servotrack.baselines.track_command.scores import (
    MATCH_RULES,
    TrackScores,
    check_benchmark,
    score_grid,
    score_tracks,
)
from servotrack.envs.track.files.frames import SIDES
from servotrack.envs.track.files.labeled import LabeledTruth, read_labeled, truth_tracks
from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.envs.track.files.read import read_tracks
from servotrack.estimators.metrics.benchmarks import BENCHMARKS

FILE_DETECTOR = "file"
"""Detector name that stands for the detections of a MOTChallenge sequence."""
SCORES = "scores"
"""Name of the score files without .json and .md."""
OUTPUTS = (TRACKS, OFFLINE_TRACKS, FILM, SCORES + ".json", SCORES + ".md")
"""Names of all files that a run may write."""
_FORMAT, _FORMAT_VERSION = "servotrack-track-scores", 1


@dataclass(frozen=True)
class TrackRequest:
    """Arguments of `servotrack track`.

    Attributes:
        source: Video file, folder of images, MOTChallenge folder, or a camera's index.
        out: Folder for all output; None for results/track/ and the source's name.
        detector: Name, an ONNX file, or `file` for a MOTChallenge sequence's own detections. `auto`: `file` if it has
            detections, else the first detector.
        classes: Names or numbers of the classes that a network finds; None for people.
        confidence: Smallest confidence of detections of a network or a file; None: 0.25 for a network, all of a file.
        tracker: Name of the tracker.
        size: Frame size for the detector: `WxH`, `source`, or `fit` into 384 by 288 px. Larger frames take
            longer and show smaller people. `auto`: `source` for a network, which resizes itself, else `fit`.
        truth: File of true tracks; None for the one in a MOTChallenge folder, if any.
        match: Rule of `MATCH_RULES`.
        benchmark: Rules of a benchmark in `BENCHMARKS`; None for those that fit the truth.
        start: First frame, from 0.
        frames: Largest number of frames; None for all.
        stride: Use every stride-th frame.
        background: Number of frames sampled in a first pass to initialize the background model. 0 disables the pass.
        white: Value that is white in images of more than 8 bits; None: from the images.
        offline: If true, also write `tracks_offline.txt` with gaps filled and short tracks dropped.
        video: If true, write the annotated video.
        show_truth: If true, the video shows the true boxes, too.
    """

    source: str
    out: Path | None = None
    detector: str = "auto"
    classes: tuple[str, ...] | None = None
    confidence: float | None = None
    tracker: str = "pmb"
    size: str = "auto"
    truth: Path | None = None
    match: str = "iou"
    benchmark: str | None = None
    start: int = 0
    frames: int | None = None
    stride: int = 1
    background: int = 40
    white: float | None = None
    offline: bool = False
    video: bool = True
    show_truth: bool = False


def run_command(request: TrackRequest, console: Console) -> int:
    """Track a sequence, write the tracks, score them, and report.

    Args:
        request: Arguments of the command.
        console: Console for progress, scores and paths.

    Returns:
        Exit code: 0 for success; 1 if an error stopped the run (tracks up to it are kept); 128 plus the number of the
        signal that stopped it.

    Raises:
        ValueError: Unknown name, number out of range, or a source or truth that cannot be used.
        ResultsError: The folder cannot be written, or holds files of these names that are not of an earlier run.
    """
    if request.match not in MATCH_RULES:
        raise ValueError(f"match must be one of {', '.join(MATCH_RULES)}, got {request.match!r}")
    if request.benchmark is not None:
        check_benchmark(request.benchmark)
    labeled = _truth(request)
    truth = None
    if labeled is not None:
        truth = truth_tracks(labeled, BENCHMARKS[request.benchmark or labeled.benchmark].scored)
    source, detector = _open(request, 0 if truth is None else truth.length)
    width, height = source.source_size or (0, 0)
    working = (round(width / source.scale[0]), round(height / source.scale[1])) if width else None
    tracker = create_tracker(request.tracker, working, source.frame_rate)
    out = request.out or Path("results") / "track" / (Path(request.source).stem or source.name)
    ResultsFolder(out).check_writable()
    claim_folder(out, OUTPUTS, {"source": request.source, "detector": detector, "tracker": request.tracker})
    painter = None
    if request.video and source.source_size is not None:
        painter = BoxPainter(source.source_size, truth, request.show_truth)
    with _progress(console) as progress:
        bar = progress.add_task(f"{detector} + {request.tracker}", total=source.length)
        run = track(source, tracker, out, painter, on_frame=lambda: progress.advance(bar))
        progress.update(bar, total=len(run.frames), completed=len(run.frames))
    for name in OUTPUTS:
        # Files of an earlier run would be mistaken for this one's.
        if out / name not in run.files:
            (out / name).unlink(missing_ok=True)
    # Free memory: scoring an hour of tracks takes a lot of it.
    frame_rate = source.frame_rate
    del painter, tracker, source
    found = {request.tracker: out / TRACKS}
    if request.offline:
        found[f"{request.tracker}, offline"] = write_offline(out / TRACKS, run.frames, frame_rate)
        run.files.append(out / OFFLINE_TRACKS)
    if truth is not None and labeled is not None:
        if not len(truth.ids):
            run.warnings.append("the truth holds no boxes that count: every reported box counts as false")
        _score(request, detector, labeled, run, found, out, console)
    return _report(run, console)


class _RateColumn(ProgressColumn):
    """Column of frames per second."""

    def render(self, task: Task) -> Text:
        """Return the rate of the last seconds while the task runs, and of the whole task at the end."""
        rate = task.finished_speed or task.speed
        return Text("" if rate is None else f"{rate:.0f} frames/s", style="cyan")


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} frames"),
        _RateColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _truth(request: TrackRequest) -> LabeledTruth | None:
    if request.truth is not None:
        return read_labeled(request.truth)
    sequence = find_mot_folder(request.source)
    return None if sequence is None or sequence.truth is None else read_labeled(sequence.truth)


def _open(request: TrackRequest, length: int) -> tuple[Input, str]:
    """Return the sequence with its detector, and the detector's name."""
    name = request.detector
    if name == "auto":
        sequence = find_mot_folder(request.source)
        name = FILE_DETECTOR if sequence is not None and sequence.detections is not None else next(iter(DETECTORS))
    if name == FILE_DETECTOR:
        _no_classes(request, "of a file")
        return FileInput(
            request.source,
            confidence=request.confidence,
            pictures=request.video,
            length=length,
            start=request.start,
            count=request.frames,
            stride=request.stride,
        ), name
    network = name.lower().endswith(".onnx")
    detector: Detector
    if network:
        from servotrack.baselines.agents.people.onnx_detector import CONFIDENCE, OnnxDetector

        confidence = CONFIDENCE if request.confidence is None else request.confidence
        detector = OnnxDetector(name, request.classes, confidence)
    else:
        _no_classes(request, f"of {name}")
        if request.confidence is not None:
            raise ValueError(f"confidence is for networks and files; {name} gives none: leave it out")
        detector = create_detector(name)
    size = request.size if request.size != "auto" else "source" if network else "fit"
    return PixelInput(
        request.source,
        detector,
        _size(size),
        start=request.start,
        count=request.frames,
        stride=request.stride,
        background=0 if network else request.background,
        white=request.white,
    ), name


def _no_classes(request: TrackRequest, whose: str) -> None:
    if request.classes is not None:
        raise ValueError(f"classes are for networks (--detector FILE.onnx); detections {whose} have none: leave it out")


def _size(text: str) -> tuple[int, int] | str:
    if text in ("fit", "source"):
        return text
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and text.isascii()):
        raise ValueError(f"size must be WxH such as 384x288, `auto`, `fit` or `source`, got {text!r}")
    sides = (int(width), int(height))
    if not all(SIDES[0] <= side <= SIDES[1] for side in sides):
        raise ValueError(f"size must have sides from {SIDES[0]} to {SIDES[1]} px, got {text!r}")
    return sides


def _score(
    request: TrackRequest,
    detector: str,
    truth: LabeledTruth,
    run: TrackRun,
    found: dict[str, Path],
    out: Path,
    console: Console,
) -> None:
    """Score the written tracks, print the table, and write it as Markdown and JSON."""
    scores: dict[str, TrackScores] = {
        name: score_tracks(truth, read_tracks(path), run.frames, request.match, request.benchmark)
        for name, path in found.items()
    }
    grids = [score_grid(one, name) for name, one in scores.items()]
    grid = Grid(grids[0].headings, [row for one in grids for row in one.rows], grids[0].words)
    rules = BENCHMARKS[request.benchmark or truth.benchmark]
    note = (
        f"Rules of {rules.name}; match: {MATCH_RULES[request.match].summary}. Ratios in percent. Hidden people count."
    )
    print_tables(console, {f"{Path(request.source).name}: {detector}": grid})
    console.print(note, style="dim", highlight=False)
    record = {
        "format": _FORMAT,
        "version": _FORMAT_VERSION,
        "source": request.source,
        "detector": detector,
        "match": request.match,
        "benchmark": request.benchmark or truth.benchmark,
        "first_frame": run.frames[0],
        "stopped": run.stopped,
        "frames_per_second": round(run.rate, 1),
        "scores": {name: one._asdict() for name, one in scores.items()},
        "provenance": provenance(),
    }
    for suffix, text in ((".json", json.dumps(record, indent=1) + "\n"), (".md", f"{as_markdown(grid)}\n{note}\n")):
        path = out / (SCORES + suffix)
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        run.files.append(path)


def _report(run: TrackRun, console: Console) -> int:
    """Print files, warnings, rate and the reason for an early end; return the exit code."""
    for path in run.files:
        console.print(str(path), soft_wrap=True)
    for note in run.notes:
        console.print(f"note: {note}", style="cyan", soft_wrap=True)
    for warning in run.warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
    console.print(f"{len(run.frames)} frames, {run.rows} boxes, {run.rate:.0f} frames/s")
    if not run.stopped:
        return 0
    kept = f"{len(run.frames)} frames are kept, up to frame {run.frames[-1]}"
    if run.signal:
        console.print(f"{Stopped(run.signal)}; {kept}", style="yellow")
        return 128 + run.signal
    console.print(f"stopped: {run.stopped}; {kept}", style="red", soft_wrap=True)
    return 1
