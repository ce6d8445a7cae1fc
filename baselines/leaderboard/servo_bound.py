"""A bound on the servo's steady error: the column "x bound" divides by it, and the score is 1 there.

The controller of the bound knows camera, links, latency, gains, noise levels, which frames are outliers, when something
knocks the camera, how its lens zooms, and the law that its target is drawn from. Its filter has exactly that law, its
encoders are prompt, and its arm has neither a lag nor a limit of rate. What is left is what no causal controller can
know in time:

- the noise on the joint rates of the last period, of which the motors act on all but the first substep;
- the joints and the target, from noisy encoders and from frames that are noisy, late or lost. A target along waves has
  unknown centers, amplitudes, rates and phases. Their covariance follows the posterior Cramer-Rao recursion along the
  true path (Tichavsky, Muravchik and Nehorai 1998), from the Fisher information of a squared cosine over each range,
  which is smoother than the uniform law and so counts as more knowledge;
- the next turn of a waypoint target. The controller knows a turn as soon as a frame taken after it could have arrived,
  even if that frame was lost, and until then goes straight on, which is best while a turn is improbable.

All this is more than agents receive, so an agent's error is larger on average. Two steps are approximations: errors
are taken as Gaussian, and all frames show the target at its goal. An agent that looks at it from elsewhere, where the
lens magnifies more, is centimeters away from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from scipy.special import ive

from servotrack.baselines.evaluation.servo_scores import STEADY_AFTER
from servotrack.baselines.leaderboard.servo_targets import (
    WaypointKnowledge,
    turn_chances,
    wave_knowledge,
    waypoint_knowledge,
)
from servotrack.envs.servo.episode import Episode, draw_episode, sample_times
from servotrack.envs.servo.levels import ServoConfig, reach_config, servo_config
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD, PERIOD
from servotrack.envs.streams import Streams, episode_seed
from servotrack.estimators.camera import image_jacobian, zoomed_cameras
from servotrack.estimators.rfs.bounds import expected_distance
from servotrack.estimators.types import Array, Mask

_GROUP = 100
"""Number of episodes that are computed together."""
_EXACT = 1e-9
"""Standard deviation of an encoder without noise, rad."""
_CERTAIN_TURN = 0.3
"""Chance of a turn from which on a period with a turn counts as free of error: the controller may have waited."""
_FAR = 10.0
"""Distance beyond which expected errors are cut off, m."""
_STIFF_TORQUE = 60.0
"""Least motor torque with which the motors follow their rates exactly, N m."""


def steady_bounds(config: ServoConfig, seeds: Sequence[int]) -> Array:
    """Smallest expected mean error after 3 s of any causal controller, given the layout and path of each episode.

    Args:
        config: Parameters of the environment.
        seeds: Seeds of the episodes, as passed to the environment's `reset`.

    Returns:
        Shape (E,), m; 0 where nothing random is left.

    Raises:
        ValueError: A world without a bound, see `has_bound`.
    """
    if not has_bound(config):
        raise ValueError(
            "the bound needs Gaussian or quantized pixel noise, an episode of more than 3 s and motors of at least "
            f"{_STIFF_TORQUE:g} N m, got noise_kind={config.noise_kind!r}, horizon={config.horizon} and "
            f"max_motor_torque={config.max_motor_torque:g}"
        )
    return np.concatenate([_group_bounds(config, seeds[i : i + _GROUP]) for i in range(0, len(seeds), _GROUP)])


def has_bound(config: ServoConfig) -> bool:
    """Return True if the noise is Gaussian or rounded, the motors are stiff, and the episode has a steady part."""
    steady = config.horizon * PERIOD > STEADY_AFTER
    # Rounding takes knowledge away. The Fisher information of uniform noise is infinite, Laplace's is twice as large.
    return config.noise_kind in ("gaussian", "quantized") and steady and config.max_motor_torque >= _STIFF_TORQUE


def episode_bounds(env_kwargs: Mapping[str, Any], seeds: Sequence[int]) -> list[float] | None:
    """`steady_bounds` of episodes of `UncalibServo-v0` with these arguments, m; None if they have none.

    Args:
        env_kwargs: Arguments of the environment.
        seeds: Seeds of the episodes.
    """
    return _bounds_or_none(servo_config(env_kwargs.get("level", 3), **_axes(env_kwargs)), seeds)


def reach_bounds(env_kwargs: Mapping[str, Any], seeds: Sequence[int]) -> list[float] | None:
    """The same of episodes of `UncalibServoReach-v0`."""
    return _bounds_or_none(reach_config(env_kwargs.get("level", 3), **_axes(env_kwargs)), seeds)


def _axes(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in env_kwargs.items() if name not in ("level", "render_mode", "engine")}


def _bounds_or_none(config: ServoConfig, seeds: Sequence[int]) -> list[float] | None:
    return [float(bound) for bound in steady_bounds(config, seeds)] if has_bound(config) else None


def _group_bounds(config: ServoConfig, seeds: Sequence[int]) -> Array:
    """`steady_bounds` of episodes that are computed together."""
    # The episodes that `env.reset(seed=seed)` plays.
    drawn = [episode_seed(seeding.np_random(seed)[0]) for seed in seeds]
    episodes = [draw_episode(config, seed) for seed in drawn]
    times = sample_times(config)
    paths, links, cameras, goals, noise = (
        np.stack([getattr(episode, name) for episode in episodes])
        for name in ("path", "links", "camera", "goal", "noise_levels")
    )
    latency = np.array([episode.latency for episode in episodes])
    unseen = np.stack([_unseen(config, *pair, len(times)) for pair in zip(drawn, episodes, strict=True)])
    age, back = (latency + 1) * PERIOD, config.rolling_shutter * (1.0 - goals[:, 1] / config.camera_size)
    waypoints = config.target == "waypoints"
    knowledge = (
        waypoint_knowledge(paths, links, age, back) if waypoints else wave_knowledge(config, drawn, times, links)
    )
    joints = joints_above(paths, links)
    arm = arm_jacobians(joints, links)
    struck = np.array([episode.knocked_at for episode in episodes])[:, None] <= np.arange(len(times))
    knocked = np.stack([episode.knocked for episode in episodes])
    cameras = np.where(struck[..., None], knocked[:, None], cameras[:, None])
    if config.zoom:
        factors = np.stack([episode.focal_factor for episode in episodes])
        cameras = zoomed_cameras(cameras, np.broadcast_to(goals[:, None], (*factors.shape, 2)), factors)
    seen_joints, seen_place = _image_slopes(cameras, links, joints, paths)
    # A lag passes the rest of the noise on later, when it counts as known. Play in the gears may swallow it.
    passed = -math.expm1(-PERIOD / config.actuator_lag) if config.actuator_lag else 1.0
    acted = (passed * (PERIOD - PERIOD / config.substeps)) ** 2 * noise[:, 1] ** 2 * (config.backlash == 0.0)
    encoders = np.maximum(noise[:, 0], _EXACT) ** 2

    # The state: the joints at the newest samples, the last one first, and what is unknown of the target.
    blocks = int(config.latency[1]) + 2
    moved, count = 2 * blocks, len(seeds)
    P = np.zeros((count, moved + knowledge.prior.shape[1], moved + knowledge.prior.shape[1]))
    P[:, moved:, moved:] = knowledge.prior
    rows, wanted = np.arange(count), np.zeros((count, len(times), 2, 2))
    shown = np.zeros((count, 2, P.shape[1]))
    for now in range(LEAD, len(times) - 1):
        P = _updated(P, np.eye(2, P.shape[1])[None], encoders[:, None, None] * np.eye(2), np.ones(count, bool))
        frames = now - latency
        if config.pixel_noise > 0.0:
            # The joints while the target's row was read lie between two samples.
            late = (back / PERIOD)[:, None, None] * seen_joints[rows, frames]
            shown[:] = 0.0
            for block in range(blocks - 1):
                chosen = latency == block
                shown[chosen, :, 2 * block : 2 * block + 2] = (seen_joints[rows, frames] - late)[chosen]
                shown[chosen, :, 2 * block + 2 : 2 * block + 4] = late[chosen]
            shown[:, :, moved:] = seen_place[rows, frames] @ knowledge.seen(frames)
            P = _updated(P, shown, config.pixel_noise**2 * np.eye(2), ~unseen[rows, frames])
        ahead = np.concatenate([arm[:, now + 1], np.zeros((count, 2, moved - 2)), -knowledge.ahead(now + 1)], axis=-1)
        shaken = acted[:, None, None] * arm[:, now + 1] @ _turned(arm[:, now + 1])
        wanted[:, now + 1] = ahead @ P @ _turned(ahead) + shaken
        P = knowledge.advance(P, frames)
        # The copy of the last joints is the first of the older ones.
        older = np.r_[0:2, 0 : moved - 2, moved : P.shape[1]]
        P = P[:, older[:, None], older]
        P[:, :2, :2] += acted[:, None, None] * np.eye(2)
    steady = times > STEADY_AFTER + 1e-9
    if isinstance(knowledge, WaypointKnowledge):
        newest = np.arange(len(times)) - 1 - latency[:, None]
        start = np.take_along_axis(paths, np.maximum(newest, 0)[..., None], axis=1)
        straight = paths[..., :2] - start[..., :2] - age[:, None, None] * start[..., 2:]
        chance = np.take_along_axis(turn_chances(config, paths, links, knowledge), np.maximum(newest, 0), axis=1)
        return _errors_going_on(wanted[:, steady], straight[:, steady], chance[:, steady]).mean(axis=1)
    return np.asarray(expected_distance(wanted[:, steady], _FAR).mean(axis=1))


def _unseen(config: ServoConfig, seed: int, episode: Episode, count: int) -> Mask:
    """Mask of the frames that are lost or outliers, shape (count,)."""
    lost = episode.dropped.copy() if len(episode.dropped) else np.zeros(count, dtype=np.bool_)
    if config.outlier_rate > 0.0:
        lost |= Streams(seed)[Stream.OUTLIER].random((count, 1))[:, 0] < config.outlier_rate
    return lost


def joints_above(paths: Array, links: Array) -> Array:
    """Joint angles of an arm above targets, paths (E, K, >= 2) m and links (E, 2) m. Shape (E, K, 2), rad."""
    x, y = paths[..., 0], paths[..., 1]
    l1, l2 = links[:, :1], links[:, 1:]
    cosine = np.clip((x * x + y * y - l1 * l1 - l2 * l2) / (2.0 * l1 * l2), -1.0, 1.0)
    theta2 = np.arccos(cosine)
    return np.stack([np.arctan2(y, x) - np.arctan2(l2 * np.sin(theta2), l1 + l2 * cosine), theta2], axis=-1)


def arm_jacobians(joints: Array, links: Array) -> Array:
    """Slopes of the tool's position by joint angles (E, K, 2) rad of arms with links (E, 2) m. Shape (E, K, 2, 2)."""
    bearing = np.cumsum(joints, axis=-1)
    reach_x = np.cumsum((links[:, None] * np.cos(bearing))[..., ::-1], axis=-1)[..., ::-1]
    reach_y = np.cumsum((links[:, None] * np.sin(bearing))[..., ::-1], axis=-1)[..., ::-1]
    return np.stack([-reach_y, reach_x], axis=-2)


