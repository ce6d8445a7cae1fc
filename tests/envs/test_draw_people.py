"""Rendering of people: exact boxes and visibility, depth order, sub-pixel motion, walking bodies."""

import numpy as np
import pytest

from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.draw import MAX_PEOPLE_IN_FRAME, Stage
from servotrack.envs.track.pedestrians.outfits import SKIN, draw_outfit
from servotrack.envs.track.pedestrians.people import Drawn, People

QUIET = {"sensor_noise": 0.0, "camouflage": 0.0}
RIGHT, AWAY, TOWARDS = 0.0, np.pi / 2, -np.pi / 2


def people(feet, heading=RIGHT, phase=0.0, stride=0.0, height=80.0, outfits=None, ids=None) -> People:
    feet = np.array(feet, dtype=np.float64).reshape(-1, 2)
    count = len(feet)

    def each(value):
        return np.broadcast_to(np.asarray(value, dtype=np.float64), count).copy()

    return People(
        np.arange(1, count + 1) if ids is None else np.array(ids),
        feet,
        each(height),
        each(heading),
        each(phase),
        each(stride),
        np.arange(count) + 5 if outfits is None else np.array(outfits),
    )


def permuted(group: People, order: list[int]) -> People:
    return People(*(values[order] for values in group))


def extent_of(mask) -> list[float]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1]


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage(PedestrianConfig(**QUIET), 3)


def assert_same(a: Drawn, b: Drawn) -> None:
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_person_alone_is_wholly_visible_and_its_box_is_the_extent_of_its_pixels(stage):
    drawn = stage.draw(people([[200.3, 230.7], [90.0, 160.2]], heading=0.4, phase=1.0, stride=1.0), 0)
    np.testing.assert_array_equal(drawn.visibility, [1.0, 1.0])
    for row in range(2):
        assert drawn.boxes[row].tolist() == extent_of(drawn.owners == row + 1)


def test_the_box_of_a_standing_person_is_as_tall_as_its_height_and_ends_at_the_feet(stage):
    for height in (45.0, 70.0, 110.0):
        left, top, width, tall = stage.draw(people([[190.5, 250.0]], height=height), 0).boxes[0]
        assert abs(tall - height) < 0.06 * height + 1.0
        assert abs(top + tall - 250.0) < 0.05 * height
        assert 0.15 * height < width < 0.5 * height
        assert left < 190.5 < left + width


def test_closer_people_occlude_others_whose_boxes_stay_whole(stage):
    far, near = [200.0, 200.0], [206.0, 215.0]
    both = stage.draw(people([far, near]), 0)
    assert both.visibility[1] == 1.0
    assert 0.05 < both.visibility[0] < 0.8
    alone = stage.draw(people([far]), 0)
    np.testing.assert_array_equal(both.boxes[0], alone.boxes[0])
    hidden = (alone.owners == 1) & (both.owners != 1)
    assert (both.owners[hidden] == 2).all()
    assert both.visibility[0] == (both.owners == 1).sum() / (alone.owners == 1).sum()


def test_the_order_of_rows_changes_nothing_but_the_order_of_the_truth(stage):
    group = people([[200.0, 200.0], [206.0, 215.0], [195.0, 215.0], [120.0, 170.0]], phase=0.7, stride=1.0)
    order = [2, 0, 3, 1]
    drawn, other = stage.draw(group, 4), stage.draw(permuted(group, order), 4)
    np.testing.assert_array_equal(drawn.image, other.image)
    np.testing.assert_array_equal(drawn.boxes[order], other.boxes)
    np.testing.assert_array_equal(drawn.visibility[order], other.visibility)
    names = np.array([0, *(np.array(order) + 1)])
    np.testing.assert_array_equal(drawn.owners, names[other.owners])


def test_the_border_cuts_boxes_and_hides_what_lies_beyond(stage):
    drawn = stage.draw(people([[0.0, 220.0], [200.0, 330.0], [-200.0, 220.0], [200.0, 600.0]]), 0)
    assert drawn.boxes[0, 0] == 0.0
    assert 0.35 < drawn.visibility[0] < 0.65
    assert drawn.boxes[1, 1] + drawn.boxes[1, 3] == 288.0
    assert 0.2 < drawn.visibility[1] < 0.8
    np.testing.assert_array_equal(drawn.boxes[2:], np.zeros((2, 4)))
    np.testing.assert_array_equal(drawn.visibility[2:], [0.0, 0.0])


