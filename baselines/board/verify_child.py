"""Child process of a verification: reads foreign folders under limits, and answers with one line of bounded JSON.

`python -I -m servotrack.baselines.board.verify_child` reads a line of JSON that says what to verify; see `Order`.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import servotrack  # noqa: F401
from servotrack.baselines.board.message_agent import MessageAgent, MessageError
from servotrack.baselines.board.recording import Player
from servotrack.baselines.board.sandbox import Limits, bubblewrap, confined, limited
from servotrack.baselines.board.submission import AGENT, Submission
from servotrack.baselines.board.suites import load_suite
from servotrack.baselines.board.verification import Verdict, agent_player, open_submission, replay_all, run_again
from servotrack.baselines.reporting.files import ResultsError

CHILD_LIMITS = Limits(memory=1_000_000_000, seconds=1200)
"""Limits of this process while it replays, of which a fifth is used."""
RUNNING_LIMITS = Limits(memory=4_000_000_000, seconds=1200)
"""Limits of this process while it runs a network, which may take 4 GB; see `NetworkSession`."""
PROGRAM_LIMITS = Limits(memory=4_000_000_000, seconds=600)
"""Limits of a foreign program."""
_RUNS = 2


@dataclass(frozen=True)
class Order:
    """Request of a verification.

    Attributes:
        folders: Folders of submissions.
        suite: Path of the suite's file; None for the suites of this package that the cards name.
        cells: Names of the cells to replay, by name of the folder; None for all.
        run: True to run the agents again, too.
        program: True if the agent that is run is a program, which gets a namespace and limits of its own.
        nonce: Number of the fresh seeds.
        fresh: Fresh episodes in each cell.
        seconds: Longest time of a program for all its episodes, s.
    """

    folders: Sequence[str]
    suite: str | None = None
    cells: dict[str, list[str]] | None = None
    run: bool = False
    program: bool = False
    nonce: str = ""
    fresh: int = 0
    seconds: float = 600.0


def verify_all(order: Order) -> list[Verdict]:
    """Verify folders and return their verdicts, in their order."""
    suite = None if order.suite is None else load_suite(order.suite)
    opened = [open_submission(Path(folder), suite) for folder in order.folders]
    cells = None
    if order.cells is not None:
        cells = {
            submission.seal: order.cells.get(verdict.folder, [])
            for submission, verdict in opened
            if submission is not None
        }
    replay_all(opened, cells)
    if order.run:
        for submission, verdict in opened:
            if submission is not None and verdict.is_confirmed:
                _run(submission, verdict, order)
    return [verdict for _, verdict in opened]


def _run(submission: Submission, verdict: Verdict, order: Order) -> None:
    try:
        with _players(submission, order) as players:
            run_again(submission, verdict, players, order.nonce, order.fresh)
    except (ResultsError, ValueError) as error:
        verdict.notes.append(f"The agent could not be run: {str(error)[:300]}")


@contextlib.contextmanager
def _players(submission: Submission, order: Order) -> Iterator[list[Player]]:
    if submission.kind != "command":
        yield [agent_player(submission) for _ in range(_RUNS)]
        return
    if bubblewrap() is None:
        raise MessageError("bubblewrap is needed to run a foreign program; install it (apt install bubblewrap)")
    line = confined(submission.card["agent"]["entry"], {"/agent": submission.folder / AGENT}, "/agent")
    with contextlib.ExitStack() as stack:
        agents = [MessageAgent(line, None, order.seconds, limited(PROGRAM_LIMITS)) for _ in range(_RUNS)]
        for agent in agents:
            stack.enter_context(agent)
        yield list(agents)


def main() -> None:
    """Read the order, verify, and answer."""
    order = Order(**json.loads(sys.stdin.readline()))
    # Before the first foreign byte. A program that is started sets limits of its own, which may not exceed these.
    if not order.program:
        (RUNNING_LIMITS if order.run else CHILD_LIMITS).apply()
    answer = json.dumps([asdict(verdict) for verdict in verify_all(order)], allow_nan=False)
    os.write(1, answer.encode("ascii") + b"\n")


if __name__ == "__main__":
    main()
