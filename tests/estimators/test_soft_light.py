"""Reflections and soft shadows leave the foreground, people stay; things that do not move become background."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder, MaskedBackground
from servotrack.estimators.detect.stillness import StillRules

H, W = 144, 192
RNG = np.random.default_rng(2)
FLOOR = np.clip(cv2.GaussianBlur(RNG.normal(140.0, 50.0, (H, W, 3)), (0, 0), 2.0), 60, 200)
CLOTH = cv2.GaussianBlur(RNG.normal(0.0, 80.0, (50, 18, 3)), (0, 0), 2.0) + np.array([40.0, 45.0, 60.0])
NOISE = RNG.normal(0.0, 3.0, (16, H, W, 3))


def glow(center, size, gain):
    """A change of light whose border is as wide as itself."""
    rows, columns = np.mgrid[:H, :W]
    distance = ((columns - center[0]) / size[0]) ** 2 + ((rows - center[1]) / size[1]) ** 2
    return (1.0 + (gain - 1.0) * np.exp(-distance))[..., None]


def frame(step, person=None, light=1.0, thing=None):
    picture = FLOOR * light
    if thing is not None:
        x, y = thing
        picture[y : y + 12, x : x + 12] = (200.0, 40.0, 30.0)
    if person is not None:
        x, y = person
        picture[y : y + 50, x : x + 18] = CLOTH
    return np.clip(picture + NOISE[step % 16], 0, 255).astype(np.uint8)


def detect(detector, image):
    return detector.step(detector.initial(frame(0)), image)[1].boxes


def test_a_reflection_is_not_reported_and_a_person_is():
    plain = BlobFinder(split=False)
    for gain in (1.4, 0.7):
        image = frame(1, light=glow((120, 70), (25, 30), gain))
        assert len(detect(MaskedBackground(edges=0.0, blobs=plain), image)) >= 1
        assert len(detect(MaskedBackground(blobs=plain), image)) == 0
    np.testing.assert_allclose(detect(MaskedBackground(blobs=plain), frame(1, (60, 50))), [(60, 50, 18, 50)], atol=3.0)


def test_of_a_person_in_a_reflection_the_person_is_left():
    image = frame(1, (80, 40), light=glow((110, 70), (30, 30), 1.4))
    trimmed, loose = (
        MaskedBackground(edges=edges, blobs=BlobFinder(split=False))
        .step(MaskedBackground().initial(frame(0)), image)[1]
        .areas.sum()
        for edges in (0.7, 0.0)
    )
    assert loose > 1.8 * 18 * 50 and trimmed < 1.3 * 18 * 50


def test_a_cast_shadow_with_a_sharp_border_does_not_widen_a_person():
    shade = np.ones((H, W, 1))
    shade[82:90, 98:150] = 0.65
    (box,) = detect(MaskedBackground(blobs=BlobFinder(split=False)), frame(1, (80, 40), shade))
    np.testing.assert_allclose(box, (80, 40, 18, 50), atol=5.0)


def walked(detector, frames=160, dt=None):
    """A person walks to and fro, and leaves a thing at frame 40; the person stops at frame 90."""
    state, counts = detector.initial(frame(0)), []
    for k in range(frames):
        x = 20 + abs(60 - 2 * (min(k, 90) % 60))
        state, found = detector.step(state, frame(k, (x, 60), thing=(150, 100) if k >= 40 else None), dt)
        counts.append(len(found.boxes))
    return counts


def test_a_thing_that_was_left_becomes_background_and_who_stands_still_does_not():
    counts = walked(MaskedBackground(frame_rate=10.0))
    assert max(counts[42:60]) == 2
    assert counts[-20:] == [1] * 20
    assert walked(MaskedBackground(frame_rate=10.0, still=None))[-1] == 2


def test_a_thing_becomes_background_after_the_same_time_at_every_frame_rate():
    def gone(rate, dt=None):
        counts = walked(MaskedBackground(frame_rate=rate, still=StillRules(small_time=3.0)), 40 + int(4.5 * rate), dt)
        return 1 + max(k for k, count in enumerate(counts) if count == 2) - 40

    seconds = [gone(rate) / rate for rate in (10.0, 20.0, 30.0)]
    assert all(3.0 <= one <= 4.2 for one in seconds), seconds  # A search every 10 frames.
    assert gone(10.0, 0.1) == gone(10.0)
    with pytest.raises(ValueError, match="dt must be finite"):
        walked(MaskedBackground(), dt=0.0)


def test_after_the_longer_time_everything_becomes_background():
    detector = MaskedBackground(still=StillRules(time=1.6))
    state = detector.initial(frame(0))
    for k in range(80):
        state, found = detector.step(state, frame(k, (60, 50)))
    assert len(found.boxes) == 0
