"""Arrays of the serial-arm world that the compiled kernels share: settings, draws, state and newest sample."""

from __future__ import annotations

import math
from typing import NamedTuple

from servotrack.estimators.types import Array, Labels, Mask

DISTANCE_BOUND = 2e-3
"""Tip error below which the tool counts as on the goal, m."""
ANGLE_BOUND = math.radians(1.0)
"""Angle below which the tool counts as on the goal, rad."""
LOST_SAMPLES = 40
"""Number of consecutive samples with the whole board out of the image that end an episode."""
LARGEST_ERROR = 500.0
"""Error, in units of the bounds, from which the reward is 0."""
RING = 8
"""Length of the histories, samples: more than the largest latency. A power of 2, so that a row's place is a mask."""


class WorldSettings(NamedTuple):
    """Parameters of the world for the compiled kernels; see `Servo3DConfig`.

    Attributes:
        in_hand: True if the camera is on the tool.
        moving: True if the goal moves.
        horizon: Length of an episode, steps.
        max_rate: Limit of each joint rate, rad/s.
        max_acceleration: Limit of each joint's acceleration, rad/s^2.
        backlash: Play of each joint, rad.
        compliance: Deflection of each joint per torque of gravity, rad/(N m).
        encoder_steps: Steps of the encoders in a full turn; 0 for exact ones.
        stamped: True if frames and joint angles carry the time of their origin.
    """

    in_hand: bool
    moving: bool
    horizon: int
    max_rate: float
    max_acceleration: float
    backlash: float
    compliance: float
    encoder_steps: int
    stamped: bool


class EpisodeTables(NamedTuple):
    """Draws of all rows for the compiled kernels; see `Episode`.

    Arrays have a leading axis of N, also tables over time, so that a reset writes them in order: `feature_noise`
    (N, K, 2p), `dropped` (N, K), `hidden` (N, K, p).
    """

    optics: Array
    mount: Array
    board: Array
    marks: Array
    motion: Array
    feature_noise: Array
    dropped: Mask
    hidden: Mask
    homing: Array
    lag: Array
    latency: Labels
    encoder_age: Labels


class ArmState(NamedTuple):
    """State of all arms.

    Attributes:
        motors: Motor angles. Shape (N, n), rad.
        rates: Motor rates. Shape (N, n), rad/s.
        commands: Joint rates that the motors were last commanded. Shape (N, n), rad/s.
        joints: Joint angles of the links: behind backlash and sag. Shape (N, n), rad.
        geared: Joint angles behind the backlash, without sag. Shape (N, n), rad.
        motor_history: Motor angles of the last samples, a ring. Shape (RING, N, n), rad.
        at_limit: True where a motor is at its limit. Shape (N, n).
        tool: Pose of the tool. Shape (N, 3, 4), m.
        goal_joints: Joint angles of the goal. Shape (N, n), rad.
        goal_tool: Pose of the tool at the goal. Shape (N, 3, 4), m.
        placed: Points of the board in the tool's frame, with the camera in the hand at the goal. Shape (N, p, 3), m.
        target: These points in the base frame, with the camera in the hand. Shape (N, p, 3), m.
        depth: Mean distance of the board's points along the optical axis. Shape (N,), m.
        images: Images of the points in the last samples, a ring. Shape (RING, N, 2p), px.
        in_image: True for points inside the image, a ring. Shape (RING, N, p).
    """

    motors: Array
    rates: Array
    commands: Array
    joints: Array
    geared: Array
    motor_history: Array
    at_limit: Mask
    tool: Array
    goal_joints: Array
    goal_tool: Array
    placed: Array
    target: Array
    depth: Array
    images: Array
    in_image: Mask


class Sample(NamedTuple):
    """Newest sample of all rows: truth, score and sensor readings. Arrays have a leading axis of N.

    Attributes:
        time: Time in the episode. Shape (N,), s.
        tip_error: Distance of the tool from the goal; of a single point, its distance from the goal's line of sight.
            Shape (N,), m.
        tip_angle: Angle between the tool and the goal; 0 for a single point. Shape (N,), rad.
        error: Both in units of their bounds, the root of their squares' sum. Shape (N,).
        feature_error: Mean distance of the true image points from the goal. Shape (N,), px.
        out_of_view: Consecutive samples without any point in the image. Shape (N,).
        reward: Rewards. Shape (N,).
        terminated: True where the board was out of view for too long. Shape (N,).
        truncated: True where the horizon is reached. Shape (N,).
        joint_angles: Encoder readings. Shape (N, n), rad.
        joint_time: Time stamps of the encoder readings. Shape (N,), s.
        features: Newest delivered image points. Shape (N, 2p), px.
        visible: 1 for points in a frame that arrived in this sample, else 0. Shape (N, p).
        goal: Image points of the goal. Shape (N, 2p), px.
        frame_time: Time stamp of the newest frame. Shape (N,), s.
    """

    time: Array
    tip_error: Array
    tip_angle: Array
    error: Array
    feature_error: Array
    out_of_view: Labels
    reward: Array
    terminated: Mask
    truncated: Mask
    joint_angles: Array
    joint_time: Array
    features: Array
    visible: Array
    goal: Array
    frame_time: Array
