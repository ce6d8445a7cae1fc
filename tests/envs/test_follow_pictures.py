"""The camera over the crowd and its pictures: positions and times of drawn people, and determinism."""

import numpy as np
import pytest

from servotrack.envs.follow.config import follow_config
from servotrack.envs.follow.detections import DetectionSensor
from servotrack.envs.follow.imaging import PATCH_SIDE, PATCH_SIZE, CloseUp, CrowdCamera, target_patches
from servotrack.envs.follow.recorder import Recorder
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.backdrop import CAMERA_PANEL, ERROR_PANEL, FLOOR_PANEL
from servotrack.envs.track.pedestrians.outfits import BAG, NO_BAG, TOP_MATERIAL

SEEDS = range(100_000, 100_008)


def world_of(*seeds, level=2, **axes):
    """A world whose rows have just been reset."""
    world = FollowWorld(follow_config(level, **axes), len(seeds))
    world.reset(range(len(seeds)), seeds)
    return world


def picture(world, row=0, size=240):
    """A picture without noise."""
    return CloseUp(world, row, size).picture(int(world.captured[row]), world.history[row].copy())


def without_crowd(world, size=240):
    """The same picture of the empty floor."""
    away = world.people.copy()
    world.people[..., :2] += 1e3
    empty = picture(world, size=size)
    world.people[:] = away
    return empty


def moved(world, places):
    """Put all people at these places, at rest."""
    world.people[..., 2:] = 0.0
    world.people[..., :2] = places


def test_same_seed_same_pictures_in_any_row_and_other_seed_others():
    first, second = world_of(7, 8, 9, level=6), world_of(9, 7, level=6)
    pictures = []
    for world in (first, second):
        camera = CrowdCamera(world, 96, 3.0)
        camera.update()
        for _ in range(6):
            world.step(np.full((world.count, 2), 0.2))
            camera.update()
        pictures.append((camera.images, camera.frame_time, target_patches(world, range(world.count), 3.0)))
    for ours, theirs in zip(*pictures, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[1])
        np.testing.assert_array_equal(ours[2], theirs[0])
    assert (pictures[0][0][0] != pictures[0][0][1]).mean() > 0.5
    assert (pictures[0][2][0] != pictures[0][2][1]).mean() > 0.5


def test_a_picture_that_begins_late_shows_the_same_frame():
    world = world_of(5, level=4, dropout=0.0)
    early = CrowdCamera(world, 96, 3.0)
    early.update()
    for _ in range(5):
        world.step(np.array([[0.4, -0.3]]))
        early.update()
    late = CrowdCamera(world, 96, 3.0)
    late.update()
    np.testing.assert_array_equal(early.images, late.images)


@pytest.mark.parametrize("level", [0, 2, 3])
def test_people_are_drawn_where_the_detector_s_truth_says(level):
    size, found = 240, 0
    for seed in SEEDS:
        world = world_of(seed, level=level, shadows=0.0)
        # All but one walk elsewhere.
        world.people[:, :, 1:, :2] += 1e3
        sensor = DetectionSensor(world)
        sensor.update()
        seen, u, v, width, height = sensor.truth[0, 0, :5] * np.array([1.0, *(size / 480,) * 4])
        if not seen or not (0.15 * size < min(u, v) and max(u, v) < 0.85 * size):
            continue
        found += 1
        drawn = np.abs(picture(world, size=size).astype(int) - without_crowd(world, size)).max(axis=-1) > 6
        rows, columns = np.nonzero(drawn)
        # Arms and feet swing to and fro about the middle.
        np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], [u, v], atol=2.0)
        # A stride reaches beyond the shoulders' box, and a person does not fill it.
        assert 0.4 * width * height < drawn.sum() < 1.5 * width * height
    assert found >= 4


def test_a_patch_shows_the_person_s_colors():
    rows, columns = np.mgrid[:PATCH_SIZE, :PATCH_SIZE] - 0.5 * (PATCH_SIZE - 1)
    body = np.hypot(rows, columns) * PATCH_SIDE / PATCH_SIZE < 0.19
    shown, named = [], []
    for seed in range(100_000, 100_040):
        world = world_of(seed, level=2, people=1)
        outfits = world.episode(0).outfits
        if outfits.people[0, TOP_MATERIAL] == 0 and outfits.people[0, BAG] == NO_BAG:
            shown.append(target_patches(world, [0], 0.0)[0][body].mean(axis=0))
            named.append(outfits.colors[0])
    assert len(shown) >= 6
    # Shading and the shadow under the chin darken all alike.
    darker = np.vdot(shown, named) / np.vdot(named, named)
    assert 0.7 < darker < 0.9
    np.testing.assert_allclose(shown, darker * np.array(named), atol=40.0)
    assert np.corrcoef(np.ravel(shown), np.ravel(named))[0, 1] > 0.9
    # One's patch is not another's.
    a, b = target_patches(world_of(SEEDS[0], SEEDS[1]), [0, 1], 0.0)
    assert np.abs(a.astype(int) - b).mean() > 5.0


def test_a_patch_shows_the_person_and_not_what_hangs_over_them():
    world = world_of(100_001, level=4, people=2, umbrellas=1, lamps=0, latency=0)
    bare = target_patches(world, [0], 0.0)
    outfits = world.episode(0).outfits
    outfits.umbrella[:] = 2.0
    np.testing.assert_array_equal(target_patches(world, [0], 0.0), bare)


