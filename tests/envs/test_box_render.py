"""Pictures of tracking in video: boxes, tags and trails in identity colors, plots, bounded memory."""

import numpy as np
import pytest

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.plots import TRAIL_LENGTH, identity_color
from servotrack.envs.track.people.box_paint import BoxTrail, annotate, printable
from servotrack.envs.track.people.box_recorder import BoxRecorder
from servotrack.envs.track.people.box_render import BoxScene, draw

GRAY = 120


def frame(height: int = 288, width: int = 384) -> np.ndarray:
    return np.full((height, width, 3), GRAY, dtype=np.uint8)


def trail(label: int, *boxes) -> BoxTrail:
    return BoxTrail(label, np.array(boxes, dtype=np.float64))


def distance_to(image: np.ndarray, color) -> np.ndarray:
    return np.abs(image.astype(int) - np.array(color)).max(axis=-1)


def test_a_box_has_its_identitys_color_at_its_edges_and_shows_what_is_in_it():
    image = frame()
    annotate(image, [trail(3, [100.0, 80.0, 40.0, 120.0])])
    color = identity_color(3)
    for row, column in ((140, 100), (140, 139), (199, 120)):
        assert distance_to(image[row, column], color) < 25
    inside = image[100:180, 105:135].astype(int)
    assert np.abs(inside - GRAY).max() < 20
    outside = np.ones(image.shape[:2], dtype=bool)
    outside[60:205, 92:146] = False
    assert (image[outside] == GRAY).all()


def test_identities_differ_in_color_and_tag():
    first, second = frame(), frame()
    annotate(first, [trail(1, [100.0, 80.0, 40.0, 120.0])])
    annotate(second, [trail(2, [100.0, 80.0, 40.0, 120.0])])
    assert (first[140, 100] != second[140, 100]).any()
    assert (first[60:80, 95:120] != GRAY).any()


def test_held_identities_are_fainter_and_bear_no_tag():
    reported, held = frame(), frame()
    box = [100.0, 80.0, 40.0, 120.0]
    annotate(reported, [trail(3, box)])
    annotate(held, [], [trail(3, box)])
    color = identity_color(3)
    assert distance_to(held[140, 100], color) > distance_to(reported[140, 100], color) + 20
    assert (held[60:76, 95:120] == GRAY).all()
    assert (held[140, 100] != GRAY).any()


def test_trails_follow_the_feet_and_fade_with_age():
    image = frame()
    boxes = [[20.0 + 5.0 * k, 60.0, 30.0, 100.0] for k in range(TRAIL_LENGTH)]
    annotate(image, [trail(4, *boxes)])
    row = image[160, 35 : 35 + 5 * (TRAIL_LENGTH - 1) - 20].astype(int)
    change = np.abs(row - GRAY).max(axis=1)
    assert change[-10:].mean() > 2.0 * change[10:30].mean() > 4.0
    assert (image[165:, :200] == GRAY).all()


def test_truth_and_detections_are_shown_on_request():
    for kind in ("truth", "detections"):
        image = frame()
        annotate(image, [], **{kind: np.array([[100.0, 80.0, 40.0, 120.0]])})
        assert (image != GRAY).any()
    truth = frame()
    annotate(truth, [], truth=np.array([[100.0, 80.0, 40.0, 120.0]]))
    # Brackets: corners, not the middle of the sides.
    assert (truth[82:100, 99:102] != GRAY).any()
    assert (truth[130:150] == GRAY).all()
    empty = frame()
    annotate(empty, [], truth=np.zeros((3, 4)), detections=np.empty((0, 4)))
    assert (empty == GRAY).all()


def test_points_are_shown_as_discs():
    image = frame()
    annotate(image, [BoxTrail(5, np.array([[60.0, 60.0], [64.0, 60.0]]))], truth=np.array([[200.0, 100.0]]))
    assert distance_to(image[60, 64], identity_color(5)) < 25
    assert (image[99:102, 199:202] != GRAY).any()


@pytest.mark.parametrize(
    "box",
    [
        [-500.0, -500.0, 20.0, 20.0],
        [370.0, 270.0, 100.0, 100.0],
        [-10.0, -10.0, 1e12, 1e12],
        [np.nan, 10.0, 20.0, np.inf],
        [100.0, 100.0, 0.0, 0.0],
        [100.0, 100.0, -5.0, 10.0],
    ],
)
def test_boxes_that_leave_the_frame_or_make_no_sense_do_no_harm(box):
    image = frame()
    annotate(image, [trail(123456, box, box)], [trail(2, box)], caption="x" * 500)
    assert image.shape == (288, 384, 3)


