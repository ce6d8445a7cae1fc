"""Checks of the arguments that all environments share."""

from __future__ import annotations

from typing import Any

import numpy as np

RENDER_MODES = ("rgb_array", "human")


def check_render_mode(render_mode: str | None) -> str | None:
    """The render mode, if it is one; raises ValueError naming the known ones otherwise."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {render_mode!r}")
    return render_mode


def check_options(options: dict[str, Any] | None) -> None:
    """Raises ValueError where reset options are given that do not exist."""
    if options:
        raise ValueError(f"reset options {sorted(options)} are not known; parameters are keywords of gym.make")


def check_seed(seed: Any) -> int | None:
    """A seed as a Python integer, or None.

    Raises:
        TypeError: Not an integer.
        ValueError: Negative.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)):
        raise TypeError(f"seed must be None or an integer of at least 0, got {seed!r}")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed!r}")
    return int(seed)


def check_count(num_envs: Any) -> int:
    """The number of scenes; raises ValueError where it is no whole number of at least 1."""
    if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
        raise ValueError(f"num_envs must be a whole number of at least 1, got {num_envs!r}")
    return int(num_envs)
