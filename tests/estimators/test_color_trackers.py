"""Trackers of one object: they follow, they repeat themselves, their states are values, and bad input is named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from color_film import SHAPE, SIZE, box, frame, turned_frame, walk

from servotrack.estimators.color import back_projection, opencv_trackers
from servotrack.estimators.color.contract import Pose, normals
from servotrack.estimators.color.histogram import color_histogram, similarities
from servotrack.estimators.color.light import LightMeter
from servotrack.estimators.color.mean_shift import KernelMeanShift, kernel_histogram
from servotrack.estimators.color.monte_carlo import MonteCarloColor
from servotrack.estimators.color.monte_carlo_plus import MonteCarloColorPlus
from servotrack.estimators.color.particle_filter import ColorParticleFilter, systematic_resampling
from servotrack.estimators.color.start import start_from_motion
from servotrack.estimators.detect.detections import detections_from_boxes

BackProjection, OpenCVTracker = back_projection.BackProjection, opencv_trackers.OpenCVTracker
VALUES = {
    "monte carlo": MonteCarloColor(),
    "plus": MonteCarloColorPlus(),
    "particle filter": ColorParticleFilter(),
    "mean shift": KernelMeanShift(),
    "opencv meanshift": BackProjection(saturation=60),
    "opencv camshift": BackProjection("camshift", saturation=60),
}
"""Trackers whose states are values."""


def run(tracker, places):
    state = tracker.initial(frame(*places[0]), box(*places[0]))
    found = []
    for number, place in enumerate(places[1:], 1):
        state, estimate = tracker.step(state, frame(*place, seed=number))
        found.append(estimate)
    return found


@pytest.mark.parametrize("name", VALUES)
def test_a_moving_patch_is_followed(name: str) -> None:
    places = walk()
    end = run(VALUES[name], places)[-1]
    assert np.abs(end.box[:2] + end.box[2:] / 2 - box(*places[-1])[:2] - box(*places[-1])[2:] / 2).max() < 8.0
    assert 0.0 < end.similarity <= 1.0


@pytest.mark.parametrize("name", VALUES)
def test_the_same_frames_give_the_same_bits_and_states_are_values(name: str) -> None:
    tracker, places = VALUES[name], walk(8)
    first, second = run(tracker, places), run(tracker, places)
    assert all(np.array_equal(a.box, b.box) for a, b in zip(first, second, strict=True))
    state = tracker.initial(frame(*places[0]), box(*places[0]))
    later, once = tracker.step(state, frame(*places[1], seed=1))
    tracker.step(later, frame(*places[2], seed=2))
    _, again = tracker.step(state, frame(*places[1], seed=1))
    assert np.array_equal(once.box, again.box)


def test_random_numbers_are_a_function_of_seed_and_frame() -> None:
    assert np.array_equal(normals(3, 5, (4, 3)), normals(3, 5, (4, 3)))
    assert not np.array_equal(normals(3, 5, (4, 3)), normals(3, 6, (4, 3)))
    assert not np.array_equal(normals(3, 5, (4, 3)), normals(4, 5, (4, 3)))
    different = [run(MonteCarloColor(seed=seed), walk(4))[-1].box for seed in (0, 1)]
    assert not np.array_equal(*different)


def test_the_estimate_is_the_weighted_mean_worked_out_by_hand() -> None:
    tracker = MonteCarloColor(samples=7, distance_deviation=0.3)
    state = tracker.initial(frame(40, 30), box(40, 30))
    image = frame(43, 31, seed=9)
    centers, scales = tracker.draw(state)
    boxes = Pose(np.zeros(2), 1.0, np.array([24.0, 32.0]), (120, 160)).boxes(centers, scales)
    total, mean = 0.0, np.zeros(3)
    for (x, y), scale, candidate in zip(centers, scales, boxes, strict=True):
        rho = np.sqrt(color_histogram(image, candidate) * state.reference).sum()
        weight = np.exp(-(np.sqrt(1.0 - rho) ** 2) / 0.3**2)
        total, mean = total + weight, mean + weight * np.array([x, y, scale])
    x, y, scale = mean / total
    after, estimate = tracker.step(state, image)
    np.testing.assert_allclose(estimate.box, [x - 12 * scale, y - 16 * scale, 24 * scale, 32 * scale], rtol=1e-9)
    assert after.pose.scale == pytest.approx(scale)
    assert estimate.weights.sum() == pytest.approx(1.0)


def test_the_reference_changes_by_eq_12_and_only_above_the_threshold() -> None:
    tracker = MonteCarloColor(update_rate=0.25, update_threshold=0.5)
    state = tracker.initial(frame(40, 30), box(40, 30))
    image = frame(41, 30, seed=3)
    after, estimate = tracker.step(state, image)
    assert estimate.similarity > 0.5
    np.testing.assert_allclose(
        after.reference, 0.75 * state.reference + 0.25 * color_histogram(image, estimate.box), atol=1e-12
    )
    covered, hidden = tracker.step(state, frame(40, 30, hidden=True))
    assert hidden.similarity < 0.5
    assert np.array_equal(covered.reference, state.reference)


def test_the_plus_variant_remembers_nothing_of_what_hides_its_object() -> None:
    tracker = MonteCarloColorPlus()
    state = tracker.initial(frame(60, 40), box(60, 40))
    for number in range(3):
        state, _ = tracker.step(state, frame(60, 40, seed=number))
    after, estimate = tracker.step(state, frame(60, 40, hidden=True))
    assert estimate.similarity < tracker.hidden_below
    assert np.array_equal(after.recent, state.recent)
    assert np.array_equal(after.inside, state.inside)
    assert after.lost > state.lost
    back, found = tracker.step(after, frame(60, 40, seed=8))
    assert found.similarity > tracker.hidden_below
    assert back.lost < after.lost


def scaled(name: str, change: float) -> float:
    """Width of a tracker's box after 20 frames in which the patch changed its scale by `change` a frame, about 1."""
    tracker = VALUES[name]
    state = tracker.initial(frame(60, 40), box(60, 40))
    for number in range(1, 21):
        scale = 1.0 + change * number
        place = round(60 - 12 * (scale - 1)), round(40 - 16 * (scale - 1))
        state, estimate = tracker.step(state, frame(*place, seed=number, scale=scale))
    return float(estimate.box[2]) / 24.0


