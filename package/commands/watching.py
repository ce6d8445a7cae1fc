"""Videos in and out, and episodes to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotrack.commands.terms import (
    Level,
    Settings,
    console,
    env_kwargs,
)


def track(
    source: Annotated[
        str, typer.Argument(help="Video file, folder of images, MOTChallenge sequence, or a camera's index.")
    ],
    detector: Annotated[
        str,
        typer.Option(
            "--detector",
            "-d",
            help="masked, masked-paper, mog2, knn; `file`: a MOTChallenge sequence's det.txt; auto: that if any.",
        ),
    ] = "auto",
    tracker: Annotated[
        str,
        typer.Option(
            "--tracker", "-t", help="pmb, gm-phd, gm-phd-paper, gm-cbmember, kalman-hungarian, no-filter, ..."
        ),
    ] = "pmb",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder; default: results/track/NAME.")] = None,
    size: Annotated[
        str, typer.Option(help="What the detector sees: WxH, `source`, or `fit`: within 384x288 px.")
    ] = "fit",
    truth: Annotated[
        Path | None, typer.Option(help="MOTChallenge's gt.txt or CAVIAR's XML; a MOTChallenge folder's own is found.")
    ] = None,
    match: Annotated[str, typer.Option(help="`iou`: at least 0.5; `centroid`: within 0.6 of the true height.")] = "iou",
    start: Annotated[int, typer.Option(min=0, help="First frame, from 0.")] = 0,
    frames: Annotated[int | None, typer.Option(min=1, help="Most frames.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="Every so manieth frame.")] = 1,
    background: Annotated[
        int,
        typer.Option(min=0, help="Frames of a first pass over a file for the background; 0: none, strictly online."),
    ] = 40,
    offline: Annotated[bool, typer.Option("--offline", help="Also fill gaps after the fact, in a file apart.")] = False,
    video: Annotated[bool, typer.Option(help="Write the annotated film.")] = True,
    show_truth: Annotated[bool, typer.Option("--show-truth", help="Draw true boxes, too.")] = False,
) -> None:
    """Real data in; MOTChallenge tracks, an annotated film and, where there is truth, scores out."""
    from servotrack.baselines.track_command.command import TrackRequest, run_command

    request = TrackRequest(
        source,
        out,
        detector,
        tracker,
        size,
        truth,
        match,
        start,
        frames,
        stride,
        background,
        offline,
        video,
        show_truth,
    )
    code = run_command(request, console())
    if code:
        raise typer.Exit(code)


def render(
    out: Annotated[Path, typer.Argument(help="Folder of the sequence, to be made.")],
    level: Annotated[int, typer.Option("--level", "-l", help="Level of PedestrianTracking-v0, 0 to 5.")] = 0,
    settings: Settings = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the episode.")] = 0,
) -> None:
    """A rendered crowd as a MOTChallenge sequence: images and exact truth, for `track` and any other tracker."""
    from servotrack.baselines.reporting.terminal import progress_bars
    from servotrack.baselines.track_command.rendered import render_sequence

    with progress_bars() as progress:
        bar = progress.add_task(out.name)

        def advance(left: int) -> None:
            progress.update(bar, total=progress.tasks[bar].completed + 1 + left, advance=1)

        frames = render_sequence(out, env_kwargs(level, settings), seed, advance)
    console().print(f"{out}: {frames} frames", soft_wrap=True)


def play(
    env: Annotated[str, typer.Argument(help="Gymnasium id.")] = "UncalibServo-v0",
    agent: Annotated[str | None, typer.Option("--agent", "-a", help="Whom to watch; none: drive by keyboard.")] = None,
    level: Level = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(help="Of the first episode.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Write a film (.webm, .mp4, .avi) instead of opening a window.")
    ] = None,
) -> None:
    """Watch an agent, or drive the arm by keyboard (arrow keys; escape ends)."""
    from servotrack.baselines.evaluation.watch import drive, watch

    kwargs = env_kwargs(level, settings)
    if video is not None:
        from servotrack.baselines.evaluation.watch import film_episode

        if agent is None:
            raise ValueError("--video needs an agent to film; add --agent lifted-kf")
        frames = film_episode(env, agent, video, kwargs, seed)
        console().print(f"{video}: {frames} frames")
    elif agent is None:
        drive(env, kwargs, seed)
    else:
        watch(env, agent, kwargs, seed)
