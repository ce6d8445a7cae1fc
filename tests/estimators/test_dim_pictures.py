"""Dark, noisy and fading pictures: people are found in them, or it is said; fast cameras learn people no sooner."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder, MaskedBackground
from servotrack.estimators.detect.dim_pictures import DimRules, View, next_view

H, W = 144, 192
RNG = np.random.default_rng(5)
FLOOR = np.clip(cv2.GaussianBlur(RNG.normal(130.0, 60.0, (H, W, 3)), (0, 0), 2.0), 60, 220)
FINDER = BlobFinder(split=False, smallest=100)


def frame(step, gain=1.0, noise=2.0, person=True):
    """The floor with one walker, then light, then noise of its own for each step."""
    picture = FLOOR.copy()
    if person:
        left = 10 + step % 150
        picture[50:110, left : left + 24] = (25.0, 30.0, 40.0)
    noisy = gain * picture + np.random.default_rng(step).normal(0.0, noise, picture.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def run(frames, background):
    state, counts, notices = MaskedBackground(blobs=FINDER).initial(background), [], []
    detector = MaskedBackground(blobs=FINDER)
    for picture in frames:
        state, found = detector.step(state, picture)
        counts.append(len(found.boxes))
        notices.append(state.notice)
    return np.array(counts), notices, state


@pytest.mark.parametrize(("gain", "noise", "said"), [(0.2, 5.0, "dark"), (0.5, 15.0, "noisy"), (1.0, 3.0, "")])
def test_people_are_found_in_the_dark_and_in_noise_and_it_is_said(gain, noise, said):
    frames = [frame(k, gain, noise) for k in range(100)]
    counts, notices, _ = run(frames, frames[::3])
    assert np.mean(counts[10:] == 1) > 0.9
    assert (f"the picture is {said}" in notices[49]) if said else not any(notices)


def test_a_fade_in_from_black_reports_nothing_until_the_light_is_steady():
    gains = np.clip((np.arange(120) - 20) / 40.0, 0.0, 1.0)
    frames = [frame(k, gain) for k, gain in enumerate(gains)]
    counts, notices, state = run(frames, frames[::3])
    assert not counts[:55].any()
    assert "the foreground covers" in next(notice for notice in notices if notice)
    assert np.mean(counts[75:] == 1) > 0.9
    assert state.view == View()
    assert "the light settles in the first" in MaskedBackground(blobs=FINDER).initial(frames[::3]).notice


def test_lights_off_and_on_bring_the_background_back():
    lit, black = [frame(k) for k in range(40)], [frame(k, 0.02) for k in range(40, 140)]
    counts, _, state = run([*lit, *black, *(frame(k) for k in range(140, 200))], [frame(k) for k in range(0, 120, 3)])
    assert not counts[45:140].any()
    assert np.mean(counts[155:] == 1) > 0.9
    assert np.abs(state.background - FLOOR).mean() < 4.0


def test_a_view_changes_only_for_a_clear_gain_and_never_to_a_smaller_square():
    rules = DimRules()
    assert next_view(View(), 120.0, 6.0, rules) == View()
    assert next_view(View(), 60.0, 6.0, rules) == View()
    assert next_view(View(), 25.0, 4.0, rules) == View(1, 3.0)
    assert next_view(View(), 25.0, 14.0, rules) == View(5, 3.0)
    assert next_view(View(5, 3.0), 75.0, 8.0, rules) == View(5, 3.0)
    assert next_view(View(5, 3.0), 240.0, 8.0, rules) == View(5, 1.0)
    assert next_view(View(), 2.0, 1.0, rules) == View()


def test_a_faster_camera_learns_no_sooner():
    detector = MaskedBackground(blobs=FINDER, heal_every=0)
    state = detector.initial(frame(0, noise=0.0, person=False))
    brighter = np.clip(FLOOR + 8.0, 0, 255).astype(np.uint8)
    slow, _ = detector.step(state, brighter, 1 / 25)
    fast, _ = detector.step(state, brighter, 1 / 100)
    np.testing.assert_allclose(fast.background - state.background, (slow.background - state.background) / 4, atol=1e-4)
