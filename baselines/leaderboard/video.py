"""Films of agents at work."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.evaluate import make_single
from servotrack.baselines.registry import agent_card, create_agent
from servotrack.baselines.results import atomic_path

CODECS = {".webm": "VP80", ".mp4": "mp4v", ".avi": "MJPG"}
"""Browsers play VP8 in WebM (VP9 takes four times as long to write); OpenCV's wheels cannot write H.264."""

Frame = NDArray[np.uint8]


def film_episode(
    env_id: str, agent: str, path: Path, env_kwargs: Mapping[str, Any] | None = None, seed: int | None = None
) -> int:
    """Write a film of one episode, whole or not at all.

    Args:
        env_id: Gymnasium id with `rgb_array` rendering.
        agent: What `create_agent` takes.
        path: Ends in .webm, .mp4 or .avi.
        env_kwargs: Arguments of the environment.
        seed: Of the episode.

    Returns:
        Number of frames.

    Raises:
        ValueError: Another suffix, or an environment that draws nothing.
        RuntimeError: OpenCV cannot write this format here.
    """
    check_film_path(path)
    card = agent_card(agent)
    env = make_single(env_id, {**(env_kwargs or {}), "render_mode": "rgb_array"}, privileged=card.privileged)
    try:
        rate = float(env.metadata.get("render_fps", 20))
        return write_film(_episode_frames(env, create_agent(card, env), seed), path, rate)
    finally:
        env.close()


def check_film_path(path: Path) -> None:
    """Raises ValueError unless the path's suffix is one that can be written."""
    if path.suffix not in CODECS:
        raise ValueError(f"video must end in {', '.join(CODECS)}, got {str(path)!r}")


def write_film(frames: Iterator[Frame], path: Path, rate: float) -> int:
    """Write RGB frames.

    Args:
        frames: All of one size, shape (H, W, 3).
        path: Ends in .webm, .mp4 or .avi.
        rate: Frames per second.

    Returns:
        Number of frames.

    Raises:
        ValueError: Another suffix, or no frames.
        RuntimeError: OpenCV cannot write this format here.
    """
    import cv2

    check_film_path(path)
    first = next(frames, None)
    if first is None:
        raise ValueError("frames must hold at least one frame, got none")
    height, width = first.shape[:2]
    # Codecs want even sides.
    height, width = height - height % 2, width - width % 2
    with atomic_path(path) as temporary:
        with _hushed():
            codec = cv2.VideoWriter.fourcc(*CODECS[path.suffix])
            writer = cv2.VideoWriter(str(temporary), codec, rate, (width, height))
        if not writer.isOpened():
            raise RuntimeError(
                f"this OpenCV cannot write {CODECS[path.suffix]} into {path.suffix}; try {', '.join(CODECS)}"
            )
        count = 0
        frame: Frame | None = first
        while frame is not None:
            writer.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
            count += 1
            frame = next(frames, None)
        writer.release()
    return count


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Keep OpenCV from complaining, past Python's streams, that WebM has no tags for codecs: it writes all the same."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _episode_frames(env: Any, agent: Any, seed: int | None) -> Iterator[Frame]:
    observation, _ = env.reset(seed=seed)
    state: Any = None
    over = False
    while not over:
        yield _frame(env)
        action, state = agent.predict(
            observation, state=state, episode_start=np.asarray(state is None), deterministic=True
        )
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    yield _frame(env)


def _frame(env: Any) -> Frame:
    frame = env.render()
    if not isinstance(frame, np.ndarray) or frame.ndim != 3:
        raise ValueError(f"{env.spec.id} must draw rgb_array frames to be filmed, got {type(frame).__name__}")
    return frame