def _image_slopes(cameras: Array, links: Array, joints: Array, paths: Array) -> tuple[Array, Array]:
    """Slopes of the features of a target at its goal by joint angles, px/rad, and place, px/m. Shape (E, K, 2, 2)."""
    shape = paths.shape[:2]
    link = np.broadcast_to(links[:, None], (*shape, 2))
    east, north = (
        image_jacobian(cameras, link, joints, paths[..., :2], np.broadcast_to(along, (*shape, 2)))
        for along in ([1.0, 0.0], [0.0, 1.0])
    )
    return east[..., :2], np.stack([east[..., 2], north[..., 2]], axis=-1)


def _turned(matrices: NDArray[np.floating[Any]]) -> Array:
    return np.asarray(matrices.transpose(0, 2, 1), dtype=np.float64)


def _updated(P: Array, H: Array, R: Array, rows: Mask) -> Array:
    """Covariances (E, N, N) after measurements of some rows: slopes H (E or 1, 2, N), noise R (E or 1, 2, 2)."""
    PH = P @ _turned(H)
    gain = _turned(np.linalg.solve(H @ PH + R, _turned(PH))) * rows[:, None, None]
    P = P - gain @ _turned(PH)
    return np.asarray(0.5 * (P + _turned(P)))


def _errors_going_on(covariance: Array, missed: Array, chance: Array) -> Array:
    """Expected errors of a controller that goes straight on, less the most that another one could gain.

    Args:
        covariance: Covariance of the error without a turn. Shape (E, K, 2, 2), m^2.
        missed: Vector from where the target would be without a turn to where it is. Shape (E, K, 2), m.
        chance: Chance of a turn. Shape (E, K).

    Returns:
        Shape (E, K), m.
    """
    error = expected_distance(covariance, _FAR)
    turned = np.abs(missed).max(axis=-1) > 1e-9
    spread, along = np.linalg.eigh(covariance)
    root = along[turned] * np.sqrt(np.maximum(spread[turned], 0.0))[:, None, :]
    # Midpoints of the law of a Gaussian's radius, and of half a turn: the other half is the same with a minus.
    radius = np.sqrt(-2.0 * np.log1p(-(np.arange(24) + 0.5) / 24))
    angle = (np.arange(24) + 0.5) * 2.0 * math.pi / 24
    disc = np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()])
    error[turned] = np.linalg.norm(missed[turned][..., None] + root @ disc, axis=1).mean(axis=-1)
    error -= np.sqrt(spread[..., 1]) * np.interp(chance, _CHANCES, _most_gained())
    return np.where(chance > _CERTAIN_TURN, np.where(turned, 0.0, expected_distance(covariance, _FAR)), error)


_CHANCES = np.linspace(0.0, _CERTAIN_TURN, 31)


def _most_gained() -> Array:
    """Largest gain of waiting elsewhere, as a share of the standard deviation, for each of `_CHANCES`.

    With a turn of chance q an answer at the distance d gains at most d; without one it loses E|x - d| - E|x|, which for
    a unit Gaussian x is a Rice mean.
    """
    d = np.linspace(0.0, 3.0, 3001)
    x = 0.25 * d * d
    lost = math.sqrt(math.pi / 2.0) * ((1.0 + 2.0 * x) * ive(0, x) + 2.0 * x * ive(1, x) - 1.0)
    return np.asarray((_CHANCES[:, None] * d - (1.0 - _CHANCES[:, None]) * lost).max(axis=1))
