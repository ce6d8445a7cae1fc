"""Movement of people: schedules, statistics of real video, contacts, and replay of recorded tracks."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.pedestrians.config import LEVEL_NAMES, PedestrianConfig, pedestrian_config
from servotrack.envs.track.pedestrians.draw import Stage, occluder_places
from servotrack.envs.track.pedestrians.episode import draw_movement
from servotrack.envs.track.pedestrians.floor import lobby_camera
from servotrack.envs.track.pedestrians.paper_script import MERGE, NUMBERS, SPLIT
from servotrack.envs.track.pedestrians.replay import read_recording

FRAMES = 2500
"""Number of frames of the movements whose statistics are computed, longer than a visit."""


def lives(movement):
    """Return frames, feet (px) and heights (px) of all people while their feet are in the image."""
    column = movement.feet[..., 0]
    inside = (movement.ids > 0) & (column > 0) & (column < movement.width)
    for identity in range(1, movement.ids.max() + 1):
        frames, rows = np.nonzero((movement.ids == identity) & inside)
        if len(frames) > 1:
            yield frames, movement.feet[frames, rows], movement.height[frames, rows]


@pytest.fixture(scope="module")
def movements():
    return [draw_movement(pedestrian_config(0, horizon=FRAMES, empty_frames=0), seed) for seed in range(6)]


def test_people_move_as_on_real_video(movements):
    people = [life for movement in movements for life in lives(movement)]
    steps = [np.hypot(*np.diff(feet, axis=0).T) for _, feet, _ in people]
    in_heights = np.concatenate([way / height[1:] for way, (_, _, height) in zip(steps, people, strict=True)])
    way = np.concatenate(steps)
    stands = in_heights < 0.004
    assert 0.2 < stands.mean() < 0.42  # CAVIAR: 0.31
    assert 0.3 < np.median(way) < 0.9  # CAVIAR: 0.48 px
    assert 1.2 < np.quantile(way, 0.9) < 2.3  # CAVIAR: 1.9 px
    walking = np.quantile(in_heights[~stands], [0.1, 0.9])
    assert 0.006 < walking[0] < walking[1] < 0.05
    heights = np.concatenate([height for _, _, height in people])
    assert 40.0 < heights.min() < heights.max() < 130.0
    whole = [len(frames) for frames, _, _ in people if frames[0] > 0 and frames[-1] < FRAMES]
    assert 180 < np.median(whole) < 340  # CAVIAR: 253 frames


def test_as_many_people_as_asked_for():
    numbers = [
        (draw_movement(pedestrian_config(0, horizon=600, empty_frames=0), seed).ids > 0).sum(axis=1)
        for seed in range(16)
    ]
    assert np.mean(numbers) == pytest.approx(4.0, abs=1.2)
    assert abs(np.mean([n[:200].mean() for n in numbers]) - np.mean(numbers)) < 1.0  # warmed up
    crowd = draw_movement(pedestrian_config(2, horizon=FRAMES, empty_frames=0), 0).ids > 0
    assert crowd.sum(axis=1).mean() > 6.0
    assert draw_movement(pedestrian_config(0, people=0.0), 0).ids.max() == 0
    few = draw_movement(pedestrian_config(2, people=3.0, max_people=3, horizon=FRAMES, empty_frames=0), 0).ids > 0
    assert few.sum(axis=1).max() == 3


def test_some_stand_longer_than_a_background_takes_to_learn_them(movements):
    longest = 0
    for movement in movements:
        for _, feet, height in lives(movement):
            still = np.hypot(*np.diff(feet, axis=0).T) / height[1:] < 0.004
            edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
            longest = max(longest, *(edges[1::2] - edges[::2]).tolist(), 0)
    assert longest > 150


def test_bodies_do_not_overlap_and_steps_are_small():
    config = pedestrian_config(2, horizon=800)
    camera, movement = lobby_camera(384, 288), draw_movement(config, 3)
    there = movement.ids > 0
    place = camera.unproject(np.where(there[..., None], movement.feet, 200.0))
    for frame in range(0, 801, 20):
        at = place[frame, there[frame]]
        apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))[~np.eye(len(at), dtype=bool)]
        assert apart.min(initial=9.0) > 0.3
    same = there[1:] & (movement.ids[1:] == movement.ids[:-1])
    way = np.hypot(*(place[1:] - place[:-1])[same].T)
    assert way.max() < 2.6 / 25.0


def test_people_walk_around_occluders_and_come_on():
    config = pedestrian_config(2, occluders=5, horizon=1500)
    places = occluder_places(config, 1)
    movement = draw_movement(config, 1, obstacles=places)
    there = movement.ids > 0
    place = lobby_camera(384, 288).unproject(movement.feet[there])
    for x, z, radius in places:
        assert np.hypot(*(place - [x, z]).T).min() > radius
    free = draw_movement(config, 1)
    assert there.sum() < 1.5 * (free.ids > 0).sum()


def test_gait_follows_the_way(movements):
    movement = movements[0]
    for identity in range(1, 8):
        frames, rows = np.nonzero(movement.ids == identity)
        way = np.hypot(*np.diff(movement.feet[frames, rows], axis=0).T) / movement.height[frames, rows][1:]
        turned = np.diff(np.unwrap(movement.phase[frames, rows]))
        assert (turned >= -1e-9).all()
        still = way < 1e-5
        assert turned[still].max(initial=0.0) < 0.05
        assert turned.max() < 1.2
        stride = movement.stride[frames, rows]
        assert 0.0 <= stride.min() <= stride.max() <= 1.0
        assert np.corrcoef(stride[1:], way)[0, 1] > 0.3


@pytest.mark.parametrize("seed", range(4))
def test_papers_sequence_keeps_its_schedule(seed):
    movement = draw_movement(pedestrian_config(script="meet_split_third_guy"), seed)
    expected = np.zeros(923, int)
    for frame, number in NUMBERS:
        expected[frame:] = number
    assert np.array_equal((movement.ids > 0).sum(axis=1), expected)


def test_two_people_of_the_paper_script_merge_and_split_and_all_are_visible():
    config = pedestrian_config(script="meet_split_third_guy")
    for seed in range(2):
        movement, stage = draw_movement(config, seed), Stage(config, seed)
        together = []
        for frame in [*range(49, 430, 40), *range(430, 500), *range(515, 922, 40), 169, 319, 699, 749, 754, 898]:
            people, _ = movement.people(frame)
            drawn = stage.draw(people, frame)
            assert drawn.visibility.min() >= 0.2
            if 430 <= frame < 500:
                two = drawn.boxes[people.ids <= 2]
                if two[:, 0].max() < (two[:, 0] + two[:, 2]).min():
                    together.append(frame)
        assert MERGE - 6 <= together[0] <= MERGE + 6
        assert SPLIT - 6 <= together[-1] <= SPLIT + 8
        assert len(together) == together[-1] - together[0] + 1


def test_first_frames_are_empty_and_then_the_lobby_is_as_populated_as_it_will_be():
    for asked, empty in (({}, 25), ({"empty_frames": 60}, 60), ({"empty_frames": 0}, 0)):
        movements = [draw_movement(pedestrian_config(1, **asked), seed) for seed in range(8)]
        assert not any((movement.ids[:empty] > 0).any() for movement in movements)
        assert np.mean([(movement.ids[empty] > 0).sum() for movement in movements]) > 2.5


def test_movement_depends_on_the_seed_alone():
    first, again, other = (draw_movement(pedestrian_config(2, horizon=60), seed) for seed in (5, 5, 6))
    louder = draw_movement(pedestrian_config(2, horizon=60, shadow=0.5, sensor_noise=0.0), 5)
    longer = draw_movement(pedestrian_config(2, horizon=90), 5)
    assert np.array_equal(first.feet, again.feet)
    assert np.array_equal(first.feet, louder.feet)
    assert np.array_equal(first.feet, longer.feet[:61])
    assert not np.array_equal(first.feet, other.feet)


def rows_of_a_walk(frames, identity, left):
    return "".join(f"{k + 1},{identity},{left + 2 * k},{100 + 0.5 * k},30,80,1,1,1\n" for k in frames)


def test_replay_follows_the_recording(tmp_path):
    file = tmp_path / "gt.txt"
    file.write_text(rows_of_a_walk(range(40), 7, 50.0) + rows_of_a_walk([*range(10, 20), *range(25, 30)], 3, 120.0))
    config = pedestrian_config(script="replay", source=str(file), horizon=60)
    movement = draw_movement(config, 0, read_recording(config))
    numbers = (movement.ids > 0).sum(axis=1)
    assert numbers[:10].tolist() == [1] * 10
    assert numbers[10:30].tolist() == [2] * 20  # a gap of five frames is walked
    assert not numbers[40:].any()
    people, _ = movement.people(5)
    assert people.feet[0] == pytest.approx([50 + 10 + 15, 102.5 + 80], abs=1e-6)
    assert people.height[0] == pytest.approx(80.0)
    assert np.cos(people.heading[0]) > 0.3
    assert people.stride[0] > 0.3


def test_replay_scales_a_sequence_to_the_frame(tmp_path):
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "gt.txt").write_text(rows_of_a_walk(range(20), 1, 500.0))
    axes = {"script": "replay", "horizon": 20}
    bare = pedestrian_config(source=str(tmp_path), **axes)
    with pytest.raises(SequenceError, match="beyond the frame of 384 x 288 px"):
        read_recording(bare)
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nname=a\nimWidth=768\nimHeight=576\n")
    movement = draw_movement(bare, 0, read_recording(bare))
    assert movement.people(0)[0].height[0] == pytest.approx(40.0)
    crowded = pedestrian_config(source=str(tmp_path), max_people=1, **axes)
    (tmp_path / "gt" / "gt.txt").write_text(rows_of_a_walk(range(9), 1, 50.0) + rows_of_a_walk(range(9), 2, 90.0))
    with pytest.raises(ValueError, match="max_people must be at least 2"):
        draw_movement(crowded, 0, read_recording(crowded))


@pytest.mark.parametrize(
    ("keywords", "match"),
    [
        ({"level": 6}, "level must be a whole number from 0 to 5"),
        ({"level": True}, "level must be a whole number"),
        ({"script": "dance"}, "script must be one of random, crossing"),
        ({"observation": "sound"}, "observation must be one of pixels, blobs, centroids"),
        ({"shadow": 1.5}, r"shadow must lie in \[0, 1\], got 1.5"),
        ({"sensor_noise": float("nan")}, "sensor_noise must lie in"),
        ({"horizon": 2.5}, "horizon must be a whole number"),
        ({"people": 20.0}, "people must be at most max_people = 12"),
        ({"script": "meet_split_third_guy", "empty_frames": 80}, "empty_frames must be at most 49"),
        ({"script": "meet_split_third_guy", "frame_rate": 30.0}, "frame_rate must be 25"),
        ({"script": "meet_split_third_guy", "max_people": 2}, "max_people must be at least 3"),
        ({"script": "replay"}, "source, a file of recorded tracks"),
        ({"source": "gt.txt"}, "source, a file of recorded tracks"),
    ],
)
def test_bad_arguments_are_named(keywords, match):
    with pytest.raises(ValueError, match=match):
        pedestrian_config(**keywords)


def test_unknown_keyword_suggests_the_nearest():
    with pytest.raises(TypeError, match="did you mean 'camouflage'"):
        pedestrian_config(0, camoflage=0.3)


def test_levels_are_what_their_names_say():
    plain, crossing, crowd, camouflage, light, everything = (pedestrian_config(k) for k in range(len(LEVEL_NAMES)))
    assert plain == PedestrianConfig()
    assert (crossing.script, crowd.script) == ("crossing", "crowd")
    assert camouflage.camouflage > 2 * plain.camouflage
    assert min(light.shadow, light.flicker, light.light_drift, light.light_step) > 0.0
    assert min(everything.plant, everything.compression, everything.occluders, everything.shadow) > 0
    assert pedestrian_config(2, people=4.0).people == 4.0
