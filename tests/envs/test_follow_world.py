"""The crowd under the arm: motion, detections, and scores of following."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.envs.follow.config import follow_config
from servotrack.envs.follow.crowd import BODY_RADIUS
from servotrack.envs.follow.detections import DetectionSensor, capacity
from servotrack.envs.follow.episode import draw_follow_episode
from servotrack.envs.follow.world import FOLLOWED_DISTANCE, LOST_DISTANCE, LOST_SAMPLES, ON_TARGET_DISTANCE, FollowWorld
from servotrack.envs.servo.targets import LEAD, solvable
from servotrack.estimators.camera import project_points

SEEDS = range(40)


def made(level: int = 2, count: int = 1, first: int = 0, **axes: object) -> FollowWorld:
    world = FollowWorld(follow_config(level, **axes), count)
    world.reset(list(range(count)), list(range(first, first + count)))
    return world


def over_the_person(world: FollowWorld, row: int = 0) -> np.ndarray:
    """Joint rates, as actions, that bring the tool to the person within one period, by inverse kinematics."""
    links, (x, y) = world.links[row], world.people[row, world.now[row] + 1, 0, :2]
    theta2 = np.arccos(np.clip((x * x + y * y - links @ links) / (2.0 * links[0] * links[1]), -1.0, 1.0))
    theta1 = np.arctan2(y, x) - np.arctan2(links[1] * np.sin(theta2), links[0] + links[1] * np.cos(theta2))
    wanted = (np.array([theta1, theta2]) - world.joints[row]) / 0.05
    return np.clip(wanted / world.config.max_joint_rate, -1.0, 1.0)[None]


def test_the_arm_can_follow_the_person_and_people_do_not_overlap():
    for seed in SEEDS:
        episode = draw_follow_episode(follow_config(2), seed)
        path = episode.path
        assert solvable(path[LEAD:], *episode.links, 2.0)
        assert np.array_equal(path, episode.crowd.paths[:, 0])
        off = episode.crowd.paths[:, :, None, :2] - episode.crowd.paths[:, None, :, :2]
        apart = np.hypot(off[..., 0], off[..., 1])[:, ~np.eye(6, dtype=bool)]
        # A push at one spot may need another period to spread through a knot of people.
        assert np.percentile(apart, 0.5) > 1.8 * BODY_RADIUS


def test_people_walk_at_a_walkers_pace_and_positions_agree_with_velocities():
    speeds = []
    for seed in SEEDS:
        paths = draw_follow_episode(follow_config(0, pace=(0.5, 1.5)), seed).crowd.paths
        np.testing.assert_allclose(np.diff(paths[..., :2], axis=0), 0.05 * paths[:-1, :, 2:], atol=1e-12)
        speeds.append(np.hypot(paths[..., 2], paths[..., 3]))
    moving = np.concatenate([s.ravel() for s in speeds])
    assert 0.4 < moving.mean() < 1.2
    assert np.percentile(moving, 99) < 2.0


def test_the_crossing_script_has_more_encounters():
    def encounters(script: str) -> int:
        total = 0
        for seed in SEEDS:
            paths = draw_follow_episode(follow_config(2, script=script), seed).crowd.paths[..., :2]
            near = np.hypot(*(paths[:, 1:] - paths[:, :1]).transpose(2, 0, 1)) < 0.8
            total += int((near[1:] & ~near[:-1]).sum())
        return total

    assert encounters("crossings") > 1.25 * encounters("plaza")


def test_companions_stay_beside_the_person():
    def distance(companions: int) -> float:
        values = []
        for seed in range(15):
            paths = draw_follow_episode(follow_config(2, companions=companions), seed).crowd.paths[..., :2]
            values.append(np.hypot(*(paths[:, 1] - paths[:, 0]).T).mean())
        return float(np.mean(values))

    assert distance(1) < 1.3 < 1.6 < distance(0)


def test_look_alikes_wear_the_persons_clothes():
    outfits = draw_follow_episode(follow_config(0, look_alikes=1.0), 0).outfits
    assert (outfits.colors == outfits.colors[0]).all()
    assert (draw_follow_episode(follow_config(0), 0).outfits.colors[1:] != outfits.colors[0]).any(axis=1).all()


def test_without_noise_detections_are_the_truth_and_lie_where_people_are():
    world = made(level=0, count=8)
    sensor = DetectionSensor(world)
    for _ in range(5):
        world.step(np.full((8, 2), 0.1))
    sensor.update()
    for row in range(8):
        found = sensor.detections[row][sensor.detections[row, :, 0] > 0]
        truth = sensor.truth[row][sensor.truth[row, :, 0] > 0]
        assert len(found) == len(truth)
        np.testing.assert_allclose(found[np.argsort(found[:, 1])], truth[np.argsort(truth[:, 1])])
        place, seen = project_points(
            world.cameras[row], world.links[row], world.joints[row], world.people[row, world.now[row], 0, :2]
        )
        assert seen
        np.testing.assert_allclose(sensor.truth[row, 0, 1:3], place)
        # 80 px to the meter.
        np.testing.assert_allclose(sensor.truth[row, :, 3][sensor.truth[row, :, 0] > 0], 40.0, rtol=0.02)


def test_misses_clutter_and_noise_have_the_rates_that_the_arguments_say():
    world = made(level=0, count=60, misses=0.2, clutter=3.0, pixel_noise=4.0, people=1)
    sensor = DetectionSensor(world)
    found, false, errors = [], [], []
    for _ in range(40):
        world.step(np.concatenate([over_the_person(world, row) for row in range(60)]))
        sensor.update()
        off = sensor.detections[:, :, 1:3] - sensor.truth[:, :1, 1:3]
        mine = (sensor.detections[:, :, 0] > 0) & (np.abs(off) < 20.0).all(axis=2)
        seen = sensor.truth[:, 0, 0] > 0
        found.append(mine.any(axis=1)[seen].mean())
        false.append((sensor.detections[:, :, 0].sum(axis=1) - mine.any(axis=1)).mean())
        errors.append(off[mine])
    assert np.mean(found) == pytest.approx(0.8, abs=0.03)
    assert np.mean(false) == pytest.approx(3.0, abs=0.15)
    # The median, because false detections lie near the person, too.
    assert 1.4826 * np.median(np.abs(np.concatenate(errors))) == pytest.approx(4.0, abs=0.3)
    assert capacity(world.config) == sensor.detections.shape[1]


def test_people_closer_than_the_merge_distance_are_one_detection():
    apart = made(level=0, count=1, people=2)
    apart.people[0, :, 1, :2] = apart.people[0, :, 0, :2] + [0.3, 0.0]
    sensor = DetectionSensor(apart)
    sensor.update()
    assert sensor.detections[0, :, 0].sum() == 2
    merged = made(level=0, count=1, people=2, merge_distance=0.4)
    merged.people[0, :, 1, :2] = merged.people[0, :, 0, :2] + [0.3, 0.0]
    sensor = DetectionSensor(merged)
    sensor.update()
    (row,) = sensor.detections[0][sensor.detections[0, :, 0] > 0]
    np.testing.assert_allclose(row[1:3], sensor.truth[0, :, 1:3].mean(axis=0), atol=1.0)
    assert row[3:5].max() > 60.0


def test_who_is_under_a_lampshade_is_not_seen():
    world = made(level=0, count=1, lamps=8)
    assert world.hidden[0, :, 0].any()
    sensor = DetectionSensor(world)
    hidden = 0
    for _ in range(world.config.horizon - 1):
        world.step(over_the_person(world))
        sensor.update()
        if world.hidden[0, world.captured[0], 0]:
            hidden += 1
            assert world.visible[0] == 0.0
            assert sensor.truth[0, 0, 0] == 0.0
    assert hidden > 10


def test_an_umbrella_hides_whoever_comes_close_but_not_who_carries_it():
    hidden = np.mean([made(level=0, first=seed, umbrellas=1).hidden[0].mean(axis=0) for seed in SEEDS], axis=0)
    assert hidden[-1] == 0.0
    assert 0.002 < hidden[:-1].mean() < 0.1


def test_who_is_covered_at_the_reset_is_not_seen_either():
    covered = 0
    for seed in SEEDS:
        world = made(level=0, first=seed, lamps=20)
        at = world.captured[0]
        assert world.visible[0] == (not world.hidden[0, at, 0])
        covered += bool(world.hidden[0, at, 0])
    assert covered > 0


def test_latency_delivers_the_frames_of_the_past_with_their_stamps():
    world = made(level=0, count=1, latency=(2, 2))
    sensor = DetectionSensor(world)
    history = []
    for step in range(10):
        world.step(np.full((1, 2), 0.2))
        sensor.update()
        history.append(project_points(world.cameras[0], world.links[0], world.joints[0],
                                      world.people[0, world.now[0], 0, :2])[0])  # fmt: skip
        assert sensor.frame_time[0] == pytest.approx(world.time[0] - 0.1)
        if step >= 2:
            np.testing.assert_allclose(sensor.truth[0, 0, 1:3], history[step - 2])


def test_an_arm_that_stays_over_the_person_keeps_them():
    world = made(level=0)
    for _ in range(world.config.horizon):
        world.step(over_the_person(world))
    assert world.truncated[0]
    assert world.kept[0]
    assert world.time_on_target[0] > 0.9
    assert world.losses[0] == 0
    assert not world.identity_error[0]


def test_losing_following_another_and_finding_again_are_counted():
    world = made(level=0)
    start = world.tool[0].copy()
    aside = np.array([1.0, 0.0])
    for distance, away in ((LOST_DISTANCE + 0.5, True), (FOLLOWED_DISTANCE - 0.2, False)):
        world.people[0, :, 0, :2] = start + distance * aside
        world.people[0, :, 1, :2] = start + 0.2 * aside
        world.step(np.zeros((1, 2)))
        assert world.losses[0] == 1
        assert world.identity_error[0] == away
        assert world.lost[0] == away
    assert world.reacquisitions[0] == 1
    world.people[0, :, 0, :2] = start + 0.5 * ON_TARGET_DISTANCE * aside
    world.step(np.zeros((1, 2)))
    assert world.time_on_target[0] == pytest.approx(1.0 / 3.0)


def test_an_episode_ends_when_the_person_is_out_of_view_for_three_seconds():
    world = made(level=0)
    world.people[0, :, 0, :2] = world.paths[0, :, :2] = [40.0, 40.0]
    steps = 0
    while not world.terminated[0]:
        world.step(np.zeros((1, 2)))
        steps += 1
    assert steps == LOST_SAMPLES
    assert not world.kept[0]
    assert world.reward[0] == 0.0
