"""A detector with a background says within two seconds that the camera moves or that everything changes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder, MaskedBackground

H, W, RATE = 144, 192, 10
RNG = np.random.default_rng(4)
# Structure of several sizes, as in real pictures.
WORLD = 120.0 + sum(
    cv2.GaussianBlur(RNG.normal(0.0, 100.0 * size, (H, 6 * W, 3)), (0, 0), float(size)) for size in (3, 12, 24)
)
WORLD = np.clip(WORLD, 20, 220)
NOISE = RNG.normal(0.0, 3.0, (16, H, W, 3))


def frame(step, left=0.0, people=(), gain=1.0):
    """The world from `left` on, with people as dark boxes at places in the image."""
    shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, 0.0]])
    picture = gain * cv2.warpAffine(WORLD, shift, (W, H))
    for x, y in people:
        picture[int(y) : int(y) + 50, max(int(x), 0) : int(x) + 18] = (20.0, 30.0, 60.0)
    return np.clip(picture + NOISE[step % 16], 0, 255).astype(np.uint8)


def run(frames):
    detector = MaskedBackground(blobs=BlobFinder(split=False), frame_rate=RATE)
    state, notices, counts = None, [], []
    for picture in frames:
        state = detector.initial(picture) if state is None else state
        state, found = detector.step(state, picture)
        notices.append(state.notice)
        counts.append(len(found.boxes))
    return notices, counts, state


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_a_camera_that_starts_to_pan_is_said_within_two_seconds(speed):
    start = 30
    frames = [frame(k, speed * max(k - start, 0), [(20 + k, 60)]) for k in range(90)]
    notices, counts, _ = run(frames)
    assert not any(notices[:start])
    first = next(k for k, notice in enumerate(notices) if notice)
    assert first - start <= 2 * RATE
    assert "the camera moves by about" in notices[first] and "--detector model.onnx" in notices[first]
    assert float(notices[first].split("about ")[1].split()[0]) == pytest.approx(speed * RATE, abs=1.0)
    # Nothing is reported as long as it moves.
    assert not any(counts[first:])
    assert all(notices[first:])


def test_a_camera_that_stops_is_used_again():
    frames = [frame(k, 2.0 * np.clip(k - 10, 0, 40), [(10 + 1.5 * (k % 100), 60)]) for k in range(120)]
    notices, counts, _ = run(frames)
    assert any("camera moves" in notice for notice in notices)
    assert not any(notices[70:])
    assert np.mean(np.array(counts[90:]) == 1) > 0.8


def test_people_and_steps_of_light_are_no_camera_that_moves():
    walk = [frame(k, 0.0, [(-40 + 3 * k, 60), (180 - 2 * k, 80), (60, 40)], 1.3 if k >= 40 else 1.0) for k in range(80)]
    notices, _, _ = run(walk)
    assert not any("camera" in notice for notice in notices)


def test_a_picture_that_changes_altogether_is_said_after_ten_frames():
    other = np.clip(255.0 - frame(0)[::-1, ::-1].astype(float), 0, 255)
    frames = [frame(k) if k < 10 else np.clip(other + NOISE[k % 16], 0, 255).astype(np.uint8) for k in range(70)]
    notices, counts, _ = run(frames)
    first = next(k for k, notice in enumerate(notices) if notice)
    assert first - 10 <= RATE and "the foreground covers" in notices[first]
    assert not any(counts) and not notices[-1]


def test_the_background_is_taken_from_before_a_change_of_light():
    dark, bright = [frame(k, 0.0, [(10 + 8 * k, 60)]) for k in range(12)], [frame(k, gain=1.5) for k in range(20)]
    state = MaskedBackground().initial(dark + bright)
    assert "the light changes after 12 of the 32 frames" in state.notice
    assert np.abs(state.background - WORLD[:, :W]).mean() < 6.0
    assert MaskedBackground().initial(dark).notice == ""
    mixed = MaskedBackground(same_light=False).initial(dark + bright)
    assert np.abs(mixed.background - WORLD[:, :W]).mean() > 20.0
