"""Agents as programs in any language: observations in, actions out, one line of JSON each, on stdin and stdout.

The program gets `{"message": "environment", ...}` once per cell and answers nothing. It gets
`{"message": "reset", "observation": {...}}` at the beginning of an episode and `{"message": "step", "observation":
{...}}` at every further step, and answers each with one line: a list of numbers, the action. `{"message": "end"}` is
the last line. One process serves all episodes, one after the other.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.board.action_grid import ActionGrid
from servotrack.baselines.board.replay import Episode, make_replay_env
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.reporting.plain_text import printable
from servotrack.baselines.reporting.strict import parse_json
from servotrack.baselines.worlds import public_attribute

STARTING = 60.0
"""Time that a program has for its first answer, s."""
ANSWERING = 10.0
"""Time that a program has for every other answer, s."""
LEAVING = 2.0
"""Time that a program has to end after the last message, s."""
LONGEST_LINE = 65_536
"""Largest accepted length of an answer, bytes."""
_SHOWN = 200
_ERRORS_KEPT = 2000
_TURN = 0.2


class MessageError(ResultsError):
    """A program that ended, was silent for too long, or gave something else than an action."""


class MessageAgent:
    """A running program that plays episodes.

    Args:
        command: The program and its arguments.
        folder: Working directory of the program; None for the present one.
        seconds: Longest time for all episodes together, s.
        prepare: Called in the new process before the program starts, to set limits; None for none.

    Attributes:
        answer_seconds: Durations of all answers, s.
    """

    def __init__(
        self,
        command: Sequence[str],
        folder: Path | None,
        seconds: float,
        prepare: Callable[[], None] | None = None,
    ) -> None:
        self._command, self._until = list(command), time.monotonic() + seconds
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self.answer_seconds: list[float] = []
        try:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                cwd=folder,
                preexec_fn=prepare,
                start_new_session=os.name == "posix",
            )
        except (OSError, ValueError) as error:
            self._errors.close()
            reason = getattr(error, "strerror", None) or error
            raise MessageError(f"{self._command[0]!r} cannot be started ({reason}); check --command") from error
        self._lines: queue.Queue[bytes] = queue.Queue(maxsize=4)
        self._closing = threading.Event()
        self._reader = threading.Thread(target=self._read, name="servotrack-agent", daemon=True)
        self._reader.start()

    def __enter__(self) -> MessageAgent:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the program, by force if it does not leave."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(MessageError):
            self._send({"message": "end"})
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        self._closing.set()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVING)
        with contextlib.suppress(OSError):
            if os.name == "posix":
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()
        self._process.wait()
        self._reader.join(LEAVING)
        self._process.stdout.close()
        self._errors.close()

    def play(self, suite: Suite, cell: SuiteCell, seeds: Sequence[int]) -> list[Episode]:
        """Play one episode per seed, one after the other, and return the actions.

        Raises:
            MessageError: The program fails; the message names the cell, the episode and the step.
        """
        env = make_replay_env(cell, 1)
        try:
            grid = ActionGrid.of(env.single_action_space, suite.grid)
            self._send(_environment(suite, cell, env), f"{cell.name}, at its beginning")
            return [self._episode(env, grid, seed, f"{cell.name}, episode {k}") for k, seed in enumerate(seeds)]
        finally:
            env.close()

    def _episode(self, env: Any, grid: ActionGrid, seed: int, where: str) -> Episode:
        observation, _ = env.reset(seed=[seed])
        points: list[NDArray[np.int16]] = []
        message, ended = "reset", False
        while not ended:
            place = f"{where}, step {len(points)}"
            plain = _plain(observation)
            begin = time.perf_counter()
            self._send({"message": message, "observation": plain}, place)
            answer = self._answer(place)
            self.answer_seconds.append(time.perf_counter() - begin)
            points.append(grid.rounded(self._action(answer, grid.shape, place)))
            observation, _, terminated, truncated, _ = env.step(grid.actions(points[-1]))
            message, ended = "step", bool(terminated[0] or truncated[0])
        return Episode(seed, np.concatenate(points))

    def _send(self, message: Mapping[str, Any], place: str = "at the end") -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(message, allow_nan=False).encode("ascii") + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            raise self._failed(place, "stopped reading") from error

    def _answer(self, place: str) -> bytes:
        limit = ANSWERING if self.answer_seconds else STARTING
        left = self._until - time.monotonic()
        try:
            line = self._lines.get(timeout=max(min(limit, left), 0.001))
        except queue.Empty:
            why = f"gave no answer within {limit:g} s" if left > limit else "needs more time than it has in all"
            raise self._failed(place, f"{why}; write one line per message and flush stdout") from None
        if not line:
            raise self._failed(place, "ended")
        if not line.endswith(b"\n"):
            raise self._failed(place, f"gave a line without end, or of more than {LONGEST_LINE} bytes")
        return line

    def _action(self, line: bytes, shape: tuple[int, ...], place: str) -> NDArray[np.float64]:
        try:
            values = _checked_action(parse_json(line), shape)
        except ValueError as error:
            shown = printable(line[:_SHOWN].decode("utf-8", "replace").strip())
            raise self._failed(place, f"answered {shown!r} ({error})") from error
        return values[None]

    def _failed(self, place: str, what: str) -> MessageError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2)
        code = self._process.poll()
        text = f"the agent {what} ({place})"
        if code is not None:
            text += f"; exit code {code}"
        self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(self._errors.tell() - _ERRORS_KEPT, 0))
        said = printable(self._errors.read().decode("utf-8", "replace")).strip()
        return MessageError(f"{text}; it wrote to stderr: {said[-_SHOWN:]}" if said else text)

    def _read(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        with contextlib.suppress(OSError, ValueError):
            while self._put(stream.readline(LONGEST_LINE)):
                pass

    def _put(self, line: bytes) -> bool:
        """Hand over a line, waiting for its turn, and return True if more may follow."""
        while not self._closing.is_set():
            with contextlib.suppress(queue.Full):
                self._lines.put(line, timeout=_TURN)
                return line.endswith(b"\n")
        return False


def _checked_action(answer: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an answer as an action; rows that a set does not need may be missing at its end.

    Raises:
        ValueError: An answer of another form.
    """
    rows = answer if len(shape) == 2 else [answer]
    most, width = shape if len(shape) == 2 else (1, int(np.prod(shape)))
    if not (isinstance(rows, list) and len(rows) <= most and all(_are_numbers(row, width) for row in rows)):
        form = f"at most {most} rows, each a list" if len(shape) == 2 else "a list"
        raise ValueError(f"an action is {form} of {width} numbers")
    action = np.zeros((most, width))
    if rows:
        action[: len(rows)] = rows
    return action.reshape(shape)


