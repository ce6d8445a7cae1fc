"""The test rig itself: its Jacobian is that of its pixels, and its faults are the ones asked for."""

from __future__ import annotations

import numpy as np
import pytest
from kinematic_world import KinematicWorld, closed_loop, ellipse_target, paper_target

ROWS = 5


def world(**options) -> KinematicWorld:
    target = ellipse_target(np.random.default_rng(0), ROWS)
    return KinematicWorld(target, rows=ROWS, mounting=np.linspace(-3, 3, ROWS), links=(0.4, 0.6), **options)


def test_jacobian_is_that_of_differences():
    arms, step = world(), 1e-6
    arms.reset()
    for _ in range(5):
        arms.step(np.full((ROWS, 2), 0.5))
    jacobian, joints, time = arms.jacobian, arms.joints.copy(), arms.time
    for column in range(3):
        ends = []
        for sign in (1, -1):
            arms.joints, arms.time = joints.copy(), time
            if column < 2:
                arms.joints[:, column] += sign * step
            else:
                arms.time += sign * step
            ends.append(arms.error)
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), jacobian[..., column], rtol=1e-5, atol=1e-3)


def test_oracle_follows():
    arms = KinematicWorld(paper_target, rows=1)

    def oracle(_):
        wanted = -0.7 * arms.error - arms.jacobian[..., 2] * arms.period
        return np.linalg.solve(arms.jacobian[..., :2], wanted[..., None])[..., 0] / arms.period

    assert closed_loop(oracle, arms)[-126:].mean() < 1e-3


@pytest.mark.parametrize("latency", [0, 1, 2])
@pytest.mark.parametrize("stamped", [True, False])
def test_frames_are_as_old_as_asked(latency, stamped):
    arms, past = world(latency=latency, stamped=stamped), []
    arms.reset()
    for _ in range(10):
        past.append(arms.error)
        measurement = arms.step(np.full((ROWS, 2), 0.3))
    past.append(arms.error)
    np.testing.assert_allclose(measurement.features - measurement.goal, past[-1 - latency], atol=1e-9)
    np.testing.assert_allclose(measurement.time - measurement.frame_time, latency * 0.05 * stamped, atol=1e-12)


def test_dropped_frames_repeat_the_last_with_its_stamp():
    arms = world(drop_rate=0.5)
    before = arms.reset()
    lost = 0
    for _ in range(40):
        now = arms.step(np.zeros((ROWS, 2)))
        np.testing.assert_array_equal(now.features[~now.visible], before.features[~now.visible])
        np.testing.assert_array_equal(now.frame_time[~now.visible], before.frame_time[~now.visible])
        before, lost = now, lost + (~now.visible).sum()
    assert 60 <= lost <= 140
