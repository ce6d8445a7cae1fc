"""Checks of arguments that all environments share."""

from __future__ import annotations

import difflib
import importlib.util
import math
import numbers
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

Range = tuple[float, float]
"""Lower and upper end of a uniform distribution."""

RENDER_MODES = ("rgb_array", "human")


def available_render_modes() -> list[str]:
    """Return the render modes for an environment's metadata: `human` only where pygame is installed.

    Checkers make an environment in every mode that its metadata lists.
    """
    return [mode for mode in RENDER_MODES if mode != "human" or importlib.util.find_spec("pygame") is not None]


def check_render_mode(render_mode: str | None) -> str | None:
    """Return the render mode; raises a ValueError with the valid modes if it is unknown."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {render_mode!r}")
    return render_mode


def check_options(options: dict[str, Any] | None) -> None:
    """Raise a ValueError for unknown reset options."""
    if options:
        raise ValueError(f"reset options {sorted(options)} are not known; parameters are keywords of gym.make")


def check_seed(seed: Any) -> int | None:
    """Return a seed as a Python integer, or None.

    Raises:
        TypeError: The seed is not an integer.
        ValueError: The seed is negative.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)):
        raise TypeError(f"seed must be None or an integer of at least 0, got {seed!r}")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed!r}")
    return int(seed)


def check_count(count: Any, name: str = "num_envs") -> int:
    """Return a number of scenes or threads; raises a ValueError unless it is a whole number of at least 1."""
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {count!r}")
    return int(count)


def check_level(level: Any, count: int) -> int:
    """Return the level; raises a ValueError unless it is a whole number from 0 to `count` - 1."""
    if isinstance(level, bool) or level not in range(count):
        raise ValueError(f"level must be a whole number from 0 to {count - 1}, got {level!r}")
    return int(level)


def check_keywords(names: Iterable[str], known: Sequence[str], also: Sequence[str] = ()) -> None:
    """Raise a TypeError for an unknown keyword, suggesting the nearest one of `known` and `also`.

    The message begins as Python's own, by which libraries recognize it: TorchRL passes `frameskip`, and makes the
    environment again without it after "unexpected keyword argument 'frameskip'".
    """
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, (*known, *also), n=1)
            hint = f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
            raise TypeError(f"got an unexpected keyword argument {name!r}{hint}")


def check_fields(
    config: Any,
    bounds: Iterable[tuple[str, float, float]],
    whole: Collection[str] = (),
    optional: Collection[str] = (),
) -> None:
    """Check numbers in a frozen dataclass, and convert whole numbers to integers.

    Args:
        config: The dataclass.
        bounds: Name, least and largest value of each field.
        whole: Fields that must be whole numbers.
        optional: Fields that may be None.

    Raises:
        ValueError: A value outside its bounds; the message has the field, its value and the bounds.
    """
    for name, low, high in bounds:
        value = getattr(config, name)
        if value is None and name in optional:
            continue
        number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and low <= value <= high):
            raise ValueError(f"{name} must lie in [{low:g}, {high:g}], got {value!r}")
        if name in whole:
            if int(value) != value:
                raise ValueError(f"{name} must be a whole number, got {value!r}")
            object.__setattr__(config, name, int(value))


def as_range(name: str, value: Any) -> Range:
    """Return an argument as (low, high); a single number becomes (number, number).

    Raises:
        ValueError: Neither a finite number nor two of them in ascending order; the message has the argument's name.
    """
    if is_number(value):
        return (float(value), float(value))
    if isinstance(value, (tuple, list)) and len(value) == 2 and all(is_number(v) for v in value):
        low, high = float(value[0]), float(value[1])
        if low <= high:
            return (low, high)
    raise ValueError(f"{name} must be a number or (low, high) with low <= high, got {value!r}")


def is_number(value: Any) -> bool:
    """Return True for finite real numbers, NumPy's included; False for bool."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