@pytest.mark.parametrize("rate", [0.12, -0.12])
def test_a_patch_that_turns_over_is_followed_in_angle(rate: float) -> None:
    tracker = MonteCarloColorPlus()
    left, top = (SHAPE[1] - SIZE[0]) / 2, (SHAPE[0] - SIZE[1]) / 2
    state = tracker.initial(turned_frame(0.0), [left, top, *SIZE])
    for number in range(1, 70):
        state, estimate = tracker.step(state, turned_frame(rate * number, seed=number))
        # Never the same patch upside down, although its outline is the same.
        assert abs(state.angle - rate * number) < 0.3
        assert np.abs(estimate.box[:2] + estimate.box[2:] / 2 - [SHAPE[1] / 2, SHAPE[0] / 2]).max() < 2.5


def test_one_direction_follows_no_turn() -> None:
    tracker = MonteCarloColorPlus(angles=1)
    state = tracker.initial(frame(60, 40), box(60, 40))
    state, estimate = tracker.step(state, frame(61, 40, seed=1))
    assert state.angle == 0.0 and len(state.first.features) == 1
    assert np.allclose(estimate.box[2] / estimate.box[3], SIZE[0] / SIZE[1])


@pytest.mark.parametrize("name", ["monte carlo", "plus", "particle filter", "mean shift"])
def test_a_shrinking_patch_is_followed_in_scale(name: str) -> None:
    assert scaled(name, -0.016) < 0.88


def test_growth_shows_in_contrast_and_gradients_but_not_in_a_histogram() -> None:
    # Every part of the patch has its colors in nearly the same shares: a box inside of it looks right.
    assert scaled("plus", 0.02) > 1.2 > scaled("monte carlo", 0.02)


def test_the_kernel_histogram_weighs_the_middle_more_and_sums_to_one() -> None:
    image = np.zeros((20, 20, 3), np.uint8)
    image[8:12, 8:12] = 255
    found = kernel_histogram(image, np.array([10.0, 10.0]), np.array([16.0, 16.0]))
    assert found.sum() == pytest.approx(1.0)
    u = (np.arange(20) + 0.5 - 10.0) / 8.0
    weight = np.maximum(1.0 - u[:, None] ** 2 - u[None, :] ** 2, 0.0)
    assert found[-1] == pytest.approx(weight[8:12, 8:12].sum() / weight.sum())
    assert found[-1] > 16 / (weight > 0).sum()


def test_mean_shift_climbs() -> None:
    tracker = KernelMeanShift(scale_step=0.0)
    state = tracker.initial(frame(60, 40), box(60, 40))
    moved = frame(66, 44, seed=2)
    before = np.sqrt(kernel_histogram(moved, state.pose.center, state.pose.size) * state.reference).sum()
    after, estimate = tracker.step(state, moved)
    assert estimate.similarity > before
    np.testing.assert_allclose(after.pose.center, [78.0, 60.0], atol=1.0)


