"""The command line. Nothing else imports `servotrack.baselines`, and each command imports only what it needs."""

from __future__ import annotations

import signal
import threading
from typing import Annotated

import typer

from servotrack.commands.joining import submit, verify
from servotrack.commands.learning import agents, compare, export, train
from servotrack.commands.papers import reproduce
from servotrack.commands.ranking import bench, evaluate, leaderboard, tune
from servotrack.commands.watching import play, render, track

COMMANDS = (
    evaluate, bench, leaderboard, submit, verify, tune, reproduce, train, export, agents, compare, track, render, play
)  # fmt: skip

CONTEXT = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    name="servotrack",
    help="Evaluate controllers and trackers, track your own videos, reproduce papers, train agents.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    pretty_exceptions_show_locals=False,
)
for command in COMMANDS:
    app.command(context_settings=CONTEXT)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        import servotrack

        typer.echo(f"servotrack {servotrack.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Options of the program itself."""


def main() -> None:
    """Run the command line. Errors that the user can fix are printed as one line, without a traceback.

    Exit codes: 0 for success, 1 if the run failed, 2 for a mistake in the arguments or files, and 128 plus the signal's
    number if a signal stopped the command.
    """
    from servotrack.baselines.running.stopping import GO_ON, program

    try:
        with program(f"finished files are kept; {GO_ON}"):
            _run()
    finally:
        # All work is done or said: a signal while the interpreter ends must not print a traceback.
        main_thread = threading.current_thread() is threading.main_thread()
        if main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _run() -> None:
    import gymnasium as gym

    from servotrack.baselines.reporting.files import ResultsError, StorageError, is_machine_trouble
    from servotrack.baselines.running.stopping import WorkerLostError

    try:
        app()
    except SystemExit as end:
        from servotrack.baselines.reporting.terminal import CLOSED_PIPE, reader_left

        if not end.code and reader_left():
            raise SystemExit(CLOSED_PIPE) from None
        raise
    except (StorageError, WorkerLostError) as error:
        raise _ended(error, 1) from error
    except (ResultsError, ValueError, TypeError, gym.error.Error, ImportError) as error:
        raise _ended(error, 2) from error
    except MemoryError as error:
        text = f"memory is full{f' ({error})' if str(error) else ''}; free some, or give less at once"
        raise _ended(MemoryError(text), 1) from error
    except OSError as error:
        if not is_machine_trouble(error):
            raise
        raise _ended(error, 1) from error


def _ended(error: Exception, code: int) -> SystemExit:
    """Print an error in one line and return the end of the program."""
    from servotrack.baselines.reporting.plain_text import printable

    typer.secho(f"servotrack: {printable(str(error))}", fg="red", err=True)
    return SystemExit(code)


if __name__ == "__main__":
    main()