def test_what_hangs_over_people_hides_them():
    world = world_of(100_002, level=0, people=2, umbrellas=1, shadows=0.0)
    at = world.tool[0].copy()
    moved(world, np.array([at + 20.0, at]))
    alone = picture(world)
    moved(world, np.array([at + 0.05, at]))
    together = picture(world)
    assert np.abs(alone.astype(int) - together).sum() < 0.05 * np.abs(alone.astype(int) - without_crowd(world)).sum()


def test_a_lampshade_covers_who_is_under_it():
    world = world_of(100_003, level=0, people=1, lamps=1, shadows=0.0)
    lamp = world.episode(0).outfits.lamps[0]
    lamp[2] = 0.4
    moved(world, lamp[:2] + 1e3)
    empty = picture(world)
    moved(world, lamp[:2])
    under = picture(world)
    moved(world, lamp[:2] + np.array([0.0, lamp[2] + 0.6]))
    beside = picture(world)
    # The tips of the feet may be visible.
    shown = [(image != empty).any(axis=-1).sum() for image in (under, beside)]
    assert shown[0] < 0.1 * shown[1]


def test_shadows_darken_the_floor_only_near_people():
    lit, dark = (picture(world_of(100_004, level=0, shadows=shadows)).astype(int) for shadows in (0.0, 0.8))
    change = (lit - dark).sum(axis=-1)
    assert (change >= 0).all()
    assert 0.01 < (change > 20).mean() < 0.25


def test_a_lost_frame_repeats_the_old_image_with_its_stamp():
    world = world_of(6, level=3, dropout=0.5)
    camera = CrowdCamera(world, 64, 3.0)
    camera.update()
    repeats = 0
    for _ in range(40):
        image, stamp, frame = camera.images.copy(), camera.frame_time.copy(), world.captured.copy()
        world.step(np.array([[0.2, 0.1]]))
        camera.update()
        same = np.array_equal(image, camera.images)
        assert same == (stamp == camera.frame_time).all() == (frame == world.captured).all()
        repeats += same
    assert 8 <= repeats <= 32


def test_a_rolling_shutter_sees_each_row_at_its_own_instant():
    prompt, rolling = (world_of(100_004, level=0, rolling_shutter=shutter) for shutter in (0.0, 0.04))
    shifts = []
    for _ in range(8):
        for world in (prompt, rolling):
            world.step(np.array([[0.8, 0.0]]))
        differences = (picture(prompt).astype(int) - picture(rolling)) ** 2
        shifts.append(differences.reshape(240, -1).mean(axis=1))
    # The last row is read at the frame's own instant, the first one 40 ms before.
    by_row = np.mean(shifts, axis=0)
    assert by_row[-1] < 0.1 * by_row[:40].mean()
    assert by_row[:40].mean() > 20.0


@pytest.mark.parametrize("size", [64, 96, 128, 480])
def test_sizes_show_the_same_scene(size):
    world = world_of(100_005, level=3)
    fine = picture(world, size=480).astype(float)
    block = 480 // 32
    small = picture(world, size=size).astype(float)
    # Averages over the same parts of the view.
    coarse = fine.reshape(32, block, 32, block, 3).mean(axis=(1, 3))
    factor = size // 32
    ours = small.reshape(32, factor, 32, factor, 3).mean(axis=(1, 3))
    assert np.abs(coarse - ours).mean() < 3.0
    assert np.corrcoef(coarse.ravel(), ours.ravel())[0, 1] > 0.97


def test_pictures_for_people_show_what_they_are_given_and_disturb_nothing():
    world, twin = world_of(100_006, level=5), world_of(100_006, level=5)
    recorder, sensor = Recorder(world, 0, "level 5 timing"), DetectionSensor(world)
    recorder.record()
    for _ in range(25):
        for each in (world, twin):
            each.step(np.array([[0.3, -0.2]]))
        recorder.record()
        recorder.frame()
    np.testing.assert_array_equal(world.features, twin.features)
    np.testing.assert_array_equal(world.joints, twin.joints)
    sensor.update()
    plain, again = recorder.frame(), recorder.frame()
    assert plain.shape == (416, 720, 3)
    assert plain.dtype == np.uint8
    assert not np.shares_memory(plain, again)
    np.testing.assert_array_equal(plain, again)
    for given in (
        {"detections": sensor.detections[0]},
        {"belief": np.array([200.0, 300.0])},
        {"camera_image": np.full((96, 96, 3), 90, np.uint8)},
    ):
        changed = (recorder.frame(**given) != plain).any(axis=-1)
        assert CAMERA_PANEL.of(changed).any()
        assert not FLOOR_PANEL.of(changed).any()
        assert not ERROR_PANEL.of(changed).any()


def test_the_plot_of_distances_marks_wrong_and_lost_persons():
    world = world_of(100_007)
    recorder = Recorder(world)
    recorder.record()
    frames = []
    for wrong, lost in ((False, False), (True, False), (False, True)):
        world.step(np.zeros((1, 2)))
        world.identity_error[0], world.lost[0] = wrong, lost
        recorder.record()
        frames.append(ERROR_PANEL.of(recorder.frame()).astype(int))
    colors = [
        [np.abs(frame[-8:] - np.array(color)).max(axis=-1).min() for color in ((76, 112, 188), (226, 85, 52))]
        for frame in frames
    ]
    assert min(colors[0]) > 10
    assert colors[1][0] == 0
    assert colors[1][1] > 10
    assert max(colors[2]) == 0
