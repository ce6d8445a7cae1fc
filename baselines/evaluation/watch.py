"""Watch an agent in a window or on film, or drive an arm by keyboard."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.baselines.agents.registry import agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_single, show_belief
from servotrack.baselines.reporting.film import check_film_path, write_film
from servotrack.envs.drawing.glyphs import put_text
from servotrack.estimators.types import FloatArray, Image

KEYS = {"right": (0, 1.0), "left": (0, -1.0), "up": (1, 1.0), "down": (1, -1.0)}
"""Arrow keys: which joint, which way."""
KEY_RATE = 0.5
"""Fraction of the joint rate limit that a held key commands."""

CAPTION_HEIGHT = 28
"""Height of the strip that names agent, level and seed, px."""
CAPTION_PAPER, CAPTION_INK = (250, 250, 247), (29, 39, 51)
CAPTION_SIGNS = frozenset("abcdefghijklmnopqrstuvwxyz0123456789 .:-+/%")


def film_episode(
    env_id: str, agent: str, path: Path, env_kwargs: Mapping[str, Any] | None = None, seed: int | None = None
) -> int:
    """Write a film of one episode, whole or not at all.

    Args:
        env_id: Gymnasium id with `rgb_array` rendering.
        agent: Agent as `create_agent` takes it.
        path: Ends in .webm, .mp4 or .avi.
        env_kwargs: Arguments of the environment.
        seed: Seed of the episode.

    Returns:
        Number of frames.

    Raises:
        ValueError: Another suffix, or an environment that draws nothing.
        FilmError: OpenCV cannot write this format here.
    """
    check_film_path(path)
    card = agent_card(agent)
    env = make_single(env_id, {**(env_kwargs or {}), "render_mode": "rgb_array"}, privileged=card.privileged)
    try:
        rate = float(env.metadata.get("render_fps", 20))
        level = getattr(env.unwrapped, "level", None)
        caption = f"{card.name}" + ("" if level is None else f"   level {level}") + f"   seed {seed}"
        frames = _episode_frames(env, create_agent(card, env), seed)
        return write_film((_captioned(frame, caption) for frame in frames), path, rate)
    finally:
        env.close()


def watch(env_id: str, agent: str, env_kwargs: Mapping[str, Any], seed: int | None = None) -> None:
    """Show one episode of an agent in a window.

    Raises:
        gymnasium.error.DependencyNotInstalled: The extra `human` is missing.
    """
    card = agent_card(agent)
    env = make_single(env_id, {**env_kwargs, "render_mode": "human"}, privileged=card.privileged)
    try:
        player = create_agent(card, env)
        observation, _ = env.reset(seed=seed)
        state: Any = None
        over = False
        while not over:
            start = np.asarray(state is None)
            action, state = player.predict(observation, state=state, episode_start=start, deterministic=True)
            show_belief(env, state)
            observation, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
    finally:
        env.close()


def drive(env_id: str, env_kwargs: Mapping[str, Any], seed: int | None = None) -> None:
    """Let the user drive: left and right turn the first joint, up and down the second, escape or a closed window ends.

    Raises:
        ValueError: Actions are not the joint rates of at least two joints.
        gymnasium.error.DependencyNotInstalled: The extra `human` is missing.
    """
    from servotrack.envs.drawing.viewer import Viewer

    env = make_single(env_id, {**env_kwargs, "render_mode": "rgb_array"})
    try:
        space = env.action_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or space.shape[0] < 2:
            raise ValueError(
                f"{env_id} cannot be driven by arrow keys: its actions are {space}; name an --agent to watch"
            )
        viewer = Viewer(f"{env_id}: arrow keys drive, escape ends", float(env.metadata.get("render_fps", 20)))
        env.reset(seed=seed)
        viewer.show(env.render())
        while not viewer.closed and "escape" not in (held := viewer.held_keys()):
            _, _, terminated, truncated, _ = env.step(key_action(held, space.shape[0]))
            if terminated or truncated:
                env.reset()
            viewer.show(env.render())
        viewer.close()
    finally:
        env.close()


def key_action(held: frozenset[str], joints: int) -> FloatArray:
    """Joint rates that the held keys ask for, fractions of the limit. Shape (joints,)."""
    action = np.zeros(joints, dtype=np.float32)
    for key, (joint, way) in KEYS.items():
        if key in held:
            action[joint] += way * KEY_RATE
    return action


def _episode_frames(env: Any, agent: Any, seed: int | None) -> Iterator[Image]:
    observation, _ = env.reset(seed=seed)
    state: Any = None
    over = False
    while not over:
        yield _frame(env)
        action, state = agent.predict(
            observation, state=state, episode_start=np.asarray(state is None), deterministic=True
        )
        show_belief(env, state)
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    yield _frame(env)


def _frame(env: Any) -> Image:
    frame = env.render()
    if not isinstance(frame, np.ndarray) or frame.ndim != 3:
        raise ValueError(f"{env.spec.id} must draw rgb_array frames to be filmed, got {type(frame).__name__}")
    return frame


def _captioned(frame: Image, caption: str) -> Image:
    """Frame with a line of text in a strip below it, shape (height + CAPTION_HEIGHT, width, 3)."""
    strip = np.full((CAPTION_HEIGHT, frame.shape[1], 3), CAPTION_PAPER, dtype=np.uint8)
    # The font of the pictures has digits, lower-case letters and a few signs.
    text = "".join(sign if sign in CAPTION_SIGNS else " " for sign in caption.lower().replace("_", "-"))
    put_text(strip, text, 12.0, CAPTION_HEIGHT - 9.0, CAPTION_INK, height=9.0)
    return np.concatenate([frame, strip])
