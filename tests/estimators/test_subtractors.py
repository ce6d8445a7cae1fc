"""MOG2 and KNN behind the detectors' interface."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder, KNNBackground, MOG2Background

BOTH = [MOG2Background, KNNBackground]
RNG = np.random.default_rng(0)
FLOOR = RNG.uniform(90.0, 150.0, (96, 128, 3))


def frame(person=None, light=0.0):
    picture = FLOOR + RNG.normal(0.0, 3.0, FLOOR.shape) + light
    if person is not None:
        picture[30:70, person : person + 15] = (220.0, 30.0, 30.0)
    return np.clip(picture, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", BOTH)
def test_a_walker_is_found_where_he_is(kind):
    detector = kind(blobs=BlobFinder(split=False))
    state = detector.initial([frame() for _ in range(30)])
    for x in range(10, 90, 4):
        state, found = detector.step(state, frame(x))
        np.testing.assert_allclose(found.boxes, [(x, 30, 15, 40)], atol=3.0)
        assert found.features[0] @ found.features[0] == pytest.approx(1.0)
    assert state.frames == 20


@pytest.mark.parametrize("kind", BOTH)
def test_a_step_of_light_is_learned_in_the_end(kind):
    detector = kind(history=100)
    state = detector.initial([frame() for _ in range(30)])
    shares = []
    for _ in range(150):
        state, _found = detector.step(state, frame(light=60.0))
        shares.append(np.count_nonzero(state.mask) / state.mask.size)
    assert shares[0] > 0.9
    assert max(shares[-10:]) < 0.01


@pytest.mark.parametrize("kind", BOTH)
def test_gray_frames(kind):
    detector = kind()
    state = detector.initial([frame()[..., 0] for _ in range(30)])
    _, found = detector.step(state, frame(50)[..., 0])
    assert len(found.boxes) == 1


@pytest.mark.parametrize("kind", BOTH)
def test_a_state_that_is_used_up_says_so(kind):
    detector = kind()
    state = detector.initial(frame())
    detector.step(state, frame())
    with pytest.raises(ValueError, match="state is of frame 0, but its OpenCV model has learned up to frame 1"):
        detector.step(state, frame())


@pytest.mark.parametrize("kind", BOTH)
def test_bad_frames_do_not_use_the_state_up(kind):
    detector = kind()
    state = detector.initial(frame())
    for bad, match in ((frame()[:50], "must have the shape"), (frame() / 255.0, "must be uint8"), (None, "uint8")):
        with pytest.raises(ValueError, match=match):
            detector.step(state, bad)
    detector.step(state, frame())
    with pytest.raises(ValueError, match="at least one frame"):
        detector.initial([])


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize(("arguments", "match"), [({"history": 0}, "history"), ({"threshold": -1.0}, "threshold")])
def test_bad_parameters_are_named(kind, arguments, match):
    with pytest.raises(ValueError, match=match):
        kind(**arguments)