def _are_numbers(values: Any, count: int) -> bool:
    return isinstance(values, list) and len(values) == count and all(type(value) in (int, float) for value in values)


def _plain(observation: Any) -> Any:
    """Return the first row of a batch of observations as lists of numbers, by name where they have names."""
    if isinstance(observation, Mapping):
        return {name: values[0].tolist() for name, values in observation.items()}
    return observation[0].tolist()


def _environment(suite: Suite, cell: SuiteCell, env: Any) -> dict[str, Any]:
    """Return the message about a cell: what every agent of this package may read from an environment."""
    actions, observations = env.single_action_space, env.single_observation_space
    assert isinstance(actions, spaces.Box)
    message = {
        "message": "environment",
        "suite": suite.name,
        "env_id": cell.env_id,
        "env_kwargs": dict(cell.env_kwargs),
        "low": actions.low.tolist(),
        "high": actions.high.tolist(),
        "observation": {name: list(space.shape or ()) for name, space in observations.items()}
        if isinstance(observations, spaces.Dict)
        else list(observations.shape or ()),
    }
    # What an environment has of the attributes that agents may read.
    for name in ("max_joint_rate", "scene_model"):
        if (value := public_attribute(env, name)) is not None:
            message[name] = _as_json(value)
    return message


def _as_json(value: Any) -> Any:
    """Return a number, an array or a record as JSON holds it: fields by name, without functions and empty ones."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        fields = value._asdict()
    elif is_dataclass(value):
        fields = {each.name: getattr(value, each.name) for each in dataclass_fields(value)}
    else:
        return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return {name: _as_json(part) for name, part in fields.items() if part is not None and not callable(part)}
