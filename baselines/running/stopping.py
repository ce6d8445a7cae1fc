"""One way to stop for all commands: SIGINT, SIGTERM or SIGHUP end the workers, keep what is finished, and say so."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any, NoReturn

from servotrack.baselines.running import unfinished

SIGNALS: tuple[signal.Signals, ...] = tuple(
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in signal.Signals.__members__
)
"""Signals that stop a command. Windows has no SIGHUP."""
GRACE = 2.5
"""Longest time that workers get to remove their unfinished files, s."""
DEADLINE = 4.0
"""Time after the first signal at which the process ends by force, s."""
GO_ON = "run the same command to go on"
_NEVER_STOPPED = 0


class Stopped(BaseException):
    """Raised in the main thread by the first signal. Not an Exception, so that handlers of errors let it pass.

    Args:
        number: Number of the signal.

    Attributes:
        number: Number of the signal.
        kept: Finished work and how to go on, in a few words; empty if nothing has been said yet.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        self.kept = ""

    def __str__(self) -> str:
        return f"stopped by {signal.Signals(self.number).name}" + (f"; {self.kept}" if self.kept else "")


class WorkerLostError(RuntimeError):
    """A worker process was killed before its task was done, for example because memory ran out."""


def stop_behind(error: BaseException) -> Stopped | None:
    """Return the `Stopped` that an error comes from, or None.

    A compiled function in which the signal arrives ends with SystemError, and code that cleans up may fail on its own.
    """
    seen: BaseException | None = error
    # An error that is raised again while its own consequence is handled makes a circle.
    known: set[int] = set()
    while seen is not None and not isinstance(seen, Stopped) and id(seen) not in known:
        known.add(id(seen))
        seen = seen.__cause__ or seen.__context__
    return seen if isinstance(seen, Stopped) else None


@contextlib.contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """Context that adds to `Stopped` what is kept; the innermost context decides.

    Args:
        kept: Returns the finished work and how to go on, in a few words. Called only if a signal stops the block.
    """
    try:
        yield
    except BaseException as error:
        stop = stop_behind(error)
        if stop is None:
            raise
        stop.kept = stop.kept or kept()
        raise stop from None


class Interruption:
    """Context in which the first signal is only recorded, so that a step can be finished.

    Later ones are ignored, as a closed terminal sends several; a second SIGINT acts as usual. Signals that were ignored
    before stay ignored.

    Attributes:
        signal: Number of the recorded signal; 0 for none.
    """

    def __init__(self) -> None:
        self.signal = _NEVER_STOPPED
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        self._before = _handle(self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _restore(self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if not self.signal:
            self.signal = number
        elif number == signal.SIGINT:
            _restore(self._before)
            signal.raise_signal(number)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Context for a few steps that belong together, such as two renames: a signal takes effect after them."""
    with Interruption() as interruption:
        yield
    number = interruption.signal
    if number:
        handler = signal.getsignal(number)
        if callable(handler):
            handler(number, None)
        else:
            signal.raise_signal(number)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Context of a command: the first signal ends the workers, then raises `Stopped` in the main thread.

    Later signals are ignored; a second SIGINT ends the process at once. If it still runs after `DEADLINE`, because it
    computes outside Python or waits for a camera, it ends by force: workers are killed and unfinished files removed.
    Signals that were ignored before, as SIGHUP is under `nohup`, stay ignored. Outside the main thread nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stop = _Stop()
    try:
        yield
    finally:
        # After a signal the deadline stays in force until the process has ended.
        if not stop.number:
            stop.close()


@contextlib.contextmanager
def program(kept: str) -> Iterator[None]:
    """Context of a whole program: `stoppable`, and one line and the exit code 128 plus the number at the end.

    Args:
        kept: Kept work and how to go on, for a block that does not say it itself.
    """
    try:
        with stoppable(), keeping(lambda: kept):
            yield
    except Stopped as stop:
        print(f"servotrack: {stop}", file=sys.stderr)
        raise SystemExit(128 + stop.number) from None


def end_by_force(number: int) -> NoReturn:
    """Kill the workers, remove unfinished files, and end this process without any further step."""
    for child in multiprocessing.active_children():
        child.kill()
    unfinished.clear()
    name = signal.Signals(number).name
    text = f"servotrack: stopped by {name}, by force; finished work is kept; {GO_ON}\n"
    with contextlib.suppress(OSError):
        # Not through sys.stderr, whose lock another thread may hold.
        os.write(2, text.encode())
    os._exit(128 + number)


class _Stop:
    """Handlers of the signals, and a thread that learns of them even while the main thread computes outside Python."""

    def __init__(self) -> None:
        self.number = _NEVER_STOPPED
        self._raised = False
        self._workers_ended = threading.Event()
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._descriptor = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._before = _handle(self._on_signal)
        self._unraisable = sys.unraisablehook
        sys.unraisablehook = self._on_unraisable
        threading.Thread(target=self._watch, name="servotrack-stopping", daemon=True).start()

    def close(self) -> None:
        """Restore the handlers and end the thread."""
        sys.unraisablehook = self._unraisable
        _restore(self._before)
        signal.set_wakeup_fd(self._descriptor)
        self._writer.close()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._raised:
            return
        self._raised = True
        self.number = self.number or number
        # Raised earlier, it would make the executor kill workers that are removing their files.
        self._workers_ended.wait(GRACE + 0.5)
        raise Stopped(self.number)

    def _on_unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Raise again what was raised in a finalizer, from which nothing can be raised."""
        if not isinstance(unraisable.exc_value, Stopped):
            self._unraisable(unraisable)
            return
        self._raised = False
        # Not SIGINT, if there is a choice: a second one ends by force. A little later, outside of the finalizer.
        number = next((each for each in self._before if each != signal.SIGINT), signal.SIGINT)
        timer = threading.Timer(0.02, os.kill, (os.getpid(), number))
        timer.daemon = True
        timer.start()

    def _watch(self) -> None:
        received = self._received(None)
        if not received:
            self._reader.close()
            return
        self.number = self.number or received[0]
        begin = time.monotonic()
        _end_workers()
        self._workers_ended.set()
        while (left := begin + DEADLINE - time.monotonic()) > 0.0:
            if signal.SIGINT in self._received(left):
                break
        end_by_force(self.number)

    def _received(self, timeout: float | None) -> list[int]:
        """Return the next signals of `SIGNALS`; empty if none came in time, or if the context has ended."""
        self._reader.settimeout(timeout)
        while True:
            try:
                numbers = self._reader.recv(64)
            except TimeoutError:
                return []
            found = [number for number in numbers if number in SIGNALS]
            if found or not numbers:
                return found


def _end_workers() -> None:
    children = multiprocessing.active_children()
    until = time.monotonic() + GRACE
    for child in children:
        child.terminate()
    for child in children:
        child.join(max(until - time.monotonic(), 0.0))


def _handle(handler: Callable[[int, FrameType | None], None]) -> dict[int, Any]:
    """Set the handler of all signals that are not ignored and return the previous ones; {} outside the main thread."""
    before: dict[int, Any] = {}
    for number in SIGNALS:
        if signal.getsignal(number) is signal.SIG_IGN:
            continue
        try:
            before[number] = signal.signal(number, handler)
        except ValueError:  # Only the main thread may set handlers.
            break
    return before


def _restore(before: dict[int, Any]) -> None:
    while before:
        signal.signal(*before.popitem())
