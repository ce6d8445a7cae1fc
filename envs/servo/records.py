"""Records of a servo world: for each arm one of its constants in an episode and one of its newest sample.

One array of records per kind keeps compiled calls cheap: each array handed over costs a tenth of a microsecond.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.camera import CAMERA_SIZE
from servotrack.estimators.types import Array, Mask

RING = 8
"""Number of past joint angles that a world stores, for frames that arrive late."""

CONSTANTS = np.dtype(
    [
        ("links", np.float64, 2),
        ("camera", np.float64, CAMERA_SIZE),
        ("goal", np.float64, 2),
        ("gain", np.float64, 2),
        ("noise_levels", np.float64, 2),
        ("latency", np.int64),
        ("encoder_age", np.int64),
        ("knocked_at", np.int64),
        ("knocked", np.float64, CAMERA_SIZE),
    ],
    align=True,
)
"""Constants of an arm's episode, written at reset.

`links` m; `camera` as `pack_camera` packs it; `goal` features, px; `gain`, factors on the joint rates; `noise_levels`,
standard deviations of encoders (rad) and joint rates (rad/s); `latency`, age of a frame when it arrives, samples;
`encoder_age`, age of the observed joint angles, samples; `knocked_at`, index into the tables from which on the camera
is `knocked` instead of `camera`.
"""

SAMPLE = np.dtype(
    [
        ("steps", np.int64),
        ("out_of_view", np.int64),
        ("captured", np.int64),
        ("rates", np.float64, 2),
        ("drive", np.float64, 2),
        ("play", np.float64, 2),
        ("time", np.float64),
        ("tool", np.float64, 2),
        ("target", np.float64, 4),
        ("tracking_error", np.float64),
        ("feature_error", np.float64),
        ("reward", np.float64),
        ("joint_angles", np.float64, 2),
        ("features", np.float64, 2),
        ("visible", np.float64),
        ("frame_time", np.float64),
        ("terminated", np.bool_),
        ("truncated", np.bool_),
    ],
    align=True,
)
"""Newest sample of an arm, written at every step.

`steps` since the reset; `out_of_view`, samples since the target was last in view; `captured`, index into the tables of
the newest frame that arrived with an image; `rates` of the joints in the last period, rad/s; `drive`, rates of the
motors that follow with a lag, rad/s; `play`, angles of the motors ahead of the middle of their gears' play, rad; the
others as attributes of `ServoWorld`.
"""


def _places(name: str) -> slice:
    assert SAMPLE.fields is not None
    field, offset = SAMPLE.fields[name][:2]
    return slice(offset // 8, (offset + field.itemsize) // 8)


PLACES = {name: _places(name) for name in SAMPLE.names or () if SAMPLE[name].base == np.float64}
"""Place of each field of a sample that holds floats, if the sample is read as a row of numbers of 64 bits."""


SETTINGS = np.dtype(
    [
        ("max_joint_rate", np.float64),
        ("substep", np.float64),
        ("warmup", np.int64),
        ("horizon", np.int64),
        ("lost_after", np.int64),
        ("camera_size", np.float64),
        ("shutter", np.float64),
        ("stamped", np.bool_),
        ("quantized", np.bool_),
        ("lag", np.float64),
        ("backlash", np.float64),
    ],
    align=True,
)
"""Parameters of a world that its motion, sensors and scores depend on.

`max_joint_rate` at action 1, rad/s; `substep`, duration of a substep of the physics, s; `warmup`, number of unscored
steps at the start; `horizon`, number of scored steps; `lost_after`, number of consecutive samples out of view that
ends an episode; `camera_size`, width and height of the image, px; `shutter`, duration of the rolling shutter's readout,
s, 0 for a global shutter; `stamped`, True if frames carry the time when they were taken, False for the time of their
arrival; `quantized`, True if features are rounded to the centers of pixels; `lag`, share of the last rate that is left
after a period; `backlash`, play of the gears, rad.
"""


class Tables(NamedTuple):
    """Draws of the episodes of N arms, with K samples each. Written at reset. A table with 0 samples is unused.

    Attributes:
        paths: The target's positions and velocities, (N, K, 4) m, m/s.
        feature_noise: Noise of the features, (N, K or 0, 2) px.
        rate_noise: Noise of the joint rates, (N, K or 0, 2) rad/s.
        encoder_noise: Noise of the encoders, (N, K or 0, 2) rad.
        dropped: Mask of the lost frames, (N, K or 0).
        focal_factor: Focal length over the drawn one, (N, K or 0).
    """

    paths: Array
    feature_noise: Array
    rate_noise: Array
    encoder_noise: Array
    dropped: Mask
    focal_factor: Array
