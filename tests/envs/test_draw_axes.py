"""Difficulties of the picture: each changes only its own effect; statistics agree with real video."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.draw import Stage, occluder_places
from servotrack.envs.track.pedestrians.floor import BACK_WALL, lobby_camera
from servotrack.envs.track.pedestrians.paving import paint_floor
from servotrack.envs.track.pedestrians.people import People

SEED = 5
NOBODY = People(np.zeros(0, np.int64), np.zeros((0, 2)), *(np.zeros(0) for _ in range(4)), np.zeros(0, np.int64))


def crowd(count: int, seed: int) -> People:
    rng = np.random.default_rng(seed)
    camera = lobby_camera(384, 288)
    z = rng.uniform(6.5, 14.5, count)
    x = rng.uniform(-0.9, 0.9, count) * camera.half_width(z)
    return People(
        np.arange(1, count + 1),
        camera.project(np.stack([x, z], axis=1)),
        camera.scale(z) * 1.75,
        rng.uniform(0.0, 2.0 * np.pi, count),
        rng.uniform(0.0, 2.0 * np.pi, count),
        rng.uniform(0.0, 1.0, count),
        rng.integers(0, 10**6, count),
    )


def stage(seed: int = SEED, **axes) -> Stage:
    return Stage(PedestrianConfig(**{"sensor_noise": 0.0, **axes}), seed)


def image(frame: int = 7, people: People = NOBODY, **axes) -> np.ndarray:
    return stage(**axes).draw(people, frame).image.astype(np.int64)


def test_without_axes_every_frame_is_the_same():
    plain = stage()
    group = crowd(4, 1)
    first = plain.draw(group, 0)
    for frame in (1, 100, 299, 5000):
        np.testing.assert_array_equal(plain.draw(group, frame).image, first.image)


def test_noise_has_its_deviation_and_is_new_in_every_frame():
    noisy = Stage(PedestrianConfig(sensor_noise=5.0), SEED)
    lobby = image()
    frames = [noisy.draw(NOBODY, frame).image - lobby for frame in range(8)]
    for residual in frames:
        assert residual.std() == pytest.approx(5.0, abs=0.15)
        assert abs(residual.mean()) < 0.1
    for a, b in pairwise(frames):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.01


def test_the_residual_is_as_on_real_video():
    # 4 to 8 gray levels at the default noise, people and all, outside of their silhouettes.
    seen, lobby = Stage(PedestrianConfig(), SEED), image()
    for frame in range(4):
        drawn = seen.draw(crowd(5, frame), frame)
        residual = (drawn.image - lobby)[drawn.owners == 0]
        assert 4.0 < residual.std() < 8.0


def test_the_contrast_of_people_is_as_on_real_video():
    contrasts = []
    for seed in range(6):
        lobby = image(seed=seed, camouflage=0.0)
        drawn = stage(seed=seed, camouflage=0.0).draw(crowd(6, seed), 0)
        contrasts.append(np.abs(drawn.image - lobby).max(axis=2)[drawn.owners > 0])
    assert 85.0 < np.concatenate(contrasts).mean() < 123.0


def test_camouflage_lowers_the_contrast_and_touches_nothing_else():
    lobby, group = image(), crowd(8, 2)
    contrast = []
    silhouettes = []
    for share in (0.0, 0.5, 1.0):
        drawn = stage(camouflage=share).draw(group, 0)
        contrast.append(np.abs(drawn.image - lobby).max(axis=2)[drawn.owners > 0].mean())
        silhouettes.append(drawn.owners)
    assert contrast[0] > contrast[1] + 5.0 > contrast[2] + 10.0
    assert contrast[2] > 15.0
    np.testing.assert_array_equal(silhouettes[0], silhouettes[2])


def test_flicker_moves_the_whole_frame_by_its_deviation():
    flickering, lobby = stage(flicker=3.0), image()
    levels, plain = [], (lobby > 20).all(axis=2) & (lobby < 235).all(axis=2)
    for frame in range(0, 2000, 10):
        change = (flickering.draw(NOBODY, frame).image - lobby)[plain]
        assert change.min() == change.max()
        levels.append(change[0, 0])
    assert np.std(levels) == pytest.approx(3.0, abs=0.45)
    assert abs(np.mean(levels)) < 0.6


def test_drift_is_slow_and_within_its_amplitude():
    drifting, lobby = stage(light_drift=12.0), image()
    levels = [(drifting.draw(NOBODY, frame).image - lobby)[100, 100, 0] for frame in range(0, 600)]
    assert np.abs(np.diff(levels)).max() <= 1
    assert 8 <= max(np.abs(levels)) <= 12


@pytest.mark.parametrize("step", [25.0, -25.0])
def test_the_step_comes_once_in_the_middle_third(step):
    for seed in range(2):
        stepping, lobby = stage(seed=seed, light_step=step), image(seed=seed)
        levels = [(stepping.draw(NOBODY, frame).image - lobby)[150, 150, 1] for frame in range(300)]
        change = np.flatnonzero(np.diff(levels)) + 1
        assert len(change) == 1
        assert 100 <= change[0] < 200
        assert levels[0] == 0
        assert levels[-1] == step


def test_shadows_darken_the_floor_beside_people_and_occlude_no_person():
    group = crowd(4, 3)
    plain, shaded = stage().draw(group, 0), stage(shadow=0.5).draw(group, 0)
    change = shaded.image.astype(int) - plain.image
    floor = plain.owners == 0
    assert (change[floor] <= 0).all()
    assert 0.002 < (change[floor] < -20).any(axis=-1).mean() < 0.2
    np.testing.assert_array_equal(shaded.owners, plain.owners)
    deeper = stage(shadow=0.9).draw(group, 0).image.astype(int) - plain.image
    assert deeper[floor].sum() < 1.5 * change[floor].sum()


def test_leaves_sway_by_so_much_and_everything_else_rests():
    lobby = image()
    moved = []
    for sway in (1.0, 4.0):
        swaying = stage(plant=sway)
        frames = np.stack([swaying.draw(NOBODY, frame).image for frame in range(0, 60, 6)])
        touched = (frames != lobby).any(axis=(0, 3))
        # The two plants stand at the foot of the wall, left and right.
        assert not touched[150:].any()
        assert not touched[:, 130:250].any()
        assert touched.any()
        moved.append(np.abs(frames - lobby).sum())
    assert moved[1] > 1.5 * moved[0]


def test_occluders_hide_people_behind_them_and_none_in_front():
    hidden = 0
    for seed in range(4):
        group = crowd(10, seed)
        plain, occluded = stage(seed=seed).draw(group, 0), stage(seed=seed, occluders=4).draw(group, 0)
        np.testing.assert_array_equal(plain.boxes, occluded.boxes)
        assert (occluded.visibility <= plain.visibility + 1e-12).any()
        hidden += int((occluded.visibility < plain.visibility - 0.02).sum())
        gone = (plain.owners > 0) & (occluded.owners == 0)
        assert ((occluded.owners == plain.owners) | (occluded.owners == 0) | gone).all()
        nearest = group.feet[:, 1] > max(
            lobby_camera(384, 288).project(np.array([x, z]))[1] for x, z, _ in occluder_places(config(4), seed)
        )
        np.testing.assert_array_equal(occluded.visibility[nearest], plain.visibility[nearest])
    assert hidden >= 3


def config(occluders: int) -> PedestrianConfig:
    return PedestrianConfig(occluders=occluders)


def test_occluders_stand_where_they_say():
    camera = lobby_camera(384, 288)
    for seed in range(3):
        changed = (image(seed=seed, occluders=3) != image(seed=seed)).any(axis=2)
        places = occluder_places(config(3), seed)
        assert len(places) == 3
        for x, z, radius in places:
            column, row = camera.project(np.array([x, z]))
            assert changed[int(row) - 4, int(column)]
            assert 0.05 < radius < 0.6
    assert occluder_places(config(0), 1) == ()


def test_compression_does_more_harm_the_stronger_it_is():
    group = crowd(5, 4)
    plain = stage().draw(group, 0)
    harm = []
    for strength in (0.1, 0.5, 1.0):
        coded = stage(compression=strength).draw(group, 0)
        np.testing.assert_array_equal(coded.owners, plain.owners)
        harm.append(np.abs(coded.image.astype(int) - plain.image).mean())
    assert 0.1 < harm[0] < harm[1] < harm[2] < 12.0


def test_an_axis_shifts_no_other_random_number():
    group = crowd(3, 6)
    base = Stage(PedestrianConfig(), SEED).draw(group, 9)
    for axes in ({"plant": 2.0}, {"occluders": 2}, {"shadow": 0.3}):
        other = Stage(PedestrianConfig(**axes), SEED).draw(group, 9)
        same = (other.image == base.image).all(axis=2)
        # Beside the plants, behind the occluders and outside of the shadows every pixel has the same noise and floor.
        assert same.mean() > 0.6
        assert same[:20, :8].all()
    flickering = Stage(PedestrianConfig(flicker=2.0), SEED).draw(group, 9)
    change = flickering.image.astype(int) - base.image
    assert np.unique(change[(base.image > 20) & (base.image < 235)]).size == 1


def test_larger_frames_show_the_same_lobby():
    small = Stage(PedestrianConfig(sensor_noise=0.0), SEED).draw(NOBODY, 0).image
    large = Stage(PedestrianConfig(sensor_noise=0.0, width=768, height=576), SEED).draw(NOBODY, 0).image
    assert large.shape == (576, 768, 3)
    shrunk = large.reshape(288, 2, 384, 2, 3).mean(axis=(1, 3))
    assert np.abs(shrunk - small).mean() < 6.0


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
def test_the_row_of_the_walls_foot_is_no_darker_than_its_neighbors(part):
    camera = lobby_camera(64, 64)
    foot = 30.0 + part
    wall, image = np.full((40, 64, 3), 150.0, np.float32), np.full((64, 64, 3), 150.0, np.float32)
    moved = replace(camera, horizon=foot - camera.focal * camera.elevation / BACK_WALL)
    paint_floor(image, wall, (150, 150, 150), moved, foot, np.random.default_rng(0))
    rows = image.mean(axis=(1, 2))
    assert rows[30] > 0.85 * min(rows[29], rows[31])
