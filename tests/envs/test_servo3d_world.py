"""The serial-arm world: motors, sensors, layouts and occlusions do as documented."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.envs.servo3d.arms import ARMS
from servotrack.envs.servo3d.draws import draw_offsets, start_streams
from servotrack.envs.servo3d.episode import (
    LEAD,
    LEAST_ERROR,
    PERIOD,
    STOP_MARGIN,
    Stream,
    draw_episode,
    layout_parts,
)
from servotrack.envs.servo3d.kinematics import largest_torque
from servotrack.envs.servo3d.layout import SHORTFALL
from servotrack.envs.servo3d.levels import servo3d_config
from servotrack.envs.servo3d.world import Servo3DWorld
from servotrack.envs.streams import Streams
from servotrack.estimators.elementary import power

TUNE = range(100_000, 100_020)


def made(level: int = 0, count: int = 1, **axes: object) -> Servo3DWorld:
    world = Servo3DWorld(servo3d_config(level, **axes), count)
    world.reset(range(count), range(count))
    return world


def test_limits_of_angle_rate_and_acceleration_hold_under_rough_commands():
    world = made(6, 8, arm="panda", max_joint_rate=2.0)
    rng, arm = np.random.default_rng(0), world.arm
    motors, rates = world.state.motors.copy(), world.state.rates.copy()
    touched = False
    for step in range(200):
        world.step(rng.choice((-3.0, 3.0), (8, 7)) if step % 40 < 10 else np.full((8, 7), 3.0))
        assert (world.state.motors >= arm.low).all()
        assert (world.state.motors <= arm.high).all()
        assert np.abs(world.state.motors - motors).max() <= 2.0 * PERIOD + 1e-12
        # A stop takes all speed at once; between stops the motors' own lag is the only other influence.
        changes = np.where(world.state.at_limit, 0.0, world.state.rates - rates)
        assert np.abs(changes).max() <= 10.0 * PERIOD + 1e-12
        assert np.abs(world.state.commands).max() <= 2.0
        touched = touched or bool(world.state.at_limit.any())
        motors, rates = world.state.motors.copy(), world.state.rates.copy()
    assert touched


def test_commands_change_by_the_acceleration_limit_at_most():
    world = made(arm="ur5e", max_joint_acceleration=4.0)
    for sign in (1.0, 1.0, -1.0, -1.0, 1.0):
        before = world.state.commands.copy()
        world.step(np.full((1, 6), sign))
        assert np.abs(world.state.commands - before).max() <= 4.0 * PERIOD + 1e-15
    world = made(arm="ur5e")
    world.step(np.full((1, 6), 0.1))
    np.testing.assert_allclose(world.state.rates, 0.1)


def test_lag_is_that_of_a_fine_integration():
    world = made(actuator_lag=0.08)
    start, rate, angle = world.state.motors[0, 0], 0.0, world.state.motors[0, 0]
    parts = 20_000
    for command in (0.3, 0.3, -0.1, 0.2):
        world.step(np.full((1, 5), command))
        h = PERIOD / parts
        for _ in range(parts):
            # Midpoint rule of rate' = (command - rate) / lag.
            middle = rate + 0.5 * h * (command - rate) / 0.08
            angle += h * middle
            rate += h * (command - middle) / 0.08
    assert angle - start > 1e-3
    assert world.state.motors[0, 0] == pytest.approx(angle, abs=1e-10)
    assert world.state.rates[0, 0] == pytest.approx(rate, abs=1e-9)


def test_links_stay_behind_by_half_the_backlash_and_rest_inside():
    world = made(backlash=0.02)
    for _ in range(10):
        world.step(np.full((1, 5), 0.1))
    np.testing.assert_allclose(world.state.motors - world.state.joints, 0.01, atol=1e-15)
    turned = world.state.joints.copy()
    world.step(np.full((1, 5), -0.1))
    np.testing.assert_allclose(world.state.joints, turned)
    for _ in range(10):
        world.step(np.full((1, 5), -0.1))
    np.testing.assert_allclose(world.state.motors - world.state.joints, -0.01, atol=1e-15)


@pytest.mark.parametrize("name", ARMS)
def test_the_stretched_arm_sags_by_the_given_angle(name):
    arm = ARMS[name]
    world = made(arm=name, sag=0.02)
    # Torque about a horizontal second axis with the links stretched out is the scale; no posture exceeds it by much.
    deflections = []
    for angles in np.random.default_rng(0).uniform(arm.low, arm.high, (200, arm.joints)):
        world.state.motors[0] = world.state.geared[0] = angles
        world.step(np.zeros((1, arm.joints)))
        deflections.append(world.state.joints[0] - world.state.motors[0])
    largest = np.abs(deflections).max()
    assert 0.008 < largest <= 0.02 + 1e-12
    assert largest_torque(arm.tables()) > 0.1


def test_sensors_are_as_old_and_as_coarse_as_drawn():
    world = made(0, encoder_age=2, latency=1, homing=0.05, encoder_steps=4096, actuator_lag=0.1)
    motors, images, times = [], [], []
    for step in range(8):
        world.step(np.full((1, 5), 0.01 + 0.005 * step))
        motors.append(world.state.motors[0].copy())
        images.append(world.state.images[(world.steps[0] + LEAD) % 8, 0].copy())
        times.append(world.sample.time[0])
    width = 2 * np.pi / 4096
    error = world.sample.joint_angles[0] - world.tables.homing[0] - motors[-3]
    assert np.abs(error).max() <= width / 2 + 1e-12
    np.testing.assert_allclose(
        np.round(world.sample.joint_angles / width) * width, world.sample.joint_angles, atol=1e-12
    )
    assert world.sample.visible.all()
    assert np.array_equal(world.sample.features[0], images[-2])
    assert world.sample.joint_time[0] == pytest.approx(times[-3])
    assert world.sample.frame_time[0] == pytest.approx(times[-2])


def test_unstamped_sensors_carry_their_arrival():
    world = made(6, arm="so101", encoder_age=2, latency=2, dropout=0.0)
    world.step(np.zeros((1, 5)))
    assert world.sample.joint_time[0] == world.sample.frame_time[0] == world.sample.time[0] == PERIOD


def test_frames_before_the_reset_see_the_goal_where_it_was():
    """With the camera in the hand a moving goal carries the board, also before the reset."""
    late, now = made(0, motion=0.05, latency=2), made(0, motion=0.05)
    for _ in range(2):
        for world in (late, now):
            world.step(np.zeros((1, 5)))
    fresh = made(0, motion=0.05)
    np.testing.assert_allclose(late.sample.features, fresh.sample.features, atol=1e-9)
    assert np.abs(now.sample.features - fresh.sample.features).max() > 1e-3


def test_occlusions_leave_two_points():
    hidden = [draw_episode(servo3d_config(4, hiding=0.3), ARMS["so101"], seed).hidden for seed in range(10)]
    counts = 4 - np.concatenate(hidden).sum(axis=1)
    assert counts.min() == 2
    assert counts.max() == 4


@pytest.mark.parametrize("seed", [0, 7, 2**63 - 5])
def test_compiled_draws_are_those_of_numpy(seed):
    config, arm = servo3d_config(3, latency=(0, 2), turn=(0.2, 0.5)), ARMS["panda"]
    episode, streams = draw_episode(config, arm, seed), Streams(seed)
    offset = streams[Stream.OPTICS].uniform(-30.0, 30.0, 2)
    focal = streams[Stream.OPTICS].uniform(*config.focal)
    assert episode.optics.tolist() == [focal, 320.0 + offset[0], 240.0 + offset[1], 640.0, 480.0]
    assert episode.lag == streams[Stream.ACTUATOR].uniform(*config.actuator_lag)
    np.testing.assert_array_equal(episode.homing, streams[Stream.HOMING].uniform(-config.homing, config.homing, 7))
    assert episode.latency == streams[Stream.TIMING].integers(0, 3)
    assert episode.encoder_age == streams[Stream.ENCODER_TIMING].integers(0, 3)
    noise = config.pixel_noise * streams[Stream.PIXEL_NOISE].standard_normal(episode.feature_noise.shape)
    np.testing.assert_array_equal(episode.feature_noise, noise)

    offsets, rng = np.empty((64, 6)), streams[Stream.START]
    states = start_streams(np.uint64(seed), np.array([Stream.START]))
    draw_offsets(states[0], layout_parts(config, arm).ranges, offsets)
    np.testing.assert_array_equal(offsets[:, :2], rng.uniform(-config.shift, config.shift, (64, 2)))
    np.testing.assert_array_equal(offsets[:, 2:4], rng.uniform(-config.lean, config.lean, (64, 2)))
    np.testing.assert_array_equal(offsets[:, 4], rng.uniform(*config.turn, 64) * rng.choice((-1.0, 1.0), 64))
    np.testing.assert_array_equal(offsets[:, 5], power(rng.uniform(*config.zoom, 64), rng.choice((-1.0, 1.0), 64)))


@pytest.mark.parametrize("camera", ["hand", "world"])
@pytest.mark.parametrize("name", ARMS)
def test_layouts_are_within_limits_and_in_view_at_every_level(name, camera):
    arm = ARMS[name]
    for level in range(7):
        config = servo3d_config(level, arm=name, camera=camera, pixel_noise=0.0, hiding=0.0, dropout=0.0, sag=0.0)
        seeds = TUNE if level in (1, 4) else TUNE[:3]
        world = Servo3DWorld(config, len(seeds))
        world.reset(range(len(seeds)), seeds)
        least, most = config.in_view or (4, 4)
        assert (world.state.joints >= arm.low + STOP_MARGIN).all()
        assert (world.state.joints <= arm.high - STOP_MARGIN).all()
        swing = world.tables.motion[..., 1]
        assert (world.tables.motion[..., 0] - swing >= arm.low + STOP_MARGIN).all()
        assert (world.tables.motion[..., 0] + swing <= arm.high - STOP_MARGIN).all()
        in_view = world.state.in_image[LEAD].sum(axis=1)
        assert ((in_view >= least) & (in_view <= most)).all()
        goal = world.sample.goal.reshape(len(seeds), -1, 2)
        assert (goal > 0.0).all()
        assert (goal < (640.0, 480.0)).all()
        assert (world.sample.feature_error >= LEAST_ERROR).all()
        if level >= 5:
            # The tool's whole turn contains that about the optical axis.
            assert (world.sample.tip_angle >= config.turn[0] - SHORTFALL - 0.1).all()


def test_an_arm_without_masses_does_not_sag():
    fields = {name: getattr(ARMS["so101"], name) for name in ARMS["so101"].__dataclass_fields__}
    world = made(3, arm=fields | {"masses": np.zeros(5)}, backlash=0.0)
    assert np.array_equal(world.state.joints, world.state.motors)
