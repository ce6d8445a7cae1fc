"""Front door of the Jacobian estimators: validation of their measurements."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import LIMITS, as_mask, as_numbers, check_within, first_bad

CLOCK_TOLERANCE = 1e-6
"""Rounding error by which a stamp may exceed the present time, s."""


def checked(measurement: ServoMeasurement, *, each_feature: bool = False) -> ServoMeasurement:
    """Check a measurement and convert it to float64 and bool arrays.

    Features of a frame that does not show the target, and its time stamp, may have any value, including NaN: they count
    as unseen and are never read. All other values must be finite and within `servotrack.estimators.validation.LIMITS`.

    Args:
        measurement: Array-likes with the shapes that `ServoMeasurement` documents.
        each_feature: True for estimators that use features one by one. `visible` is then repeated for all features;
            where it has entries along their axis, a NaN counts as unseen. False refuses such entries.

    Returns:
        The same values as arrays in C order; `joint_time` stays None. `visible` has shape (*batch,), or (*batch, m) if
        `each_feature`.

    Raises:
        ValueError: A field is not numeric, shapes disagree, a value that is used is not finite or beyond its limit, or
            a stamp lies in the future. The message names the field, the value and the remedy.
    """
    # Contiguous arrays, so that each kernel is compiled only once.
    joint_angles = as_numbers("joint_angles", measurement.joint_angles)
    features = as_numbers("features", measurement.features)
    goal = as_numbers("goal", measurement.goal)
    visible = as_mask("visible", measurement.visible)
    frame_time = as_numbers("frame_time", measurement.frame_time)
    time = as_numbers("time", measurement.time)
    joint_time = None if measurement.joint_time is None else as_numbers("joint_time", measurement.joint_time)

    if joint_angles.ndim == 0:
        raise ValueError(
            f"joint_angles must have shape (*batch, n), got the scalar {joint_angles}; pass one angle per joint"
        )
    if features.ndim == 0:
        raise ValueError(f"features must have shape (*batch, m), got the scalar {features}; pass one value per feature")
    if 0 in (joint_angles.shape[-1], features.shape[-1]):
        raise ValueError(
            "joint_angles and features must have at least one entry per row, got shapes "
            f"{joint_angles.shape} and {features.shape}"
        )
    batch = joint_angles.shape[:-1]
    if each_feature:
        visible = _of_each(visible, features, batch)
    wanted = {
        "features": (features, (*batch, features.shape[-1])),
        "goal": (goal, (*batch, features.shape[-1])),
        "visible": (visible, (*batch, features.shape[-1]) if each_feature else batch),
        "frame_time": (frame_time, batch),
        "time": (time, batch),
    }
    if joint_time is not None:
        wanted["joint_time"] = (joint_time, batch)
    for name, (value, shape) in wanted.items():
        if value.shape != shape:
            remedy = "give every field the same leading batch axes"
            if name == "visible" and value.shape[:-1] == batch:
                remedy = "wrap the estimator in FeatureWise, or pass visible.all(axis=-1) to use whole frames only"
            raise ValueError(
                f"{name} must have shape {shape} beside joint_angles of shape {joint_angles.shape} and features of "
                f"shape {features.shape}, got {value.shape}; {remedy}"
            )
    read_at = time if joint_time is None else joint_time
    mask = visible if each_feature else visible[..., None]
    clocks = frame_time.reshape(-1), time.reshape(-1), read_at.reshape(-1)
    if _are_sound(joint_angles.reshape(-1), features, goal, mask, clocks, (*LIMITS[:3], CLOCK_TOLERANCE)):
        return ServoMeasurement(joint_angles, features, goal, visible, frame_time, time, joint_time)
    # What is wrong, in words.
    check_within("joint_angles", joint_angles, LIMITS.angles, "repeat the last good reading instead")
    check_within("goal", goal, LIMITS.pixels, "repeat the last goal instead")
    check_within("time", time, LIMITS.times, "pass the clock's reading")
    unseen = "set visible to false for a lost frame, or give each point or feature its own entry"
    seen: Mask = np.asarray(visible.any(axis=-1)) if each_feature else visible
    check_within("features", features, LIMITS.pixels, unseen, visible if each_feature else visible[..., None])
    check_within("frame_time", frame_time, LIMITS.times, unseen, seen)
    future = seen & (frame_time > time + CLOCK_TOLERANCE)
    if future.any():
        raise ValueError(
            f"frame_time must not lie after time, got {first_bad(frame_time, future)} at time "
            f"{first_bad(time, future)}; stamp frames with the clock of the encoders"
        )
    if joint_time is not None:
        check_within("joint_time", joint_time, LIMITS.times, "pass the encoders' clock, or None for the present")
        future = joint_time > time + CLOCK_TOLERANCE
        if future.any():
            raise ValueError(
                f"joint_time must not lie after time, got {first_bad(joint_time, future)} at time "
                f"{first_bad(time, future)}; stamp encoder readings with the clock of `time`"
            )
    return ServoMeasurement(joint_angles, features, goal, visible, frame_time, time, joint_time)


def _are_sound(joint_angles: Array, features: Array, goal: Array, mask: Mask, clocks: Any, limits: Any) -> bool:
    """Return True if all values that are used are finite, within their limits and not later than the present."""
    rows, m, entries = clocks[1].size, features.shape[-1], mask.shape[-1]
    shaped = features.reshape(rows, m), goal.reshape(-1), mask.reshape(rows, entries)
    return bool(_within_limits(joint_angles, *shaped, *clocks, limits))


@njit(cache=True, nogil=True)
def _within_limits(joint_angles, features, goal, mask, frame_time, time, read_at, limits):  # type: ignore[no-untyped-def]
    """See `_are_sound`; rows of `mask` have one entry, or one per feature."""
    pixels, angles, times, tolerance = limits
    sound = True
    for i in range(joint_angles.shape[0]):
        sound = sound and abs(joint_angles[i]) <= angles
    for i in range(goal.shape[0]):
        sound = sound and abs(goal[i]) <= pixels
    for row in range(time.shape[0]):
        seen = False
        for i in range(features.shape[1]):
            if mask[row, i % mask.shape[1]]:
                seen = True
                sound = sound and abs(features[row, i]) <= pixels
        if seen:
            sound = sound and abs(frame_time[row]) <= times and frame_time[row] <= time[row] + tolerance
        sound = sound and abs(time[row]) <= times and abs(read_at[row]) <= times
        sound = sound and read_at[row] <= time[row] + tolerance
    return sound


def _of_each(visible: Mask, features: Array, batch: tuple[int, ...]) -> Mask:
    """Mask of each feature. Where `visible` has entries along the features' axis, a NaN counts as unseen."""
    if visible.shape == batch:
        return np.repeat(visible[..., None], features.shape[-1], axis=-1)
    if visible.shape[:-1] != batch or visible.ndim != len(batch) + 1:
        return visible
    m, groups = features.shape[-1], visible.shape[-1]
    if groups == 0 or m % groups:
        raise ValueError(
            f"visible must have one entry, one per feature, or one per group of features in a row, got shape "
            f"{visible.shape} beside features of shape {features.shape}; pass {batch}, {(*batch, m)}, or "
            f"{(*batch, 'p')} for p points of {m} / p features each"
        )
    repeated = np.repeat(visible, m // groups, axis=-1)
    return repeated & ~np.isnan(features) if features.shape == repeated.shape else repeated
