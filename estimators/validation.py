"""Front door of all estimators: conversion of array-likes to arrays, and limits on their values.

An estimator computes with float64 arrays. The functions here convert what a caller passes (any numeric type, memory
order and byte order, nested lists) without a change of value, and refuse everything else with a ValueError that names
the argument, the value and the remedy: text, objects, ragged lists, complex numbers, masked entries, NaN, infinity,
and magnitudes beyond a family's limit, from which rounding errors would destroy covariances.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array, Mask

_FLOAT64 = np.dtype(np.float64)
_BOOL = np.dtype(np.bool_)


class Limits(NamedTuple):
    """Largest accepted magnitudes of measured values.

    Attributes:
        pixels: Image features, goals and boxes of servo measurements, px.
        angles: Joint angles, rad.
        times: Clock readings, s; enough for Unix time.
        coordinates: Measurements of a set filter, in the unit of its model.
        boxes: Corners, sizes and areas' square roots of boxes in images, px.
        scores: Confidences and entries of appearance vectors.
        powers: Beam powers of a sonar.
    """

    pixels: float = 1e9
    angles: float = 1e6
    times: float = 1e10
    coordinates: float = 1e9
    boxes: float = 1e6
    scores: float = 1e9
    powers: float = 1e30


SMALLEST_NUMBER, LARGEST_NUMBER = float(np.finfo(np.float64).smallest_subnormal), float(np.finfo(np.float64).max)
"""Ends of the finite positive numbers."""

LIMITS = Limits()
"""Limits that all estimators share."""


def as_numbers(name: str, value: ArrayLike) -> Array:
    """Convert to a float64 array in C order, without a copy if the value already is one.

    Args:
        name: Name of the argument, with which the error message begins.
        value: Array-like of real numbers.

    Raises:
        ValueError: The value is text, ragged, complex, masked or made of other objects.
    """
    if type(value) is np.ndarray and value.dtype is _FLOAT64 and value.flags.c_contiguous:
        return value
    array = as_array(name, value)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} must be real numbers, got {_described(array)}; convert it to float64 first")
    return np.asarray(array, dtype=np.float64, order="C")


def as_mask(name: str, value: ArrayLike) -> Mask:
    """Convert to a bool array in C order; numbers are accepted if they are 0 or 1.

    Args:
        name: Name of the argument, with which the error message begins.
        value: Array-like of truth values.

    Raises:
        ValueError: An entry is neither a truth value nor 0 or 1.
    """
    if type(value) is np.ndarray and value.dtype is _BOOL and value.flags.c_contiguous:
        return value
    array = as_array(name, value)
    if array.dtype.kind != "b":
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name} must be true or false, got {_described(array)}; convert it to bool first")
        bad = ~((array == 0) | (array == 1))
        if bad.any():
            raise ValueError(f"{name} must be true or false (1 or 0), got {first_bad(array, bad)}; pass a bool array")
    return np.asarray(array, dtype=np.bool_, order="C")


def is_within(array: Array, limit: float) -> bool:
    """Return True if all entries are finite and their magnitudes at most `limit`."""
    return bool(np.abs(array).max(initial=0.0) <= limit)


def check_within(name: str, array: Array, limit: float, remedy: str, used: Mask | None = None) -> None:
    """Check that numbers are finite and within a limit.

    Args:
        name: Name of the argument, with which the error message begins.
        array: Numbers.
        limit: Largest accepted magnitude.
        remedy: Advice for numbers that are not finite, the end of the message.
        used: Mask of the entries that count, which broadcasts against `array`; None for all.

    Raises:
        ValueError: An entry that counts is NaN, infinite or beyond the limit.
    """
    if is_within(array, limit):
        return
    bad = ~(np.abs(array) <= limit)
    if used is not None:
        bad &= used
    if not bad.any():
        return
    infinite = bad & ~np.isfinite(array)
    if infinite.any():
        raise ValueError(f"{name} must be finite, got {first_bad(array, infinite)}; {remedy}")
    raise ValueError(
        f"{name} must be at most {limit:g} in magnitude, got {first_bad(array, bad)}; check its unit and its source"
    )


def first_bad(value: Any, bad: Mask) -> str:
    """Format the first entry of `value` where `bad` is true, with its index if there are several entries."""
    place = tuple(int(i) for i in np.argwhere(bad)[0])
    return f"{value[place]} at index {list(place)}" if value.size > 1 else f"{value[place]}"


def as_array(name: str, value: Any) -> np.ndarray:
    """Convert to an array of any type.

    Args:
        name: Name of the argument, with which the error message begins.
        value: Array-like.

    Raises:
        ValueError: The value is ragged or has masked entries.
    """
    if isinstance(value, np.ma.MaskedArray):
        if np.ma.is_masked(value):
            raise ValueError(f"{name} must not have masked entries, got {value}; leave them out or fill them in")
        value = value.data
    try:
        return np.asarray(value)
    except (ValueError, TypeError, OverflowError):
        raise ValueError(
            f"{name} must be an array of numbers, got rows of different lengths or other objects, {_shortened(value)}; "
            "give all rows one length"
        ) from None


def _described(array: np.ndarray) -> str:
    what = {"U": "text", "S": "bytes", "O": "objects", "c": "complex numbers"}.get(array.dtype.kind, str(array.dtype))
    return f"{what} {_shortened(array.tolist())}"


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def checked_number(name: str, value: Any, least: float, most: float, rule: str) -> float:
    """Return one real number, which may be an array without axes.

    Args:
        name: Name of the argument, with which the error message begins.
        value: The number.
        least: Smallest accepted value.
        most: Largest accepted value.
        rule: Rule for the error message, after "must be", with a remedy at its end.

    Raises:
        ValueError: The value is no real number, or out of range.
    """
    if type(value) is float and least <= value <= most:
        return value
    array = as_array(name, value)
    if array.shape != () or array.dtype.kind not in "fiub" or not least <= array <= most:
        described = f"{value!r}" if np.isscalar(value) or value is None else _shortened(value)
        wanted, _, remedy = rule.partition("; ")
        raise ValueError(f"{name} must be {wanted}, got {described}" + (f"; {remedy}" if remedy else ""))
    return float(array)


def check_count(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Raise ValueError unless a value is a whole number, no truth value, of at least `least` and at most `most`."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
    if not whole or value < least or (most is not None and value > most):
        limits = f"at least {least}" + ("" if most is None else f" and at most {most}")
        raise ValueError(f"{name} must be {limits}, got {value!r}; counts are whole numbers")


def checked_period(dt: float | None, frame_rate: float) -> float:
    """Return the time since the last frame, s.

    Args:
        dt: Measured time since the last frame, s; None if unknown.
        frame_rate: Frames per second, used where `dt` is None.

    Raises:
        ValueError: `dt` is not a positive number.
    """
    if dt is None:
        return 1.0 / frame_rate
    rule = "finite and > 0; pass the time since the last frame in s, or None"
    return checked_number("dt", dt, SMALLEST_NUMBER, LARGEST_NUMBER, rule)