def test_a_caption_lies_at_the_top_left():
    image = frame()
    annotate(image, [], caption="7 people")
    assert (image[6:28, 6:60] != GRAY).any()
    assert (image[60:] == GRAY).all()


def test_titles_lose_what_the_font_lacks():
    assert printable("Meet_Split 3rdGuy (CAVIAR)!") == "meet-split 3rdguy caviar"
    assert printable("日本") == ""


def test_annotated_frames_may_have_any_size():
    for shape in ((1, 1), (7, 500), (1080, 1920)):
        image = frame(*shape)
        annotate(
            image, [trail(1, [0.3 * shape[1], 0.2 * shape[0], 0.2 * shape[1], 0.5 * shape[0]])], caption="1 person"
        )
        assert (image != GRAY).any()


def test_text_beyond_the_right_or_lower_border_is_cut_off():
    image = frame(10, 10)
    put_text(image, "people", 12.0, 8.0, (0, 0, 0))
    put_text(image, "people", 0.0, 40.0, (0, 0, 0))
    assert (image == GRAY).all()


def test_the_picture_shows_frame_boxes_and_curves():
    picture = draw(
        BoxScene(
            frame=frame(),
            reported=[trail(3, [100.0, 80.0, 40.0, 120.0])],
            reported_numbers=np.array([1.0, 2.0, 2.0]),
            true_numbers=np.array([2.0, 2.0, 3.0]),
            errors=np.array([0.2, 0.4, 0.1]),
        )
    )
    assert picture.shape == (732, 800, 3)
    assert picture.dtype == np.uint8
    assert distance_to(picture[16 + 280, 16 + 201], identity_color(3)) < 25
    assert (picture[16 + 500, 16 + 600] == GRAY).all()


def test_an_unknown_truth_leaves_only_the_estimates_number():
    numbers = np.array([3.0, 3.0, 1.0])
    known = draw(BoxScene(frame=frame(), reported_numbers=numbers, true_numbers=numbers + 1.0))
    unknown = draw(BoxScene(frame=frame(), reported_numbers=numbers))
    assert known.shape == unknown.shape
    assert (known != unknown).any()
    np.testing.assert_array_equal(known[:600], unknown[:600])


@pytest.mark.parametrize("shape", [(576, 768), (1080, 1920), (245, 300), (33, 57), (480, 641)])
def test_pictures_of_any_frame_have_even_sides(shape):
    picture = draw(BoxScene(frame=np.zeros(shape, dtype=np.uint8), reported_numbers=np.array([1.0])))
    assert picture.shape[0] % 2 == 0
    assert picture.shape[1] % 2 == 0
    assert picture.shape[1] <= 1000


def test_the_recorder_keeps_trails_by_identity_and_separates_held_from_reported():
    recorder = BoxRecorder()
    for k in range(3):
        boxes = np.array([[10.0 * k, 0.0, 5.0, 5.0], [0.0, 10.0 * k, 5.0, 5.0], [9.0, 9.0, 1.0, 1.0]])
        recorder.record([4, 7, -1], boxes, [True, False, False], true_number=2, error=0.5)
    reported, held = recorder.trails()
    assert [t.label for t in reported] == [4]
    assert [t.label for t in held] == [7]
    np.testing.assert_array_equal(reported[0].states[:, 0], [0.0, 10.0, 20.0])
    scene = recorder.scene(frame())
    np.testing.assert_array_equal(scene.reported_numbers, [1.0, 1.0, 1.0])
    np.testing.assert_array_equal(scene.true_numbers, [2.0, 2.0, 2.0])
    np.testing.assert_array_equal(scene.errors, [0.5, 0.5, 0.5])
    recorder.reset()
    assert recorder.trails() == ([], [])
    assert recorder.scene(frame()).true_numbers is None


def test_the_recorder_copies_what_it_keeps():
    recorder, boxes = BoxRecorder(), np.array([[1.0, 2.0, 3.0, 4.0]])
    recorder.record([1], boxes)
    boxes[:] = 0.0
    np.testing.assert_array_equal(recorder.trails()[0][0].states, [[1.0, 2.0, 3.0, 4.0]])


def test_an_endless_run_keeps_a_bounded_past():
    recorder = BoxRecorder(horizon=50)
    for k in range(2000):
        recorder.record([k], np.array([[1.0, 2.0, 3.0, 4.0]]), true_number=1, error=0.0)
    assert len(recorder._past) <= TRAIL_LENGTH
    scene = recorder.scene(frame())
    assert len(scene.reported_numbers) == len(scene.true_numbers) == len(scene.errors) == 50