def test_no_people_leave_the_lobby_unchanged(stage):
    drawn = stage.draw(people(np.empty((0, 2))), 0)
    assert drawn.image.shape == (288, 384, 3)
    assert drawn.boxes.shape == (0, 4)
    assert not drawn.owners.any()
    crowd = stage.draw(people([[200.0, 220.0]]), 0)
    untouched = np.abs(crowd.image.astype(int) - drawn.image).max(axis=2) == 0
    assert untouched.mean() > 0.97


def test_frames_depend_on_the_seed_and_their_number_but_not_on_what_was_drawn_before():
    config = PedestrianConfig(
        flicker=2.0, plant=3.0, light_drift=8.0, light_step=20.0, shadow=0.4, compression=0.3, occluders=3
    )
    walked, fresh = Stage(config, 11), Stage(config, 11)
    for frame in range(6):
        walked.draw(people([[100.0 + 20 * frame, 200.0], [60.0, 150.0]], phase=frame), frame)
    group = people([[150.0, 220.0], [250.0, 170.0]], phase=0.3, stride=1.0, outfits=[77, 78])
    for frame in (150, 3, 150):
        assert_same(walked.draw(group, frame), fresh.draw(group, frame))
    assert (walked.draw(group, 3).image != walked.draw(group, 4).image).mean() > 0.5
    assert (walked.draw(group, 3).image != Stage(config, 12).draw(group, 3).image).mean() > 0.5


def test_what_is_returned_is_not_drawn_into_again(stage):
    group = people([[150.0, 220.0]])
    first = stage.draw(group, 0)
    kept = [np.copy(values) for values in first]
    stage.draw(people([[151.0, 221.0], [155.0, 200.0]]), 1)
    for before, after in zip(kept, first, strict=True):
        np.testing.assert_array_equal(before, after)


def test_bodies_move_by_fractions_of_a_pixel(stage):
    lobby = stage.draw(people(np.empty((0, 2))), 0).image.astype(np.float64)

    def centroid(feet):
        weight = np.abs(stage.draw(people([feet], outfits=[9]), 0).image - lobby).sum(axis=2)
        rows, columns = np.indices(weight.shape)
        return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()

    steps = np.arange(0.0, 2.01, 0.2)
    columns = np.array([centroid([200.0 + step, 240.0])[0] for step in steps])
    rows = np.array([centroid([200.0, 240.0 + step])[1] for step in steps])
    np.testing.assert_allclose(np.diff(columns), 0.2, atol=0.06)
    np.testing.assert_allclose(np.diff(rows), 0.2, atol=0.06)


def test_legs_swing_with_the_phase_and_stand_still_without_a_stride(stage):
    def width(phase, stride):
        return stage.draw(people([[200.0, 240.0]], phase=phase, stride=stride), 0).boxes[0, 2]

    assert width(np.pi / 2, 1.0) > 1.4 * width(0.0, 0.0)
    assert width(np.pi / 2, 1.0) > width(np.pi / 2, 0.4) > width(np.pi / 2, 0.0)
    assert_same(*(stage.draw(people([[200.0, 240.0]], phase=p, stride=0.0), 0) for p in (0.0, 2.0)))


def test_faces_are_seen_from_the_front_and_hair_from_behind(stage):
    outfit, seen = 2, []
    skin = draw_outfit(outfit, 0.0, np.zeros((1, 3)))[SKIN : SKIN + 3]
    for heading in (TOWARDS, AWAY):
        drawn = stage.draw(people([[200.0, 260.0]], heading=heading, height=110.0, outfits=[outfit]), 0)
        top = int(drawn.boxes[0, 1])
        head = drawn.image[top : top + 14][drawn.owners[top : top + 14] == 1]
        seen.append((np.abs(head - skin).max(axis=1) < 60).mean())
    assert seen[0] > seen[1] + 0.2


def test_walking_left_is_the_mirror_of_walking_right_in_extent(stage):
    right, left = (
        stage.draw(people([[192.0, 240.0]], heading=heading, phase=1.0, stride=1.0, outfits=[5]), 0).boxes[0]
        for heading in (RIGHT, np.pi)
    )
    assert right[0] - 192.0 == pytest.approx(192.0 - left[0] - left[2], abs=3.0)


def test_looks_change_the_picture_and_nothing_of_the_position(stage):
    images = [stage.draw(people([[200.0, 240.0]], outfits=[outfit]), 0).image for outfit in range(6)]
    for k in range(1, 6):
        assert (images[0] != images[k]).any()


def test_more_people_than_owners_can_name_are_refused(stage):
    crowd = people(np.full((MAX_PEOPLE_IN_FRAME + 1, 2), 200.0))
    with pytest.raises(ValueError, match="at most 255 in a frame, got 256"):
        stage.draw(crowd, 0)
