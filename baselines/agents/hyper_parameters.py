"""Numbers inside an estimator by their path: "walk.joint_noise", or "models.0.jerk" for a member of a tuple."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from numbers import Real
from typing import Any, TypeVar

EstimatorT = TypeVar("EstimatorT")


def value_at(estimator: object, path: str) -> float:
    """Return the number at a path.

    Raises:
        ValueError: A path that leads nowhere.
    """
    found: Any = estimator
    for name in path.split("."):
        found = _part(found, name, path)
    return found


def with_values(estimator: EstimatorT, values: Mapping[str, float]) -> EstimatorT:
    """Return a copy of an estimator with other numbers; the estimator's own checks apply.

    Args:
        estimator: A dataclass, which may hold dataclasses, named tuples, and tuples of them.
        values: Path to number.

    Raises:
        ValueError: A path that leads nowhere, a value that is not a number, or one that the estimator refuses.
    """
    for path, value in values.items():
        if not isinstance(value, Real):
            raise ValueError(f"values: {path} must be a number, got {value!r}")
        estimator = _replaced(estimator, path, path, value)
    return estimator


def _replaced(owner: Any, rest: str, path: str, value: float) -> Any:
    name, dot, deeper = rest.partition(".")
    old = _part(owner, name, path)
    new = _replaced(old, deeper, path, value) if dot else value
    if hasattr(owner, "_replace"):
        return owner._replace(**{name: new})
    if isinstance(owner, tuple):
        return (*owner[: int(name)], new, *owner[int(name) + 1 :])
    return replace(owner, **{name: new})


def _part(owner: Any, name: str, path: str) -> Any:
    if isinstance(owner, tuple) and not hasattr(owner, "_fields") and name.isdigit() and int(name) < len(owner):
        return owner[int(name)]
    known = [field.name for field in fields(owner)] if is_dataclass(owner) else list(getattr(owner, "_fields", ()))
    if name in known:
        return getattr(owner, name)
    has = ", ".join(known) or (f"{len(owner)} members" if isinstance(owner, tuple) else "no parts")
    raise ValueError(f"values: {path!r} leads nowhere at {name!r}; {type(owner).__name__} has {has}")
