"""Run of `servotrack track`: from a sequence to tracks and video. An early end keeps all tracked frames."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from servotrack.baselines.reporting.files import ResultsError, storage_error
from servotrack.baselines.reporting.film import Film, FilmError, browser_suffix
from servotrack.baselines.reporting.h264 import has_h264
from servotrack.baselines.running.stopping import Interruption
from servotrack.baselines.track_command.counts import COUNTS, Counter, CountsFile
from servotrack.baselines.track_command.disk_space import SpaceGuard
from servotrack.baselines.track_command.inputs import Input, Step
from servotrack.baselines.track_command.timed import TimedTracker, estimates
from servotrack.baselines.track_command.tracks_file import TracksFile
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Image

TRACKS, FILMS = "tracks.txt", ("tracks.mp4", "tracks.webm")
"""Names of the tracks, and of the film, which depends on the encoders that are there."""
_FILM_RATES = (1.0, 60.0)


def film_name() -> str:
    """Return the name of the film, one of `FILMS`."""
    return f"tracks{browser_suffix()}"


class Painter(Protocol):
    """Draws a frame of the video."""

    def __call__(self, step: Step, estimate: SetEstimate) -> Image:
        """Return the RGB frame. All frames have the same size."""


@dataclass
class TrackRun:
    """Outcome of a run.

    Attributes:
        frames: Numbers of the tracked frames, from 0.
        times: Times of these frames since frame 0, s.
        rows: Number of boxes written.
        seconds: Duration, s.
        stopped: Reason why the run ended before the sequence; empty if it did not.
        signal: Number of the signal that stopped it; 0 for none.
        error: Error that stopped it; None without one.
        warnings: Warnings for the user.
        notes: Facts about the source for the user.
        files: Files written, complete and valid.
    """

    frames: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    rows: int = 0
    seconds: float = 0.0
    stopped: str = ""
    signal: int = 0
    error: Exception | None = None
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Frames per second."""
        return len(self.frames) / self.seconds if self.seconds > 0.0 else 0.0


def track(
    source: Input,
    tracker: TimedTracker,
    out: Path,
    painter: Painter | None = None,
    on_frame: Callable[[], None] = lambda: None,
    counter: Counter | None = None,
) -> TrackRun:
    """Track a sequence.

    Args:
        source: Sequence with detections.
        tracker: Tracker of boxes with its state, before the first frame.
        out: Folder for `tracks.txt` and, with a painter, the film of `film_name`.
        painter: Draws the video; None for no video.
        on_frame: Called after every frame.
        counter: Counts people, for `counts.csv`; None for no counts.

    Returns:
        Outcome of the run, also if a broken source, a full disk or a signal ended it.

    Raises:
        ResultsError: Videos cannot be encoded, or a network fails before the first tracked frame.
        StorageError: `out` cannot be created or written.
        SequenceError: The source is broken before the first tracked frame.
    """
    run = TrackRun()
    started = time.perf_counter()
    guard = SpaceGuard(out)
    with (
        Interruption() as interruption,
        TracksFile(out / TRACKS) as tracks,
        contextlib.nullcontext() if counter is None else CountsFile(out / COUNTS) as counts,
        _filming(source, out, painter) as film,
    ):
        try:
            for step, estimate in estimates(source, tracker):
                guard.check()
                tracks.write(step.number + 1, estimate)
                if counter is not None and counts is not None:
                    counts.write(step, counter.step(step.number, estimate, step.time))
                film.show(step, estimate)
                run.frames.append(step.number)
                run.times.append(step.time)
                on_frame()
                if interruption.signal:
                    run.signal, run.stopped = interruption.signal, "interrupted"
                    break
            film.finish()
        except FilmError as error:
            raise ResultsError(f"{error}; or write no video (--no-video)") from error
        except (SequenceError, ResultsError, OSError) as error:
            if not run.frames and isinstance(error, OSError):
                raise storage_error(out, error) from error
            if not run.frames:
                raise
            run.error, run.stopped = error, str(error)
    run.seconds, run.rows = time.perf_counter() - started, tracks.rows
    run.warnings.extend([source.warning] if source.warning else [])
    run.notes.extend(source.notes)
    if film.count and not has_h264():
        run.notes.append("the film is written in WebM, which takes long: pip install av makes it a quick MP4")
    run.files.extend([out / TRACKS] if counter is None else [out / TRACKS, out / COUNTS])
    if film.count:
        _keep_film(out / film_name(), run)
    return run


class _Filming:
    """Draws the video and encodes it in a separate thread; does nothing without a film."""

    def __init__(self, film: Film | None, painter: Painter | None, pool: ThreadPoolExecutor) -> None:
        self._film, self._painter, self._pool = film, painter, pool
        self._writing: Future[None] | None = None
        self.count = 0

    def show(self, step: Step, estimate: SetEstimate) -> None:
        """Draw the frame, wait for the previous one to be written, and start writing this one."""
        if self._film is None or self._painter is None:
            return
        picture = self._painter(step, estimate)
        self.finish()
        self._writing = self._pool.submit(self._film.write, picture)
        self.count += 1

    def finish(self) -> None:
        """Wait for the frame that is being written, and raise its error, if any."""
        if self._writing is not None:
            self._writing.result()


@contextlib.contextmanager
def _filming(source: Input, out: Path, painter: Painter | None) -> Iterator[_Filming]:
    if painter is None:
        with ThreadPoolExecutor(1) as pool:
            yield _Filming(None, None, pool)
        return
    # The pool shuts down before the film is closed.
    with (
        Film(out / film_name(), float(np.clip(source.frame_rate, *_FILM_RATES))) as film,
        ThreadPoolExecutor(1) as pool,
    ):
        yield _Filming(film, painter, pool)


def _keep_film(path: Path, run: TrackRun) -> None:
    """Keep the video if it can be read: OpenCV reports no error if its file could not be finished."""
    import cv2

    # FFmpeg takes a relative path that begins as `file:` for an address.
    capture = cv2.VideoCapture(str(path.absolute()))
    plays = capture.isOpened() and capture.read()[0]
    capture.release()
    if plays:
        run.files.append(path)
        return
    path.unlink(missing_ok=True)
    run.warnings.append(f"{path} could not be finished and was removed; the tracks are complete")
