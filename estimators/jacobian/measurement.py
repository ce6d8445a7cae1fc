"""Validation of measurements, shared by all Jacobian estimators."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.types import Array, Mask

CLOCK_TOLERANCE = 1e-6
"""Rounding error by which a frame's stamp may exceed the present time, s."""


def checked(measurement: ServoMeasurement) -> ServoMeasurement:
    """Check a measurement and convert it to float64 and bool arrays.

    Features of a frame that does not show the target may have any value, including NaN: they are never read.

    Args:
        measurement: Array-likes with the shapes that `ServoMeasurement` documents.

    Returns:
        The same values as arrays.

    Raises:
        ValueError: Shapes disagree, a value that is used is not finite, or a frame's stamp lies in the future. The
            message names the field, the value and the remedy.
    """
    # Contiguous arrays, so that each kernel is compiled only once.
    joint_angles = np.asarray(measurement.joint_angles, dtype=np.float64, order="C")
    features = np.asarray(measurement.features, dtype=np.float64, order="C")
    goal = np.asarray(measurement.goal, dtype=np.float64, order="C")
    visible = np.asarray(measurement.visible, dtype=np.bool_, order="C")
    frame_time = np.asarray(measurement.frame_time, dtype=np.float64, order="C")
    time = np.asarray(measurement.time, dtype=np.float64, order="C")

    if joint_angles.ndim == 0:
        raise ValueError(
            f"joint_angles must have shape (*batch, n), got the scalar {joint_angles}; pass one angle per joint"
        )
    if features.ndim == 0:
        raise ValueError(f"features must have shape (*batch, m), got the scalar {features}; pass one value per feature")
    batch = joint_angles.shape[:-1]
    wanted = {
        "features": (features, (*batch, features.shape[-1])),
        "goal": (goal, (*batch, features.shape[-1])),
        "visible": (visible, batch),
        "frame_time": (frame_time, batch),
        "time": (time, batch),
    }
    for name, (value, shape) in wanted.items():
        if value.shape != shape:
            raise ValueError(
                f"{name} must have shape {shape} beside joint_angles of shape {joint_angles.shape} and features of "
                f"shape {features.shape}, got {value.shape}; give every field the same leading batch axes"
            )
    everywhere = np.broadcast_to(True, batch)
    for name, value, needed, remedy in (
        ("joint_angles", joint_angles, everywhere[..., None], "repeat the last good reading instead"),
        ("goal", goal, everywhere[..., None], "repeat the last goal instead"),
        ("time", time, everywhere, "pass the clock's reading"),
        ("features", features, visible[..., None], "set visible to false for a lost frame"),
        ("frame_time", frame_time, visible, "set visible to false for a lost frame"),
    ):
        bad = ~np.isfinite(value) & needed
        if bad.any():
            raise ValueError(f"{name} must be finite, got {first_bad(value, bad)}; {remedy}")
    future = visible & (frame_time > time + CLOCK_TOLERANCE)
    if future.any():
        raise ValueError(
            f"frame_time must not lie after time, got {first_bad(frame_time, future)} at time "
            f"{first_bad(time, future)}; stamp frames with the clock of the encoders"
        )
    return ServoMeasurement(joint_angles, features, goal, visible, frame_time, time)


def first_bad(value: Array, bad: Mask) -> str:
    """Format the first entry of `value` where `bad` is true, with its index if there are several entries."""
    place = tuple(int(i) for i in np.argwhere(bad)[0])
    return f"{value[place]} at index {list(place)}" if value.size > 1 else f"{value[place]}"
