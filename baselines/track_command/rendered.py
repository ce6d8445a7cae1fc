"""Render a pedestrian scene as a MOTChallenge sequence, for `servotrack track` and any other tracker."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np

from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import ResultsError, storage_error
from servotrack.baselines.reporting.temporary import unfinished_folder
from servotrack.baselines.running import unfinished
from servotrack.baselines.running.stopping import undisturbed
from servotrack.envs.track.files.mot_files import SequenceInfo, truth_row, write_seqinfo

ENVIRONMENT = "PedestrianTracking-v0"
QUALITY = 95
"""JPEG quality of the images."""


def render_sequence(
    folder: Path, axes: Mapping[str, Any], seed: int, on_frame: Callable[[int], None] | None = None
) -> int:
    """Write img1/, gt/gt.txt and seqinfo.ini of an episode. The folder appears only once it is complete.

    People with less than a fifth visible have flag 0 in gt.txt, so that they do not count.

    Args:
        folder: New folder. An earlier rendered sequence there is replaced.
        axes: Keywords of `PedestrianTracking-v0`, including `level`.
        seed: Seed of the episode.
        on_frame: Called after each frame with the number of frames left.

    Returns:
        Number of frames.

    Raises:
        ValueError: Keyword out of range, or an observation other than pixels.
        ResultsError: The folder contains other files.
        StorageError: The folder cannot be written.
    """
    if axes.get("observation", "pixels") != "pixels":
        raise ValueError(f"observation must be 'pixels' for a sequence of images, got {axes['observation']!r}")
    if folder.exists() and not (folder / "seqinfo.ini").is_file() and (folder.is_file() or any(folder.iterdir())):
        raise ResultsError(f"{folder} holds files that are not a rendered sequence; choose another folder")
    env = gym.make(ENVIRONMENT, **axes)
    horizon = int(env.get_wrapper_attr("config").horizon)
    ResultsFolder(folder.parent).check_writable()
    try:
        with unfinished_folder(folder.parent) as growing:
            growing.chmod(0o755)
            _write_sequence(growing, folder.name, env, seed, on_frame)
            _put_in_place(growing, folder)
    except OSError as error:
        raise storage_error(folder, error) from error
    finally:
        env.close()
    return horizon


def _write_sequence(
    growing: Path, name: str, env: gym.Env[Any, Any], seed: int, on_frame: Callable[[int], None] | None
) -> None:
    """Play an episode and write its images, its truth and seqinfo.ini into an empty folder."""
    scene: Any = env.get_wrapper_attr("scene_model")
    horizon = int(env.get_wrapper_attr("config").horizon)
    (growing / "img1").mkdir()
    (growing / "gt").mkdir()
    silent = np.zeros(env.action_space.shape or (), np.float64)
    image, info = env.reset(seed=seed)
    rows = []
    for number in range(1, horizon + 1):
        _write_image(growing / "img1" / f"{number:06d}.jpg", image)
        truth = info["truth"]
        for row in np.flatnonzero(truth["ids"] > 0).tolist():
            rows.append(
                truth_row(
                    number,
                    int(truth["ids"][row]),
                    truth["boxes"][row],
                    bool(truth["exists"][row]),
                    float(truth["visibility"][row]),
                )
            )
        image, _, _, _, info = env.step(silent)
        if on_frame is not None:
            on_frame(horizon - number)
    (growing / "gt" / "gt.txt").write_text("".join(rows), encoding="ascii")
    write_seqinfo(
        growing / "seqinfo.ini", SequenceInfo(name, "img1", scene.frame_rate, horizon, scene.width, scene.height)
    )


def _put_in_place(growing: Path, folder: Path) -> None:
    """Rename a complete folder. An earlier one is removed only after that."""
    earlier = folder.with_name(f".{folder.name}-{secrets.token_hex(6)}")
    with undisturbed():
        if folder.exists():
            folder.replace(earlier)
        growing.replace(folder)
        unfinished.begin(earlier)
    shutil.rmtree(earlier, ignore_errors=True)
    unfinished.end(earlier)


def _write_image(path: Path, image: Any) -> None:
    coded, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not coded:
        raise ResultsError(f"{path} cannot be encoded as JPEG")
    path.write_bytes(data.tobytes())
