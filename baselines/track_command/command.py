"""The command `servotrack track`: open the sequence, create detector and tracker by name, run, score, report."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.reporting.terminal import print_tables, progress_bars
from servotrack.baselines.running.stopping import Stopped
from servotrack.baselines.track_command.claim import claim_folder
from servotrack.baselines.track_command.counts import COUNTS, Counter, Places, check_places
from servotrack.baselines.track_command.exports import FORMATS, write_formats
from servotrack.baselines.track_command.inputs import Input
from servotrack.baselines.track_command.notices import NewNotes
from servotrack.baselines.track_command.offline import OFFLINE_TRACKS, write_offline
from servotrack.baselines.track_command.opening import SourceRequest, open_input, working_size
from servotrack.baselines.track_command.painter import BoxPainter
from servotrack.baselines.track_command.run import FILMS, TRACKS, TrackRun, track
from servotrack.baselines.track_command.scores import (
    MATCH_RULES,
    TrackScores,
    check_benchmark,
    score_grid,
    score_tracks,
)
from servotrack.baselines.track_command.timed import TimedTracker
from servotrack.envs.track.files.labeled import LabeledTruth, read_labeled, truth_tracks
from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.envs.track.files.read import read_tracks
from servotrack.estimators.metrics.benchmarks import BENCHMARKS

SCORES = "scores"
"""Name of the score files without .json and .md."""
OUTPUTS = (TRACKS, COUNTS, OFFLINE_TRACKS, *FORMATS.values(), *FILMS, SCORES + ".json", SCORES + ".md")
"""Names of all files that a run may write."""
_FORMAT, _FORMAT_VERSION = "servotrack-track-scores", 1


@dataclass(frozen=True)
class TrackRequest:
    """Arguments of `servotrack track` for one source.

    Attributes:
        source: The source and its detector.
        out: Folder for all output; None for results/track/ and the source's name.
        tracker: Name of the tracker.
        values: Parameters of the tracker that differ from its defaults.
        truth: File of true tracks; None for the one in a MOTChallenge folder, if any.
        match: Rule of `MATCH_RULES`.
        benchmark: Rules of a benchmark in `BENCHMARKS`; None for those that fit the truth.
        offline: If true, also write `tracks_offline.txt` with gaps filled and short tracks dropped.
        formats: Formats besides MOTChallenge's in which tracks are written, of `FORMATS`.
        video: If true, write the annotated video.
        show_truth: If true, the video shows the true boxes, too.
        places: Zones and lines in which people are counted, besides the frame; None for no counts.
    """

    source: SourceRequest
    out: Path | None = None
    tracker: str = "pmb"
    values: Mapping[str, float] = field(default_factory=dict)
    truth: Path | None = None
    match: str = "iou"
    benchmark: str | None = None
    offline: bool = False
    formats: tuple[str, ...] = ()
    video: bool = True
    show_truth: bool = False
    places: Places | None = None


def run_command(request: TrackRequest, console: Console) -> int:
    """Track a sequence, write the tracks, score them, and report.

    Args:
        request: Arguments of the command.
        console: Console for scores, counts, notes and paths. Progress and the notes of the moment go to stderr.

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
    for name in request.formats:
        if name not in FORMATS:
            raise ValueError(f"formats must be of {', '.join(FORMATS)}, got {name!r}")
    source, detector = open_input(request.source, request.video, 0 if truth is None else truth.length)
    if request.places is not None:
        check_places(request.places, source.source_size)
    made = create_tracker(request.tracker, working_size(source), source.frame_rate)
    tracker = TimedTracker(with_values(made, request.values), source.frame_rate)
    out = request.out or Path("results") / "track" / folder_name(str(request.source.source))
    ResultsFolder(out).check_writable()
    claim_folder(out, OUTPUTS, {"source": source.name, "detector": detector, "tracker": request.tracker})
    counter = None if request.places is None else Counter(request.places, source.source_size)
    painter = None
    if request.video and source.source_size is not None:
        painter = BoxPainter(source.source_size, truth, request.show_truth, counter)
    with _progress() as progress:
        bar = progress.add_task(f"{detector} + {request.tracker}", total=source.length)
        run = track(source, tracker, out, painter, _advance(progress, bar, source), counter)
        progress.update(bar, total=len(run.frames), completed=len(run.frames))
    for name in OUTPUTS:
        # Files of an earlier run would be mistaken for this one's.
        if out / name not in run.files:
            (out / name).unlink(missing_ok=True)
    # Free memory: scoring an hour of tracks takes a lot of it.
    frame_rate, size = source.frame_rate, source.source_size
    del painter, tracker, made, source
    run.files.extend(write_formats(out, request.formats, run, size))
    found = {request.tracker: out / TRACKS}
    if request.offline:
        found[f"{request.tracker}, offline"] = write_offline(out / TRACKS, run.frames, frame_rate)
        run.files.append(out / OFFLINE_TRACKS)
    if truth is not None and labeled is not None:
        if not len(truth.ids):
            run.warnings.append("the truth holds no boxes that count: every reported box counts as false")
        _score(request, detector, labeled, run, found, out, console)
    if counter is not None:
        print_tables(console, {f"{folder_name(str(request.source.source))}: people": counter.grid()})
    return _report(run, console)


class _RateColumn(ProgressColumn):
    """Column of frames per second."""

    def render(self, task: Task) -> Text:
        """Return the rate of the last seconds while the task runs, and of the whole task at the end."""
        rate = task.finished_speed or task.speed
        return Text("" if rate is None else f"{rate:.0f} frames/s", style="cyan")


def _advance(progress: Progress, bar: TaskID, source: Input) -> Callable[[], None]:
    """Return a function that advances the bar and prints new notes at once, long before the report."""
    new = NewNotes()

    def advance() -> None:
        progress.advance(bar)
        for note in new.of(source.notes):
            progress.console.print(f"note: {note}", style="cyan", soft_wrap=True)

    return advance


def _progress() -> Progress:
    return progress_bars(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f} frames"),
        _RateColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )


def _truth(request: TrackRequest) -> LabeledTruth | None:
    if request.truth is not None:
        return read_labeled(request.truth)
    sequence = find_mot_folder(str(request.source.source))
    return None if sequence is None or sequence.truth is None else read_labeled(sequence.truth)


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
    print_tables(console, {f"{folder_name(str(request.source.source))}: {detector}": grid})
    console.print(note, style="dim", highlight=False)
    record = {
        "format": _FORMAT,
        "version": _FORMAT_VERSION,
        "source": folder_name(str(request.source.source)),
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


def folder_name(source: str) -> str:
    """Return the name of the folder of results of a source: that of the file, or host and path of an address."""
    if "://" in source:
        # A password and parameters of an address belong into no name.
        place = source.partition("://")[2].split("?")[0].rpartition("@")[2]
        return re.sub(r"[^A-Za-z0-9._-]+", "-", place).strip("-.") or "stream"
    return Path(source).stem or Path(source).resolve().name


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