def test_systematic_resampling_takes_each_as_often_as_its_weight_says() -> None:
    weights = np.array([0.5, 0.0, 0.3, 0.2])
    for offset in (0.0, 0.4, 0.99):
        counts = np.bincount(systematic_resampling(np.repeat(weights / 10, 10), offset) // 10, minlength=4)
        assert (np.abs(counts - 40 * weights) <= 1).all()


def test_candidates_are_compared_where_they_are() -> None:
    reference = color_histogram(frame(40, 30), box(40, 30))
    there, beside = similarities(frame(40, 30), np.array([box(40, 30), box(90, 60)]), reference)
    assert there == pytest.approx(1.0)
    assert beside < 0.1


def test_gray_frames_are_colors_of_three_equal_channels() -> None:
    gray = frame(40, 30)[..., 0]
    tracker = MonteCarloColor()
    color = np.repeat(gray[..., None], 3, axis=2)
    a, b = (tracker.step(tracker.initial(image, box(40, 30)), image)[1].box for image in (gray, color))
    assert np.array_equal(a, b)


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize(
    ("bad", "match"),
    [
        ([np.nan, 3, 10, 10], "four finite numbers"),
        ([3, 3, 10], "four finite numbers"),
        ([3, 3, 0, 10], "at least 1 px wide"),
        ([200, 3, 10, 10], "must overlap the frame of 160 x 120 px"),
        ([-11, 3, 10, 10], "must overlap the frame"),
        ([-1e300, 3, 2e300, 10], "must lie within 1e\\+06 px"),
        ("left", "four finite numbers"),
        (None, "four finite numbers"),
    ],
)
def test_bad_boxes_are_named(name: str, bad: list[float], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        VALUES[name].initial(frame(40, 30), bad)


@pytest.mark.parametrize("name", VALUES)
def test_bad_frames_are_named(name: str) -> None:
    tracker = VALUES[name]
    state = tracker.initial(frame(40, 30), box(40, 30))
    with pytest.raises(ValueError, match=r"height and width \(120, 160\)"):
        tracker.step(state, frame(40, 30)[:-1])
    with pytest.raises(ValueError, match="frame must be uint8"):
        tracker.step(state, frame(40, 30).astype(float))
    with pytest.raises(ValueError, match="drop an alpha channel"):
        tracker.initial(np.zeros((120, 160, 4), np.uint8), box(40, 30))


@pytest.mark.parametrize("name", VALUES)
def test_a_box_at_the_border_and_an_empty_frame_do_no_harm(name: str) -> None:
    tracker = VALUES[name]
    state = tracker.initial(frame(0, 0), [-10.0, -12.0, 24.0, 32.0])
    for number in range(4):
        state, estimate = tracker.step(state, np.full((120, 160, 3), 60 * number, np.uint8))
        assert np.isfinite(estimate.box).all()
        assert (estimate.box[2:] > 0.0).all()


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 9, 3), (9, 1), (2, 2, 3)])
def test_frames_of_a_few_pixels_are_tracked(name: str, shape: tuple[int, ...]) -> None:
    tracker = VALUES[name]
    rng = np.random.default_rng(2)
    for first in ([0.0, 0.0, 1.0, 1.0], [-0.2, -0.2, 1.2, 1.2], [-500.0, -500.0, 1000.0, 1000.0]):
        state = tracker.initial(rng.integers(0, 256, shape, np.uint8), first)
        for _ in range(3):
            state, estimate = tracker.step(state, rng.integers(0, 256, shape, np.uint8))
            assert np.isfinite(estimate.box).all()
            assert (estimate.box[2:] > 0.0).all()
            assert 0.0 <= estimate.similarity <= 1.0


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: MonteCarloColor(samples=0), "samples must be a whole number of at least 1, got 0"),
        (lambda: MonteCarloColor(distance_deviation=0.0), "distance_deviation must be finite and above 0"),
        (lambda: MonteCarloColor(update_threshold=1.1), r"update_threshold must lie in \[0, 1\], got 1.1"),
        (lambda: ColorParticleFilter(damping=-0.1), "damping must lie in"),
        (lambda: KernelMeanShift(tolerance=np.nan), "tolerance must be finite"),
        (lambda: BackProjection("snake"), "method must be one of meanshift, camshift"),
        (lambda: MonteCarloColorPlus(grid=0), "grid must be a whole number"),
        (lambda: MonteCarloColor(bins=17), "bins must be a whole number from 1 to 16, got 17"),
        (lambda: KernelMeanShift(bins=0), "bins must be a whole number from 1 to 16, got 0"),
        (lambda: ColorParticleFilter(seed=-1), "seed must be a whole number from 0"),
        (lambda: MonteCarloColorPlus(samples=1), "samples must be at least 2"),
        (lambda: MonteCarloColorPlus(losing=2.0), "losing must lie in"),
        (lambda: MonteCarloColorPlus(gradient_share=0.9), "gradient_share \\+ color_share must be at most 1"),
        (lambda: MonteCarloColorPlus(widening=np.nan), "widening must be finite"),
        (lambda: MonteCarloColorPlus(light_adaptation=-1.0), "light_adaptation must be finite and at least 0"),
        (lambda: MonteCarloColorPlus(roaming=1.5), "roaming must lie in"),
        (lambda: LightMeter(samples=0), "samples must be a whole number of at least 1, got 0"),
        (lambda: LightMeter(step=0.0), "step must be finite and above 0"),
        (lambda: OpenCVTracker("GOTURN"), "name must be one of MIL, CSRT, KCF"),
    ],
)
def test_bad_values_are_named(make, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        make()


def test_a_tracker_that_opencv_lacks_says_what_to_install(monkeypatch) -> None:
    monkeypatch.delattr(cv2, "TrackerCSRT_create", raising=False)
    monkeypatch.delattr(cv2, "legacy", raising=False)
    with pytest.raises(ValueError, match="install opencv-contrib-python-headless"):
        OpenCVTracker("CSRT")


needs_mil = pytest.mark.skipif(not hasattr(cv2, "TrackerMIL_create"), reason="this OpenCV has no MIL")


@needs_mil
def test_opencvs_tracker_follows() -> None:
    places = walk(5)
    end = run(OpenCVTracker(), places)[-1]
    assert np.abs(end.box[:2] - box(*places[-1])[:2]).max() < 8.0


@needs_mil
def test_opencvs_errors_are_told_as_what_they_mean(monkeypatch) -> None:
    with pytest.raises(ValueError, match="box must leave MIL pixels inside and around it"):
        OpenCVTracker().initial(np.zeros((6, 6, 3), np.uint8), [0, 0, 6, 6])

    class GivesUp:
        def init(self, image, window):
            pass

        def update(self, image):
            raise cv2.error("no candidate")

    monkeypatch.setattr(OpenCVTracker, "_maker", lambda self: GivesUp)
    _, estimate = OpenCVTracker().step(OpenCVTracker().initial(frame(40, 30), box(40, 30)), frame(41, 30))
    assert np.array_equal(estimate.box, box(40, 30))
    assert estimate.similarity == 0.0


@pytest.mark.parametrize("small", [[20, 20, 4, 30], [20, 20, 30, 3], [20, 20, 1, 1], [-27, 10, 30, 30]])
def test_mil_refuses_boxes_in_which_opencv_would_search_for_ever(small) -> None:
    with pytest.raises(ValueError, match="box must show at least 5 x 5 px inside the frame for MIL"):
        OpenCVTracker().initial(frame(40, 30), small)


class Differences:
    """A detector for tests: what differs from the first frames' median, as one box."""

    def initial(self, frames):
        return np.median(frames, axis=0)

    def step(self, state, image):
        rows, columns = np.nonzero(np.abs(image - state).max(axis=2) > 45)
        if len(rows) == 0:
            return state, detections_from_boxes(np.zeros((0, 4)))
        left, top = columns.min(), rows.min()
        return state, detections_from_boxes([[left, top, columns.max() + 1 - left, rows.max() + 1 - top]])


def test_tracking_can_start_from_what_moves() -> None:
    still = [np.random.default_rng(number).integers(90, 130, (120, 160, 3), dtype=np.uint8) for number in range(5)]
    moving = [frame(30 + 4 * number, 30, seed=number) for number in range(6)]
    frames = iter([*still, *moving])
    start = start_from_motion(frames, Differences(), background=5, seen=3)
    assert start.frame == 7
    assert np.array_equal(start.image, moving[2])
    assert np.array_equal(start.box, box(38, 30))
    # The rest of the same iterator is what comes next.
    state = MonteCarloColor().initial(start.image, start.box)
    _, estimate = MonteCarloColor().step(state, next(frames))
    assert np.abs(estimate.box - box(42, 30)).max() < 6.0
    with pytest.raises(ValueError, match="motion in 3 consecutive frames, got none in 5 frames"):
        start_from_motion(still, Differences(), background=4)
    with pytest.raises(ValueError, match="more than the background's 10, got 5"):
        start_from_motion(still, Differences())
    with pytest.raises(ValueError, match=r"height and width \(120, 160\)"):
        start_from_motion([still[0], still[1][:-1]], Differences(), background=2)
