"""The detector of Wu and Hu 2010: its update rule, its deadlock and ghosts with and without healing, and bad frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder, MaskedBackground
from servotrack.estimators.detect.difference import above, levels_of_sample, share_above

H, W = 144, 192
RNG = np.random.default_rng(0)
FLOOR = np.clip(cv2.GaussianBlur(RNG.normal(120.0, 60.0, (H, W, 3)), (0, 0), 2.0), 30, 200)
CLOTH = cv2.GaussianBlur(RNG.normal(0.0, 80.0, (50, 18, 3)), (0, 0), 2.0) + np.array([40.0, 45.0, 60.0])
NOISE = RNG.normal(0.0, 3.0, (16, H, W, 3))
PLAIN = BlobFinder(split=False)


def frame(step, people=(), light=None):
    """A frame with people whose left upper corners are given, then `light` done to it, then noise."""
    picture = FLOOR.copy()
    for x, y in people:
        x, y = int(x), int(y)
        left, right = max(x, 0), min(x + 18, W)
        if left < right:
            picture[y : y + 50, left:right] = CLOTH[:, left - x : right - x]
    if light is not None:
        picture = light(picture)
    return np.clip(picture + NOISE[step % 16], 0, 255).astype(np.uint8)


def brighter_left(picture):
    picture[:, : W // 2] += 45.0
    return picture


LIGHTS = {
    "on": lambda picture: picture + 40.0,
    "off": lambda picture: picture - 45.0,
    "gain": lambda picture: picture * 1.6,
    "left half": brighter_left,
}


def follow(detector, frames, start=None):
    """Share of foreground, and detections, frame by frame."""
    frames = list(frames)
    state = detector.initial(frames[0] if start is None else start)
    shares, found = [], []
    for picture in frames:
        state, detections = detector.step(state, picture)
        shares.append(np.count_nonzero(state.mask) / state.mask.size)
        found.append(detections)
    return np.array(shares), found, state


def test_the_update_is_equation_6():
    detector = MaskedBackground(hold="pixels", heal_every=0, learning_rate=0.1, threshold=25.0, blobs=PLAIN)
    state = detector.initial(frame(0))
    before = state.background.copy()
    image = frame(1, [(60, 40)])
    after, _ = detector.step(state, image)
    foreground = np.abs(image.astype(float) - np.round(before)).max(axis=2, keepdims=True) >= 25.0
    assert 0.02 < foreground.mean() < 0.08
    expected = 0.9 * before + 0.1 * np.where(foreground, before, image)
    np.testing.assert_allclose(after.background, expected, atol=1e-3)


def test_a_state_is_a_value():
    detector = MaskedBackground()
    state = detector.initial(frame(0, [(60, 40)]))
    for step in range(1, 5):
        state, _ = detector.step(state, frame(step, [(60 + 8 * step, 40)]))
    copies = [np.copy(part) for part in (state.background, state.rounded, state.mask, *state.sizes)]
    # The fifth frame heals the ghost, which writes into a background; not into this one.
    first, found = detector.step(state, frame(5, [(120, 40)]))
    again, same = detector.step(state, frame(5, [(120, 40)]))
    for part, copy in zip((state.background, state.rounded, state.mask, *state.sizes), copies, strict=True):
        np.testing.assert_array_equal(part, copy)
    np.testing.assert_array_equal(first.background, again.background)
    np.testing.assert_array_equal(found.boxes, same.boxes)
    assert not np.array_equal(first.background, state.background)


def test_a_walker_is_found_where_he_is():
    walk = [(10 + 2 * step, 50) for step in range(60)]
    _, found, _ = follow(
        MaskedBackground(blobs=PLAIN), [frame(k, [place]) for k, place in enumerate(walk)], start=frame(0)
    )
    for (x, y), detections in zip(walk, found, strict=True):
        assert len(detections.boxes) == 1
        np.testing.assert_allclose(detections.boxes[0], (x, y, 18, 50), atol=3.0)
        np.testing.assert_allclose(detections.centroids[0], (x + 9, y + 25), atol=2.0)
        assert detections.features.shape == (1, 512)


@pytest.mark.parametrize("kind", LIGHTS)
def test_after_a_step_of_light_the_printed_rule_is_stuck_and_ours_recovers(kind):
    person = [(90, 60)]
    frames = [frame(k, person, LIGHTS[kind] if k >= 20 else None) for k in range(140)]
    printed = MaskedBackground(heal_every=0, flood=1.0, edges=0.0, exposure=None, blobs=PLAIN)
    shares, _, _ = follow(printed, frames, start=frame(0))
    assert (shares[20:] - 900 / (H * W) > 0.05).all()
    healed = MaskedBackground(exposure=None, blobs=PLAIN)
    for ours in (healed, MaskedBackground(blobs=PLAIN)):
        shares, found, _ = follow(ours, frames, start=frame(0))
        assert shares[20] > 0.3 or ours is not healed
        assert (shares[60:] - 900 / (H * W) < 0.01).all()
        # The person did not move all the while, and was not taken for light.
        for detections in found[60:]:
            np.testing.assert_allclose(detections.boxes, [(90, 60, 18, 50)], atol=4.0)


def test_a_picture_that_changes_altogether_becomes_the_background():
    other = np.ascontiguousarray(frame(0)[::-1, ::-1]) // 2 + 100
    detector = MaskedBackground(heal_every=0, threshold=20.0, flood=0.4, flood_time=0.4)
    state = detector.initial(frame(0))
    for step in range(30):
        state, found = detector.step(state, other)
        assert len(found.boxes) == 0
        assert (np.count_nonzero(state.mask) > 0) == (step <= 10)


def test_a_ghost_of_who_stood_in_the_first_frame_is_healed():
    frames = [frame(k, [(20 + 2 * k, 50)]) for k in range(70)]
    _, stuck, _ = follow(MaskedBackground.paper(), frames)
    assert all(len(found.boxes) == 2 for found in stuck[30:])
    _, healed, _ = follow(MaskedBackground(blobs=PLAIN), frames)
    for k, found in enumerate(healed[30:], 30):
        np.testing.assert_allclose(found.boxes, [(20 + 2 * k, 50, 18, 50)], atol=3.0)


def test_the_median_of_frames_with_people_has_none():
    burn_in = [frame(k, [(10 + 15 * k, 50)]) for k in range(10)]
    state = MaskedBackground().initial(burn_in)
    assert np.abs(state.background - FLOOR).max() < 15.0
    mean = MaskedBackground(start="mean").initial(np.stack(burn_in))
    np.testing.assert_allclose(mean.background, np.mean(burn_in, axis=0), atol=1e-3)


def test_who_stands_still_is_not_absorbed():
    detector = MaskedBackground(learning_rate=0.1, blobs=PLAIN)
    _, found, _ = follow(detector, [frame(k, [(60, 50)]) for k in range(200)], start=frame(0))
    np.testing.assert_allclose(found[-1].boxes, [(60, 50, 18, 50)], atol=3.0)


def test_light_that_drifts_is_learned():
    drift = [frame(k, (), lambda picture, k=k: picture + 0.25 * k) for k in range(200)]
    shares, _, _ = follow(MaskedBackground(blobs=PLAIN), drift)
    assert shares.max() < 0.001


def test_otsu_divides_people_from_floor_and_finds_nothing_in_noise():
    detector = MaskedBackground(threshold="otsu", blobs=PLAIN)
    state = detector.initial(frame(0))
    state, empty = detector.step(state, frame(1))
    assert len(empty.boxes) == 0
    _, found = detector.step(state, frame(2, [(60, 50)]))
    np.testing.assert_allclose(found.boxes, [(60, 50, 18, 50)], atol=4.0)


def test_shadows_are_taken_away():
    def shade(picture):
        picture[80:100, 90:130] *= 0.7
        return picture

    for shadows, count in ((False, 2), (True, 1)):
        detector = MaskedBackground(threshold=20.0, shadows=shadows, edges=0.0, blobs=PLAIN)
        _, found = detector.step(detector.initial(frame(0)), frame(1, [(50, 40)], shade))
        assert len(found.boxes) == count


@pytest.mark.parametrize("detector", [MaskedBackground(), MaskedBackground(color="gray"), MaskedBackground.paper()])
def test_gray_frames(detector):
    gray = [cv2.cvtColor(frame(k, [(60, 50)] if k else []), cv2.COLOR_RGB2GRAY) for k in range(10)]
    _, found, _ = follow(detector, gray)
    np.testing.assert_allclose(found[-1].boxes, [(60, 50, 18, 50)], atol=4.0)


def test_frames_that_are_views_and_read_only():
    wide = np.zeros((H, 2 * W, 3), np.uint8)
    wide[:, ::2] = frame(1, [(60, 50)])
    view = wide[:, ::2]
    view.flags.writeable = False
    detector = MaskedBackground()
    _, found = detector.step(detector.initial(frame(0)), view)
    assert len(found.boxes) == 1


@pytest.mark.parametrize(
    ("bad", "match"),
    [
        (np.zeros((H, W, 3)), r"frame must be uint8, got float64 \(144, 192, 3\); scale it to 0..255"),
        (np.full((H, W, 3), np.nan), "replace NaN"),
        (np.zeros((H, W, 3), np.uint16), r"frame must be uint8, got uint16 .* shift it down to 8 bits"),
        (np.zeros((H, W, 4), np.uint8), "drop an alpha channel"),
        (np.zeros((H, W), np.uint8), r"must have the shape \(144, 192, 3\) of the frames before it, got \(144, 192\)"),
        (np.zeros((H + 1, W, 3), np.uint8), r"got \(145, 192, 3\); resize it, or start again"),
        (np.zeros((0, 0, 3), np.uint8), "must have pixels"),
        (None, "frame must be uint8, got object"),
    ],
)
def test_bad_frames_are_named(bad, match):
    detector = MaskedBackground()
    state = detector.initial(frame(0))
    with pytest.raises(ValueError, match=match):
        detector.step(state, bad)


@pytest.mark.parametrize(
    ("bad", "match"),
    [
        ([], "frames must hold at least one frame"),
        ([np.zeros((H, W, 3), np.uint8), np.zeros((H, W), np.uint8)], r"frames\[1\] must have the shape"),
        (np.zeros((H, W, 3)), "frames must be uint8"),
        (np.zeros((5, H, W, 3), np.float32), r"frames\[0\] must be uint8"),
        (np.zeros((0, H, W, 3), np.uint8), "at least one frame"),
    ],
)
def test_bad_first_frames_are_named(bad, match):
    with pytest.raises(ValueError, match=match):
        MaskedBackground().initial(bad)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"threshold": 0.0}, "threshold must be above 0"),
        ({"threshold": "auto"}, "threshold must be above 0"),
        ({"threshold": float("nan")}, "threshold must be above 0"),
        ({"least_threshold": 0.0}, "least_threshold"),
        ({"faint": -1.0}, "faint must be at least 0"),
        ({"learning_rate": 1.0}, "learning_rate must lie between 0 and 1, got 1.0"),
        ({"start": "mode"}, "start must be one of median, mean, got 'mode'"),
        ({"color": "hue"}, "color must be one of"),
        ({"hold": "all"}, "hold must be one of"),
        ({"heal_every": -1}, "heal_every"),
        ({"flood": 0.0}, "flood must be a share"),
        ({"flood_time": 0.0}, "flood_time"),
        ({"frame_rate": -1.0}, "frame_rate"),
    ],
)
def test_bad_parameters_are_named(arguments, match):
    with pytest.raises(ValueError, match=match):
        MaskedBackground(**arguments)


def camouflaged(step, x):
    """Head, hand and shoes stand out; the clothes are 18 gray levels from the floor."""
    picture = FLOOR.copy()
    picture[40:100, x : x + 20] += 18.0
    for top, left in ((40, x + 6), (66, x), (94, x + 8)):
        picture[top : top + 7, left : left + 8] = (220.0, 60.0, 50.0)
    return np.clip(picture + NOISE[step % 16], 0, 255).astype(np.uint8)


def test_the_second_threshold_completes_who_wears_the_colors_of_the_floor():
    for faint, count in ((10.0, 1), (0.0, 3)):
        detector = MaskedBackground(faint=faint, blobs=PLAIN)
        _, found, _ = follow(detector, [camouflaged(k, 40 + 2 * k) for k in range(20)], start=frame(0))
        assert {len(detections.boxes) for detections in found} == {count}
        if faint:
            np.testing.assert_allclose(found[-1].boxes, [(78, 40, 20, 60)], atol=4.0)


def test_the_second_threshold_joins_parts_of_which_every_row_is_seen_and_leaves_the_box_tight():
    """Legs apart and a sleeve make two regions that no row is without."""
    picture = FLOOR.copy()
    picture[36:104, 36:64] += 18.0
    picture[40:74, 40:48] = picture[70:100, 52:60] = (220.0, 60.0, 50.0)
    image = np.clip(picture + NOISE[1], 0, 255).astype(np.uint8)
    for faint, boxes in ((10.0, [(40, 40, 20, 60)]), (0.0, [(40, 40, 8, 34), (52, 70, 8, 30)])):
        detector = MaskedBackground(faint=faint, blobs=PLAIN)
        _, found = detector.step(detector.initial(frame(0)), image)
        np.testing.assert_allclose(found.boxes, boxes, atol=1.0)


def test_the_second_threshold_neither_finds_shadows_nor_joins_people_by_them():
    def shade(picture):
        picture[85:100, 20:170] -= 18.0
        return picture

    detector = MaskedBackground(blobs=PLAIN)
    state = detector.initial(frame(0))
    _, found = detector.step(state, frame(1, (), shade))
    assert len(found.boxes) == 0
    _, found = detector.step(state, frame(1, [(40, 42), (110, 42)], shade))
    assert len(found.boxes) == 2


@pytest.mark.parametrize(("level", "dark"), [(18, True), (90, False)])
def test_a_picture_too_dark_for_people_is_said(level, dark):
    rng, detector = np.random.default_rng(0), MaskedBackground()
    frames = [np.clip(rng.normal(level, 3.0, (60, 80, 3)), 0, 255).astype(np.uint8) for _ in range(3)]
    state = detector.initial(frames[0])
    for frame in frames:
        state, _ = detector.step(state, frame)
    assert ("the picture is dark" in state.notice) == dark


def test_one_frame_a_second_is_no_flood():
    rng, detector = np.random.default_rng(0), MaskedBackground(frame_rate=1.0)
    frames = [np.clip(rng.normal(90, 3.0, (60, 80, 3)), 0, 255).astype(np.uint8) for _ in range(3)]
    state = detector.initial(frames[0])
    for frame in frames:
        state, _ = detector.step(state, frame)
        assert not state.notice


def test_one_pass_of_morphology_serves_both_thresholds():
    difference = np.random.default_rng(3).integers(0, 60, (60, 83), dtype=np.uint8)
    finder = BlobFinder()
    for typical in (0.0, 30.0):
        for threshold in (10.0, 30.0):
            np.testing.assert_array_equal(
                above(finder.clean(difference, typical), threshold), finder.clean(above(difference, threshold), typical)
            )


def test_levels_of_a_sample_are_those_of_numpy():
    rng = np.random.default_rng(4)
    known, difference = rng.integers(0, 256, (50, 70, 3), dtype=np.uint8), rng.integers(0, 40, (50, 70), dtype=np.uint8)
    mask = np.where(rng.random((50, 70)) < 0.3, 255, 0).astype(np.uint8)
    brightness, level, count = levels_of_sample(known, difference, mask, 7, 0.9)
    sample = difference[::7, ::7][mask[::7, ::7] == 0]
    assert brightness == np.median(known[::7, ::7].max(axis=2))
    assert level == np.sort(sample)[int(0.9 * (len(sample) - 1))]
    assert count == len(sample)
    assert share_above(difference, 15.0, 7) == np.mean(difference[::7, ::7] > 15)
