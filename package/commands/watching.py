"""The commands `track`, `render` and `play`: track a video or points, render a sequence, watch an episode."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotrack.commands.terms import (
    Level,
    Settings,
    TableFormat,
    console,
    env_kwargs,
    find_user_modules,
    tracker_values,
    words,
)


def track(
    sources: Annotated[
        list[str],
        typer.Argument(
            help="Video files, folders of images, MOTChallenge folders, camera indices, or addresses (http, https, "
            "rtsp); or points in time, as .csv or .csv.gz with the columns time, x, y[, z] or time, lat, lon; or "
            "recordings of hydrophones, as .wav, .npy or .sio. Several ones are tracked one after the other."
        ),
    ],
    detector: Annotated[
        str,
        typer.Option(
            "--detector",
            "-d",
            help="masked, masked-paper, mog2, knn; FILE.onnx: a network (YOLO, RT-DETR, D-FINE); `file`: det.txt of a "
            "MOTChallenge sequence; auto: `file` if it exists, else masked.",
        ),
    ] = "auto",
    classes: Annotated[
        str | None,
        typer.Option(help="Classes that a network finds, by name or number, with commas. Default: person."),
    ] = None,
    confidence: Annotated[
        float | None,
        typer.Option(help="Smallest confidence of detections. Default: 0.25 for a network, all of a det.txt."),
    ] = None,
    tracker: Annotated[
        str,
        typer.Option(
            "--tracker", "-t", help="pmb, gm-phd, gm-phd-paper, gm-cbmember, kalman-hungarian, no-filter, ..."
        ),
    ] = "pmb",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Parameter of the tracker, such as birth=0.05; repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Output folder; of several sources a folder with one for each. Default: results/track/NAME.",
        ),
    ] = None,
    tracks: Annotated[
        str, typer.Option(help="Formats besides MOTChallenge's, with commas: csv, jsonl, coco. Default: none.")
    ] = "",
    size: Annotated[
        str,
        typer.Option(
            help="Frame size for the detector: WxH, `source`, or `fit`: within 384x288 px. "
            "auto: `source` for a network, else `fit`."
        ),
    ] = "auto",
    truth: Annotated[
        Path | None,
        typer.Option(
            help="True tracks, for scores: MOTChallenge gt.txt, labels of KITTI, or CAVIAR XML. "
            "Default: gt.txt of a MOTChallenge folder. For points: a .csv with an additional column id. For "
            "recordings: a .csv with the columns time, id, bearing."
        ),
    ] = None,
    match: Annotated[
        str, typer.Option(help="Match rule: `iou`: at least 0.5; `centroid`: within 0.6 of the true height.")
    ] = "iou",
    benchmark: Annotated[
        str | None,
        typer.Option(
            help="Rules of scoring: mot15, mot16, mot17, mot20, dancetrack, kitti-pedestrian, kitti-car. "
            "Default: by the form of the truth."
        ),
    ] = None,
    start: Annotated[int, typer.Option(min=0, help="First frame, from 0.")] = 0,
    frames: Annotated[int | None, typer.Option(min=1, help="Largest number of frames. Default: all.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="Use every N-th frame.")] = 1,
    background: Annotated[
        int,
        typer.Option(
            min=0,
            help="Number of frames sampled in a first pass to initialize the background model. 0 disables the pass "
            "(strictly online).",
        ),
    ] = 40,
    white: Annotated[
        float | None,
        typer.Option(help="Value that is white in images of more than 8 bits. Default: from the images."),
    ] = None,
    zone: Annotated[
        list[str] | None,
        typer.Option(
            "--zone",
            metavar="[NAME=]X1,Y1,X2,Y2,X3,Y3,...",
            help="Count the people in this polygon, px of the source; repeatable. Implies --count.",
        ),
    ] = None,
    line: Annotated[
        list[str] | None,
        typer.Option(
            "--line",
            metavar="[NAME=]X1,Y1,X2,Y2",
            help="Count the people who cross this line, in both directions; repeatable. Implies --count.",
        ),
    ] = None,
    count: Annotated[
        bool, typer.Option("--count", help="Write counts.csv: numbers of people with their 90 % intervals.")
    ] = False,
    missed: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Number of people that the detector does not find, for each one that it finds. 0: it finds all. "
            "Default: 0.3 for numbers, 0.4 for crossings.",
        ),
    ] = None,
    offline: Annotated[
        bool,
        typer.Option(
            "--offline",
            help="Also write tracks_offline.txt: gaps up to 1 s interpolated, tracks under 0.3 s dropped.",
        ),
    ] = False,
    video: Annotated[
        bool, typer.Option(help="Write the annotated video tracks.mp4, or tracks.webm without PyAV.")
    ] = True,
    show_truth: Annotated[bool, typer.Option("--show-truth", help="Draw the true boxes into the video, too.")] = False,
    array: Annotated[
        Path | None,
        typer.Option(help="Positions of the hydrophones: .csv with the columns x, y[, z] in m, one row per channel."),
    ] = None,
    band: Annotated[
        str | None, typer.Option(metavar="LOW,HIGH", help="Band of a recording of hydrophones, Hz.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Sampling frequency of a recording, Hz. Default: that of a .wav file.")
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(
            help="Duration of a row of beam powers, s. Longer rows show weaker targets. Default: from the array."
        ),
    ] = None,
    beamformer: Annotated[
        str, typer.Option(help="Beamformer of a recording: `conventional`, or `mvdr` with lower sidelobes.")
    ] = "conventional",
    table_format: TableFormat = "table",
) -> None:
    """Track people in a real sequence; write MOTChallenge tracks, an annotated video and, with --truth, scores.

    Points in time, such as those of a radar or of AIS, get a filter whose parameters are measured from them; the tracks
    are written as tracks.csv and tracks.geojson, with a figure. Recordings of hydrophones (--array, --band) are
    beamformed, and bearings are tracked before detection.
    """
    from servotrack.baselines.track_command.command import TrackRequest, folder_name, run_command
    from servotrack.baselines.track_command.counts import parse_places
    from servotrack.baselines.track_command.opening import SourceRequest
    from servotrack.envs.track.files.points import is_points_file
    from servotrack.envs.track.files.recordings import is_recording_file, read_positions

    names = [folder_name(source) for source in sources]
    if len(sources) > 1 and truth is not None:
        raise ValueError("--truth is of one source; give sources with their own gt/gt.txt, or track them one by one")
    if len(set(names)) < len(names):
        raise ValueError(f"sources must have different names, got {', '.join(names)}; track them one by one")
    counting = count or zone or line
    if missed is not None and not counting:
        raise ValueError("--missed is of counts; add --count, --zone or --line")
    places = parse_places(zone or [], line or [], missed) if counting else None
    for_frames = {
        "--detector": detector != "auto",
        "--tracker": tracker != "pmb",
        "--set": settings,
        "--tracks": tracks,
        "--benchmark": benchmark is not None,
        "--start": start,
        "--frames": frames is not None,
        "--stride": stride != 1,
        "--zone, --line and --count": counting,
        "--offline": offline,
        "--show-truth": show_truth,
    }
    for_sound = {
        "--array": array,
        "--band": band,
        "--rate": rate,
        "--period": period,
        "--beamformer": beamformer != "conventional",
    }
    worst = 0
    for source, name in zip(sources, names, strict=True):
        if is_recording_file(source):
            if given := [option for option, used in for_frames.items() if used]:
                raise ValueError(f"{', '.join(given)} is for frames, and {source} holds sound; leave it out")
            if array is None or band is None:
                raise ValueError(f"{source} needs --array positions.csv and --band LOW,HIGH in Hz")
            from servotrack.baselines.track_command.recording_command import (
                RecordingRequest,
                checked_beamformer,
                frequency_band,
                run_recording,
            )

            folder = Path("results") / "track" / name if out is None else out / name if len(sources) > 1 else out
            sound = RecordingRequest(
                Path(source),
                read_positions(array),
                frequency_band(band),
                rate,
                period,
                checked_beamformer(beamformer),
                truth,
            )
            run_recording(sound, folder, console(table_format))
            continue
        if given := [option for option, used in for_sound.items() if used]:
            raise ValueError(
                f"{', '.join(given)} is for recordings (.wav, .npy, .sio), and {source} is none; leave it out"
            )
        if is_points_file(source):
            from servotrack.baselines.track_command.points_command import run_points

            if given := [option for option, used in for_frames.items() if used]:
                raise ValueError(f"{', '.join(given)} is for frames, and {source} holds points; leave it out")
            folder = Path("results") / "track" / name if out is None else out / name if len(sources) > 1 else out
            run_points(Path(source), folder, truth, console(table_format))
            continue
        request = TrackRequest(
            SourceRequest(
                source,
                detector,
                None if classes is None else tuple(words(classes)),
                confidence,
                size,
                start,
                frames,
                stride,
                background,
                white,
            ),
            out / name if out is not None and len(sources) > 1 else out,
            tracker,
            tracker_values(settings),
            truth,
            match,
            benchmark,
            offline,
            tuple(words(tracks)),
            video,
            show_truth,
            places,
        )
        code = run_command(request, console(table_format))
        worst = max(worst, code)
        if code > 128:
            break
    if worst:
        raise typer.Exit(worst)


def render(
    out: Annotated[Path, typer.Argument(help="New folder for the sequence.")],
    level: Annotated[int, typer.Option("--level", "-l", help="Level of PedestrianTracking-v0, 0 to 5.")] = 0,
    settings: Settings = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episode.")] = 0,
) -> None:
    """Render people as a MOTChallenge sequence with images and exact truth, for `track` and any other tracker."""
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
    agent: Annotated[
        str | None, typer.Option("--agent", "-a", help="Agent to watch. Without one, drive the arm with the keyboard.")
    ] = None,
    level: Level = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the first episode.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Write a video (.webm, .mp4, .avi) instead of opening a window.")
    ] = None,
) -> None:
    """Watch an agent, or drive the arm with the arrow keys (escape ends)."""
    from servotrack.baselines.evaluation.watch import drive, watch

    find_user_modules(env, agent)
    kwargs = env_kwargs(level, settings)
    if video is not None:
        from servotrack.baselines.evaluation.watch import film_episode

        if agent is None:
            raise ValueError("--video needs an agent; add --agent lifted-kf")
        frames = film_episode(env, agent, video, kwargs, seed)
        console().print(f"{video}: {frames} frames")
    elif agent is None:
        drive(env, kwargs, seed)
    else:
        watch(env, agent, kwargs, seed)
