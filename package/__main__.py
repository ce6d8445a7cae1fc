"""The command line. Nothing else imports `servotrack.baselines`, and each command imports only what it needs."""

from __future__ import annotations

import sys

import typer

from servotrack.commands.learning import agents, compare, train
from servotrack.commands.papers import reproduce
from servotrack.commands.ranking import bench, evaluate, leaderboard, tune
from servotrack.commands.watching import play, render, track

COMMANDS = (evaluate, bench, leaderboard, tune, reproduce, train, agents, compare, track, render, play)

app = typer.Typer(
    name="servotrack",
    help="Servo what you cannot calibrate, track what you cannot count.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)
for command in COMMANDS:
    app.command()(command)


def main() -> None:
    """Run the command line; what a user can mend is told in one line, without a traceback."""
    import gymnasium as gym

    import servotrack  # noqa: F401
    from servotrack.baselines.reporting.files import ResultsError

    # Agents of the user's own ("module:callable") lie where the user stands.
    sys.path.insert(0, "")
    try:
        app()
    except (ResultsError, ValueError, TypeError, gym.error.Error, ImportError) as error:
        typer.secho(f"servotrack: {error}", fg="red", err=True)
        raise SystemExit(2) from error


if __name__ == "__main__":
    main()
