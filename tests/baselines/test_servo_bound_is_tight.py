"""Where targets move along ellipses, a causal controller that knows camera, arm and law comes close to the bound."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines.leaderboard.servo_bound import joints_above, steady_bounds
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.targets import PERIOD
from servotrack.estimators.camera import ground_points, image_jacobian, project_points

FIRST_FIT = 45
"""Frames before the first fit. The errors of the 3 s in which no fit is needed do not count."""


class Frames(NamedTuple):
    """Frames so far of E episodes: time (s), features (px), joint angles (rad), 1 where the target is seen."""

    time: Any
    features: Any
    joints: Any
    seen: Any


def ellipse(numbers: Any, time: Any) -> tuple[Any, Any]:
    """Positions (E, K, 2) on ellipses and their slopes (E, K, 2, 6) by all numbers but the last.

    The numbers are center x and y, amplitude along x and y, phase, rate, and the turn between x and y.
    """
    x, y, wide, high, phase, rate, turn = (numbers[:, k, None] for k in range(7))
    one, none, angle = np.ones_like(time), np.zeros_like(time), rate * time + phase
    along_x, along_y = -wide * np.sin(angle), -high * np.sin(angle + turn)
    places = np.stack([x + wide * np.cos(angle), y + high * np.cos(angle + turn)], -1)
    by_x = np.stack([one, none, np.cos(angle), none, along_x, along_x * time], -1)
    by_y = np.stack([none, one, none, np.cos(angle + turn), along_y, along_y * time], -1)
    return places, np.stack([by_x, by_y], -2)


def ground_places(world: Any, frames: Frames) -> Any:
    """Where the frames show the target on the ground, (E, K, 2) m."""
    bearing = np.cumsum(frames.joints, -1)
    tool = np.stack([(world.links[:, None] * turn(bearing)).sum(-1) for turn in (np.cos, np.sin)], -1)
    ahead, aside = np.moveaxis(ground_points(world.cameras[:, None], frames.features), -1, 0)
    mounted = np.exp(1j * bearing[..., 1]) * (world.cameras[:, 5, None] + 1j * world.cameras[:, 6, None])
    place = mounted * (ahead - 1j * aside)
    return tool + np.stack([place.real, place.imag], -1)


def first_numbers(places: Any, frames: Frames) -> Any:
    """Numbers of the best of many ellipses of fixed rate, (E, 7): a linear fit each."""
    best, least = np.zeros((len(places), 7)), np.full(len(places), np.inf)
    for episode, (seen, time) in enumerate(zip(frames.seen > 0, frames.time, strict=True)):
        for rate, turn in itertools.product(np.linspace(0.45, 1.55, 45), (math.pi / 2, -math.pi / 2)):
            basis = np.stack([np.ones_like(time), np.cos(rate * time), np.sin(rate * time)], -1)[seen]
            found = np.linalg.lstsq(basis, places[episode, seen], rcond=None)[0]
            error = float(np.square(places[episode, seen] - basis @ found).sum())
            phase = math.atan2(-found[2, 0], found[1, 0])
            high = found[1, 1] * math.cos(phase + turn) - found[2, 1] * math.sin(phase + turn)
            if high > 0.0 and error < least[episode]:
                wide, least[episode] = math.hypot(found[1, 0], found[2, 0]), error
                best[episode] = *found[0], wide, high, phase, rate, turn
    return best


def refined(numbers: Any, world: Any, frames: Frames) -> Any:
    """Numbers after a step of Gauss and Newton on all pixels so far."""
    places, slopes = ellipse(numbers, frames.time)
    cameras, links = world.cameras[:, None], world.links[:, None]
    shown = project_points(cameras, links, frames.joints, places)[0]
    east, north = (
        image_jacobian(cameras, links, frames.joints, places, np.array(way))[..., 2] for way in ([1.0, 0.0], [0.0, 1.0])
    )
    A = (np.stack([east, north], -1) @ slopes * frames.seen[..., None, None]).reshape(len(numbers), -1, 6)
    misses = ((frames.features - shown) * frames.seen[..., None]).reshape(len(numbers), -1, 1)
    turned = A.transpose(0, 2, 1)
    step = np.linalg.solve(turned @ A, turned @ misses)[..., 0]
    return numbers + np.pad(step, ((0, 0), (0, 1)))


def steady_errors(level: int, seeds: list[int]) -> Any:
    """Steady errors of the controller that fits the law to all frames so far, (E,) m."""
    env = gym.make_vec("UncalibServo-v0", num_envs=len(seeds), level=level)
    env.reset(seed=seeds)
    world, history, numbers, errors = env.unwrapped.world, [], None, []  # type: ignore[attr-defined]
    config, substep = world.config, PERIOD / world.config.substeps
    # The target rests during the warm-up.
    clock = np.maximum if config.warmup else lambda time, _: time
    for step in range(config.warmup + config.horizon):
        history.append(
            [x.copy() for x in (clock(world.frame_time, 0.0), world.features, world.joint_angles, world.visible)]
        )
        # Until the first fit, the true place keeps the target in view.
        goal = world.target[:, :2]
        if step + 1 >= FIRST_FIT:
            frames = Frames(*(np.stack(each, 1) for each in zip(*history, strict=True)))
            for _ in range(10 if numbers is None else 1):
                numbers = refined(
                    first_numbers(ground_places(world, frames), frames) if numbers is None else numbers, world, frames
                )
            goal = ellipse(numbers, clock(world.time + PERIOD, 0.0)[:, None])[0][:, 0]
        missing = joints_above(goal[:, None], world.links)[:, 0] - world.joints - substep * world._samples["rates"]
        env.step(np.clip(missing / (PERIOD - substep) / config.max_joint_rate, -1, 1).astype(np.float32))
        errors.append(world.tracking_error.copy())
    return np.array(errors)[config.warmup + 61 :].mean(axis=0)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_a_fit_of_the_law_comes_close_to_the_bound(level: int) -> None:
    seeds = list(range(100_000, 100_016))
    ratio = steady_errors(level, seeds).mean() / steady_bounds(servo_config(level), seeds).mean()
    assert 0.95 < ratio < 1.2
