"""Exposure that changes for the whole picture, and changes that are no exposure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.estimators.detect import MaskedBackground
from servotrack.estimators.detect.exposure import ExposureRules, exposure_line


def ground(seed: int = 0) -> np.ndarray:
    """Blurred texture of 60 to 160 gray levels."""
    texture = cv2.blur(np.random.default_rng(seed).uniform(0, 255, (120, 160, 3)), (9, 9))
    return 60.0 + 100.0 * (texture - texture.min()) / np.ptp(texture)


def frame(picture: np.ndarray, noise: int = 0) -> np.ndarray:
    return np.clip(picture + np.random.default_rng(noise).normal(0.0, 2.0, picture.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("gain", "offset"), [(1.3, 0.0), (0.7, 0.0), (1.0, 30.0), (1.2, -40.0)])
def test_gain_and_offset_are_found_behind_people(gain, offset):
    scene, rules = ground(), ExposureRules()
    seen = gain * scene + offset
    seen[20:110, 40:90] = 20.0  # a quarter of the picture is something else
    found = exposure_line(frame(seen), frame(scene, 1), 30.0, rules)
    assert np.abs(found[0] * scene + found[1] - (gain * scene + offset)).mean() < 3.0


def test_people_and_lights_in_a_part_are_no_exposure():
    scene, rules = ground(), ExposureRules()
    people, lamp = scene.copy(), scene.copy()
    people[20:110, 40:90] = 220.0
    lamp[:, :70] += 60.0
    for seen in (scene, people, lamp):
        assert exposure_line(frame(seen), frame(scene, 1), 30.0, rules) == (1.0, 0.0)
    # Too dark to see a line.
    assert exposure_line(frame(0.2 * scene), frame(0.1 * scene, 1), 30.0, rules) == (1.0, 0.0)


@pytest.mark.parametrize("gray", [False, True])
def test_a_camera_that_changes_its_exposure_invents_nobody(gray):
    scene, detector, counts = ground(), MaskedBackground(), []
    state = None
    for k in range(40):
        seen = scene * (1.0 + 0.3 * np.sin(k / 5.0))
        if k >= 10:
            seen[40:100, 2 * k : 2 * k + 20] = 10.0
        image = frame(seen, k)
        image = image[..., 0].copy() if gray else image
        state = detector.initial(image) if state is None else state
        state, found = detector.step(state, image)
        counts.append(len(found.boxes))
    assert max(counts[:10]) == 0 and np.mean(np.array(counts[12:]) == 1) > 0.9
