"""The default controller on arms by their makers' tables, with kinematics and a camera that are written here.

Nothing of `servotrack.envs` is used: what serves here serves a world that this package does not know.
"""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.jacobian import AnyArm, ServoController, ServoMeasurement
from servotrack.estimators.jacobian.any_arm import chain_bank

RIGHT = np.pi / 2.0
PERIOD, FOCAL, ROWS, STEPS = 0.05, 600.0, 6, 240
SQUARE = ((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))
# Rows of a, d and alpha. Universal Robots: the joint turns before the link; Franka Emika (after Craig): behind it.
UR5 = (
    (0, 0.089159, RIGHT),
    (-0.425, 0, 0),
    (-0.39225, 0, 0),
    (0, 0.10915, RIGHT),
    (0, 0.09465, -RIGHT),
    (0, 0.0823, 0),
)
PANDA = (
    (0, 0.333, 0),
    (0, 0, -RIGHT),
    (0, 0.316, RIGHT),
    (0.0825, 0, RIGHT),
    (-0.0825, 0.384, -RIGHT),
    (0, 0, RIGHT),
    (0.088, 0, RIGHT),
)
# A hobby arm of the SO-101's lengths (TheRobotStudio, SO-ARM100): base, shoulder, elbow, wrist, roll.
HOBBY = ((0.03, 0.117, -RIGHT), (0.116, 0, 0), (0.135, 0, 0), (0, 0, -RIGHT), (0, 0.16, 0))
READY = {
    "ur5": (0.0, -RIGHT, RIGHT, -RIGHT, -RIGHT, 0.0),
    "panda": (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    "hobby": (0.0, -1.2, 1.5, -1.9, 0.0),
    "scara": (0.3, 0.9, 0.0, -0.4),
    "lift": (0.2, 0.1, -0.8, 1.0, 0.0),
    "gantry": (0.0, 0.0, 0.0, 0.2, -0.3, 0.1),
}
TURNING = ("ur5", "panda", "hobby")
SLIDING = {
    "scara": (True, True, False, True),
    "lift": (False, True, True, True, True),
    "gantry": (False, False, False, True, True, True),
}


def _pose(turn, rise, length, twist):
    """Transforms: turn about z, rise along z, length along x, twist about x. Shape (rows, 4, 4)."""
    turn, rise, length, twist = np.broadcast_arrays(turn, rise, length, twist)
    c, s, ca, sa = np.cos(turn), np.sin(turn), np.cos(twist), np.sin(twist)
    zero, one = np.zeros_like(c), np.ones_like(c)
    flat = [c, -s * ca, s * sa, length * c, s, c * ca, -c * sa, length * s, zero, sa * one, ca * one, rise * one]
    flat += [zero, zero, zero, one]
    return np.stack(flat, axis=-1).reshape(*c.shape, 4, 4)


def tool(arm, joints):
    """Pose of the tool. Shape (rows, 4, 4)."""
    pose = np.tile(np.eye(4), (len(joints), 1, 1))
    none = np.zeros(len(joints))
    if arm == "panda":
        for (length, rise, twist), turn in zip(PANDA, joints.T, strict=True):
            pose = pose @ _pose(none, 0.0, length, twist) @ _pose(turn, rise, 0.0, 0.0)
        return pose @ _pose(none, 0.107, 0.0, 0.0)
    if arm == "scara":
        pose = _pose(joints[:, 0], 0.4, 0.35, 0.0) @ _pose(joints[:, 1], 0.0, 0.3, 2.0 * RIGHT)
        return pose @ _pose(none, joints[:, 2], 0.0, 0.0) @ _pose(joints[:, 3], 0.1, 0.0, 0.0)
    if arm == "lift":
        pose = _pose(joints[:, 1], joints[:, 0], 0.0, RIGHT) @ _pose(joints[:, 2], 0.0, 0.3, 0.0)
        return pose @ _pose(joints[:, 3], 0.0, 0.25, RIGHT) @ _pose(joints[:, 4], 0.1, 0.0, 0.0)
    if arm == "gantry":
        pose = _pose(none, joints[:, 2], joints[:, 0], 0.0)
        pose[:, 1, 3] = joints[:, 1]
        pose = pose @ _pose(joints[:, 3], 0.0, 0.0, RIGHT) @ _pose(joints[:, 4], 0.0, 0.0, -RIGHT)
        return pose @ _pose(joints[:, 5], 0.1, 0.0, 0.0)
    for (length, rise, twist), turn in zip(UR5 if arm == "ur5" else HOBBY, joints.T, strict=True):
        pose = pose @ _pose(turn, rise, length, twist)
    return pose


class ForeignArm:
    """Rows of one arm with a camera of unknown mounting in the hand or in the world, and a board of four points."""

    def __init__(self, arm, camera, seed, noise=0.5, size=1.0, period=PERIOD, points=SQUARE):
        self.arm, self.camera, self.noise, self.size, self.period = arm, camera, noise, size, period
        self.rng = rng = np.random.default_rng(seed)
        n = len(READY[arm])
        self.goal_joints = np.asarray(READY[arm]) + rng.uniform(-0.15, 0.15, (ROWS, n))
        # In view at the start: the hobby arm's board is near.
        far = 0.06 if arm == "hobby" else 0.12
        self.joints = self.goal_joints + rng.uniform(-far, far, (ROWS, n))
        self.homing = rng.uniform(-0.05, 0.05, (ROWS, n))
        side, depth = (0.08, 0.2) if arm == "hobby" else (0.15, 0.45)
        self.board = side * np.array(points) / 2.0
        tilt, roll = rng.uniform(-0.3, 0.3, (ROWS, 2)), rng.uniform(-np.pi, np.pi, ROWS)
        none = np.zeros(ROWS)
        # The camera looks at the middle of the board, turned about its axis by any angle; the board is tilted.
        ahead = (
            _pose(roll, depth, 0.0, 0.0) @ _pose(none, 0.0, 0.0, tilt[:, 0]) @ _pose(tilt[:, 1], 0.0, 0.0, RIGHT / 3)
        )
        self.view = ahead
        self.goal_tool = tool(arm, self.goal_joints)
        self.time, self.sway = 0.0, np.zeros((ROWS, 6))
        self.goal = self.features(self.goal_joints)

    def features(self, joints):
        """Image points of the board. Shape (rows, 8), px."""
        now = tool(self.arm, joints)
        # The displacement of the tool moves the camera over the board, or the board under the camera.
        if self.camera == "hand":
            return self.image(np.linalg.inv(now) @ self.goal_tool @ self.drift() @ self.view)
        return self.image(self.view @ np.linalg.inv(self.goal_tool) @ now)

    def image(self, pose):
        """Image points of a board at a pose before the camera. Shape (rows, 8), px."""
        points = np.einsum("rij,pj->rpi", pose[:, :3, :3], self.board) + pose[:, None, :3, 3]
        image = 320.0 + FOCAL * points[..., :2] / np.maximum(points[..., 2:], 0.02)
        return self.size * image.reshape(len(pose), -1)

    def drift(self):
        """Motion of the board, and of the goal, in 8 s about its amplitudes `sway` in rad and m. Shape (rows, 4, 4)."""
        a, b, c, *shift = (self.sway * np.sin(2.0 * np.pi * self.time / 8.0 + np.arange(6))).T
        none = np.zeros(ROWS)
        pose = _pose(a, 0.0, 0.0, none) @ _pose(none, 0.0, 0.0, b) @ _pose(c, 0.0, 0.0, none)
        pose[:, :3, 3] = np.stack(shift, axis=-1)
        return pose

    def measurement(self, visible=None):
        time = np.full(ROWS, self.time)
        seen = self.features(self.joints)
        seen = seen + self.noise * self.rng.normal(size=seen.shape)
        mask = np.ones((ROWS, len(self.board)), np.bool_) if visible is None else visible
        # With the camera in the hand the image at the goal stays as it is.
        goal = self.goal if self.camera == "hand" else self.image(self.view @ self.drift())
        return ServoMeasurement(self.joints + self.homing, seen, goal, mask, time, time)

    def move(self, rate):
        self.joints = self.joints + self.period * rate
        self.time += self.period

    def tip_error(self):
        """Distance of the tool from its place at the goal. Shape (rows,), m."""
        return np.linalg.norm((tool(self.arm, self.joints) - self.goal_tool @ self.drift())[:, :3, 3], axis=-1)


@pytest.mark.parametrize("camera", ["hand", "world"])
@pytest.mark.parametrize("arm", TURNING)
def test_the_untouched_controller_arrives(arm, camera):
    """Half a pixel of noise, homing errors of 3 degrees, a camera turned by any angle."""
    world, controller, state = ForeignArm(arm, camera, seed=0), ServoController(max_joint_rate=1.0), None
    errors, tips = [], []
    for _ in range(STEPS):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        assert np.abs(rate).max() <= 1.0 + 1e-12
        world.move(rate)
        errors.append(np.abs(world.features(world.joints) - world.goal).mean(axis=-1))
        tips.append(world.tip_error())
    assert np.mean(np.array(errors[-60:]).mean(axis=0) < 5.0) == 1.0
    assert np.median(tips[-1]) < 1e-3


@pytest.mark.parametrize(
    ("size", "period"),
    [
        (3.0, PERIOD),
        (1.0, 0.1),
        pytest.param(0.5, PERIOD, marks=pytest.mark.slow),
        pytest.param(1.0, 1.0 / 30.0, marks=pytest.mark.slow),
        pytest.param(1.0, 1.0 / 60.0, marks=pytest.mark.slow),
    ],
)
def test_neither_pixels_nor_the_rate_of_the_loop_have_to_be_set(size, period):
    """Images of 320 to 1920 columns, and loops of 60 and 10 Hz whose period is not given."""
    world = ForeignArm("hobby", "hand", seed=4, size=size, period=period)
    controller, state, tips = ServoController(max_joint_rate=1.0), None, []
    for _ in range(round(9.0 / max(period, PERIOD))):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.move(rate)
        tips.append(world.tip_error())
    assert np.median(tips[-1]) < 1e-3 / min(size, 1.0)
    assert np.max(np.mean(tips[-30:], axis=0)) < 2e-3 / min(size, 1.0)


@pytest.mark.parametrize(
    ("arm", "camera", "given"),
    [
        ("scara", "hand", False),
        *(
            pytest.param(arm, camera, given, marks=pytest.mark.slow)
            for arm in SLIDING
            for camera in ("hand", "world")
            for given in (True, False)
            if (arm, camera, given) != ("scara", "hand", False)
        ),
    ],
)
def test_joints_that_slide_need_not_be_named(arm, camera, given):
    """A far axis explains a joint that slides; `revolute` may still say which they are."""
    world, state, tips = ForeignArm(arm, camera, seed=7), None, []
    estimator = AnyArm(points=chain_bank(revolute=SLIDING[arm])) if given else AnyArm()
    controller = ServoController(estimator, max_joint_rate=1.0)
    for _ in range(STEPS):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.move(rate)
        tips.append(world.tip_error())
    assert np.max(np.mean(tips[-60:], axis=0)) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["hand", "world"])
