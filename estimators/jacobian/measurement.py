"""Front door of the Jacobian estimators: validation of their measurements."""

from __future__ import annotations

from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.validation import LIMITS, as_mask, as_numbers, check_within, first_bad

CLOCK_TOLERANCE = 1e-6
"""Rounding error by which a frame's stamp may exceed the present time, s."""


def checked(measurement: ServoMeasurement) -> ServoMeasurement:
    """Check a measurement and convert it to float64 and bool arrays.

    Features of a frame that does not show the target, and its time stamp, may have any value, including NaN: they count
    as unseen and are never read. All other values must be finite and within `servotrack.estimators.validation.LIMITS`.

    Args:
        measurement: Array-likes with the shapes that `ServoMeasurement` documents.

    Returns:
        The same values as arrays in C order.

    Raises:
        ValueError: A field is not numeric, shapes disagree, a value that is used is not finite or beyond its limit, or
            a frame's stamp lies in the future. The message names the field, the value and the remedy.
    """
    # Contiguous arrays, so that each kernel is compiled only once.
    joint_angles = as_numbers("joint_angles", measurement.joint_angles)
    features = as_numbers("features", measurement.features)
    goal = as_numbers("goal", measurement.goal)
    visible = as_mask("visible", measurement.visible)
    frame_time = as_numbers("frame_time", measurement.frame_time)
    time = as_numbers("time", measurement.time)

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
    check_within("joint_angles", joint_angles, LIMITS.angles, "repeat the last good reading instead")
    check_within("goal", goal, LIMITS.pixels, "repeat the last goal instead")
    check_within("time", time, LIMITS.times, "pass the clock's reading")
    unseen = "set visible to false for a lost frame"
    check_within("features", features, LIMITS.pixels, unseen, visible[..., None])
    check_within("frame_time", frame_time, LIMITS.times, unseen, visible)
    future = visible & (frame_time > time + CLOCK_TOLERANCE)
    if future.any():
        raise ValueError(
            f"frame_time must not lie after time, got {first_bad(frame_time, future)} at time "
            f"{first_bad(time, future)}; stamp frames with the clock of the encoders"
        )
    return ServoMeasurement(joint_angles, features, goal, visible, frame_time, time)
