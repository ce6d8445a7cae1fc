"""Table of all environment ids, and their registration."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "UncalibServo-v0": {
        "entry_point": "servotrack.envs.servo.env:UncalibServoEnv",
        "vector_entry_point": "servotrack.envs.servo.vector:UncalibServoVectorEnv",
    },
    "UncalibServoReach-v0": {
        "entry_point": "servotrack.envs.servo.env:UncalibServoReachEnv",
        "vector_entry_point": "servotrack.envs.servo.vector:UncalibServoReachVectorEnv",
    },
    "UncalibServoPixels-v0": {
        "entry_point": "servotrack.envs.servo.pixels:UncalibServoPixelsEnv",
        "vector_entry_point": "servotrack.envs.servo.pixels:UncalibServoPixelsVectorEnv",
    },
    "UncalibServo3D-v0": {
        "entry_point": "servotrack.envs.servo3d.env:UncalibServo3DEnv",
        "vector_entry_point": "servotrack.envs.servo3d.vector:UncalibServo3DVectorEnv",
    },
    "PedestrianServo-v0": {
        "entry_point": "servotrack.envs.follow.env:PedestrianServoEnv",
        "vector_entry_point": "servotrack.envs.follow.vector:PedestrianServoVectorEnv",
    },
    "ClutterTracking-v0": {
        "entry_point": "servotrack.envs.track.clutter.env:ClutterTrackingEnv",
        "vector_entry_point": "servotrack.envs.track.clutter.env:ClutterTrackingVectorEnv",
    },
    "RecordedPoints-v0": {
        "entry_point": "servotrack.envs.track.points.env:RecordedPointsEnv",
        "vector_entry_point": "servotrack.envs.track.points.env:RecordedPointsVectorEnv",
    },
    "PedestrianTracking-v0": {
        "entry_point": "servotrack.envs.track.pedestrians.env:PedestrianTrackingEnv",
        "vector_entry_point": "servotrack.envs.track.pedestrians.env:PedestrianTrackingVectorEnv",
    },
    "ColorTracking-v0": {
        "entry_point": "servotrack.envs.track.color.env:ColorTrackingEnv",
        "vector_entry_point": "servotrack.envs.track.color.env:ColorTrackingVectorEnv",
    },
    "SonarTracking-v0": {
        "entry_point": "servotrack.envs.track.sonar.env:SonarTrackingEnv",
        "vector_entry_point": "servotrack.envs.track.sonar.env:SonarTrackingVectorEnv",
    },
    "VideoTracking-v0": {
        "entry_point": "servotrack.envs.track.video.env:VideoTrackingEnv",
        "vector_entry_point": "servotrack.envs.track.video.env:VideoTrackingVectorEnv",
    },
}


def register_all() -> None:
    """Register every id of `ENVIRONMENTS` with Gymnasium. Entry points are strings, imported by `make` only.

    `max_episode_steps` is not registered: `make` would cut the longer episodes of other levels and keywords there. An
    environment sets it in its own `spec`, see `servotrack.envs.vector_env.spec_with_limit`.
    """
    for env_id, entry in ENVIRONMENTS.items():
        if env_id not in gym.registry:
            gym.register(id=env_id, **entry)