@pytest.mark.parametrize("count", [2, 8, 20])
def test_boards_of_few_and_of_many_points(count, camera):
    """Two points leave the pose of the tool open, but are brought to their places."""
    angle = 2.0 * np.pi * np.arange(count) / count
    points = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    world, state, errors, tips = ForeignArm("ur5", camera, seed=11, points=points), None, [], []
    controller = ServoController(max_joint_rate=1.0)
    for _ in range(STEPS):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.move(rate)
        errors.append(np.abs(world.features(world.joints) - world.goal).mean(axis=-1))
        tips.append(world.tip_error())
    assert np.max(np.mean(errors[-60:], axis=0)) < 1.0
    if count > 2:
        assert np.median(tips[-1]) < 1e-3


@pytest.mark.parametrize(("camera", "limit"), [("hand", 4.5e-3), ("world", 1e-3)])
def test_a_goal_that_moves_with_the_board_is_followed(camera, limit):
    """In the hand the image at the goal rests: only what the chain does not explain shows that the board moves."""
    world, controller, state = ForeignArm("panda", camera, seed=2), ServoController(max_joint_rate=1.0), None
    world.sway[:] = np.random.default_rng(3).choice([-1.0, 1.0], (ROWS, 6)) * (0.02, 0.02, 0.02, 0.01, 0.01, 0.01)
    tips = []
    for _ in range(600):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.move(rate)
        tips.append(world.tip_error())
    assert np.median(np.mean(tips[-300:], axis=0)) < limit


def test_points_behind_the_camera_hold_the_arm():
    """A board that nobody sees: after the moves that explore, the arm rests, and nothing is invented."""
    world, controller, state = ForeignArm("ur5", "hand", seed=1), ServoController(max_joint_rate=1.0), None
    for step in range(120):
        seen = world.measurement(np.full((ROWS, 4), step < 60))
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.move(rate)
    assert np.isfinite(rate).all()
    assert np.abs(rate).max() < 0.05
