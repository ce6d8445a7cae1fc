"""Drive a robot that is not ours: a planar MuJoCo arm of two or three links with a camera at its tool.

    python examples/mujoco_arm.py --links 3 --estimator kf

The estimators and the controller are servotrack's, unchanged, and no Gymnasium is involved: `PlanarArm` only has to
hand over a `ServoMeasurement` and take joint rates, as a driver of a real robot would. The features come from MuJoCo's
own camera: the image is rendered and the target found in it by its color, or, where no OpenGL is available, its
position is projected with the camera's pose and field of view.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.jacobian import (
    BroydenJacobian,
    KalmanJacobian,
    LiftedKalman,
    ParticleJacobian,
    RecursiveLeastSquares,
    ServoController,
    ServoMeasurement,
    UnscentedJacobian,
)

Array = NDArray[np.float64]

PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)"


def working_gl() -> str:
    """The first way to render without a display that works here, "disable" if none does."""
    for backend in ("egl", "osmesa"):
        # In a process of its own: MuJoCo takes the choice at import, and a missing driver may end the process.
        probe = subprocess.run(
            [sys.executable, "-c", PROBE], env={**os.environ, "MUJOCO_GL": backend}, capture_output=True, check=False
        )
        if probe.returncode == 0:
            return backend
    return "disable"


if sys.platform == "linux" and not {"MUJOCO_GL", "DISPLAY"} & os.environ.keys():
    os.environ["MUJOCO_GL"] = working_gl()

import mujoco  # noqa: E402  (after the choice of how to render)

PERIOD = 0.05
TIMESTEP = 0.005
IMAGE = 480
FOCAL = 160.0
HEIGHT = 0.35
MAX_JOINT_RATE = 2.0
WARM_UP = 8

LINKS: dict[int, tuple[float, ...]] = {2: (0.5, 0.5), 3: (0.4, 0.35, 0.25)}
START: dict[int, tuple[float, ...]] = {2: (0.0, np.pi / 2), 3: (0.0, np.pi / 3, np.pi / 6)}
STOPS: dict[int, tuple[tuple[float, float], ...]] = {
    2: ((-np.pi / 2, np.pi / 2), (0.0, np.pi)),
    3: ((-2.6, 2.6), (-2.6, 2.6), (-2.6, 2.6)),
}

ESTIMATORS: dict[str, Callable[[], Any]] = {
    "kf": KalmanJacobian,
    "ukf": UnscentedJacobian,
    "broyden": BroydenJacobian,
    "rls": RecursiveLeastSquares,
    "pf": ParticleJacobian,
    "lifted-kf": LiftedKalman,
}
TWO_LINKS_ONLY = {"lifted-kf"}


def paper_target(time: float) -> Array:
    """The ellipse of Zhang 2011, eq. (32), at rest before time 0. Shape (2,), m."""
    phase = max(time, 0.0)
    return np.array([0.5 + 0.3 * np.cos(phase), 0.5 + 0.2 * np.sin(phase)])


def model_xml(links: tuple[float, ...]) -> str:
    """The arm, its camera and the target in MuJoCo's format.

    The joints turn about vertical axes; the camera hangs `HEIGHT` above the floor, looks straight down and has the
    tool's axes. Velocity servos drive the joints; they follow a command within some 15 ms.
    """
    tool = f'<site name="tool" pos="{links[-1]} 0 0"/><camera name="eye" pos="{links[-1]} 0 -0.1" fovy="{FOVY}"/>'
    arm = tool
    for index in reversed(range(len(links))):
        base = f"{links[index - 1]} 0 0" if index else f"0 0 {HEIGHT + 0.1}"
        arm = (
            f'<body pos="{base}"><joint name="joint{index}" axis="0 0 1" damping="0.5" armature="0.02"/>'
            f'<geom type="capsule" fromto="0 0 0 {links[index]} 0 0" size="0.02" mass="1"/>{arm}</body>'
        )
    servos = "".join(f'<velocity joint="joint{index}" kv="100"/>' for index in range(len(links)))
    return f"""
    <mujoco>
      <option timestep="{TIMESTEP}" integrator="implicitfast"/>
      <visual><global offwidth="{IMAGE}" offheight="{IMAGE}"/></visual>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody>
        <light pos="0.5 0.5 3" dir="0 0 -1" castshadow="false"/>
        <geom type="plane" size="3 3 0.1" pos="0 0 -0.01" rgba="0.45 0.5 0.5 1"/>
        <body name="target" mocap="true">
          <geom type="cylinder" size="0.02 0.001" pos="0 0 -0.001" rgba="0.9 0.05 0.05 1"/>
        </body>
        {arm}
      </worldbody>
      <actuator>{servos}</actuator>
    </mujoco>"""


FOVY = float(np.degrees(2 * np.arctan(IMAGE / 2 / FOCAL)))


class PlanarArm:
    """The robot's driver: measurements out, joint rates in.

    Args:
        joints: 2 or 3.
        rendered: Find the target in rendered images; else project its position.
        pixel_noise: Standard deviation of noise added to the features, px.
        seed: Seed of that noise.

    Raises:
        ValueError: Another number of joints, or negative noise.
        RuntimeError: `rendered` where OpenGL is not available.
    """

    def __init__(self, joints: int = 2, *, rendered: bool = True, pixel_noise: float = 0.0, seed: int = 0) -> None:
        if joints not in LINKS:
            raise ValueError(f"joints must be one of {sorted(LINKS)}, got {joints}")
        if not 0.0 <= pixel_noise < np.inf:
            raise ValueError(f"pixel_noise must be finite and >= 0 px, got {pixel_noise}")
        self.joints = joints
        self.model = mujoco.MjModel.from_xml_string(model_xml(LINKS[joints]))
        self.data = mujoco.MjData(self.model)
        self.renderer = make_renderer(self.model) if rendered else None
        self.pixel_noise = pixel_noise
        self._rng = np.random.default_rng(seed)
        self._time = -WARM_UP * PERIOD
        self.data.qpos[:] = START[joints]
        self._goal = np.full(2, IMAGE / 2)
        self._features, self._frame_time = self._goal.copy(), self._time

    def measure(self) -> ServoMeasurement:
        """Joint angles and the target's image now."""
        self.data.mocap_pos[0, :2] = paper_target(self._time)
        mujoco.mj_forward(self.model, self.data)
        seen = self._found() if self.renderer else self._projected()
        if seen is not None:
            self._features = seen + self.pixel_noise * self._rng.standard_normal(2)
            self._frame_time = self._time
        return ServoMeasurement(
            joint_angles=self.data.qpos.copy(),
            features=self._features.copy(),
            goal=self._goal.copy(),
            visible=np.array(seen is not None),
            frame_time=np.array(self._frame_time),
            time=np.array(self._time),
        )

    def move(self, joint_rate: Array) -> None:
        """Command joint rates, shape (n,), rad/s, for one control period."""
        low, high = (np.array(STOPS[self.joints]).T - self.data.qpos) / PERIOD
        # As a robot's own controller does: no joint is driven into its stop.
        limited = np.clip(joint_rate, np.minimum(low, 0.0), np.maximum(high, 0.0))
        self.data.ctrl[:] = np.clip(limited, -MAX_JOINT_RATE, MAX_JOINT_RATE)
        for _ in range(round(PERIOD / TIMESTEP)):
            mujoco.mj_step(self.model, self.data)
        self._time += PERIOD

    def close(self) -> None:
        """Give the renderer's memory back."""
        if self.renderer:
            self.renderer.close()

    @property
    def tracking_error(self) -> float:
        """Distance from tool to target in the plane now, m."""
        mujoco.mj_kinematics(self.model, self.data)
        return float(np.hypot(*(paper_target(self._time) - self.data.site("tool").xpos[:2])))

    def _found(self) -> Array | None:
        """Center of the red pixels of the camera's image, None where there are none or they touch the border."""
        assert self.renderer is not None
        self.renderer.update_scene(self.data, camera="eye")
        image = self.renderer.render().astype(np.int16)
        red = np.clip(image[..., 0] - np.maximum(image[..., 1], image[..., 2]) - 30, 0, None)
        rows, columns = np.nonzero(red)
        if rows.size == 0 or min(rows.min(), columns.min()) == 0 or max(rows.max(), columns.max()) == IMAGE - 1:
            return None
        weights = red[rows, columns]
        return np.array([np.average(columns, weights=weights), np.average(rows, weights=weights)]) + 0.5

    def _projected(self) -> Array | None:
        """The target through the camera's pose and field of view, None where it lies outside the image."""
        eye = self.data.camera("eye")
        x, y, z = eye.xmat.reshape(3, 3).T @ (self.data.mocap_pos[0] - eye.xpos)
        image = IMAGE / 2 + FOCAL * np.array([x / -z, -y / -z])
        return image if ((image >= 0) & (image <= IMAGE)).all() else None


def make_renderer(model: Any) -> Any:
    """MuJoCo's renderer.

    Raises:
        RuntimeError: OpenGL is not available; says what to do.
    """
    try:
        return mujoco.Renderer(model, IMAGE, IMAGE)
    except Exception as error:  # MuJoCo raises different types for different backends
        raise RuntimeError(
            f"cannot render with MUJOCO_GL={os.environ.get('MUJOCO_GL')!r} ({error}); install libegl1 or libosmesa6, "
            "or use projected features"
        ) from error


def can_render() -> bool:
    """Return True if rendered features are available here."""
    return os.environ.get("MUJOCO_GL") != "disable"


def tracking_errors(arm: PlanarArm, controller: ServoController, steps: int = 252) -> Array:
    """Distances from tool to target after each of `steps` control periods that follow the warm-up, m."""
    measurement = arm.measure()
    state = controller.initial(measurement)
    errors = []
    for _ in range(WARM_UP + steps):
        state, joint_rate = controller.step(state, measurement)
        arm.move(joint_rate)
        errors.append(arm.tracking_error)
        measurement = arm.measure()
    return np.array(errors[WARM_UP:])


def main() -> None:
    """Follow the target for two rounds and print the error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--links", type=int, choices=sorted(LINKS), default=2)
    parser.add_argument("--estimator", choices=ESTIMATORS, default="kf")
    parser.add_argument("--pixel-noise", type=float, default=0.0, help="px")
    parser.add_argument("--projected", action="store_true", help="do not render")
    arguments = parser.parse_args()
    if arguments.links != 2 and arguments.estimator in TWO_LINKS_ONLY:
        parser.error(f"--estimator {arguments.estimator} is made for two links")
    rendered = can_render() and not arguments.projected
    arm = PlanarArm(arguments.links, rendered=rendered, pixel_noise=arguments.pixel_noise)
    errors = tracking_errors(arm, ServoController(ESTIMATORS[arguments.estimator](), max_joint_rate=MAX_JOINT_RATE))
    steady = 1e3 * errors[round(3.0 / PERIOD) :]
    print(
        f"{'rendered' if rendered else 'projected'} features; after 3 s: mean {steady.mean():.2f} mm, "
        f"95 % below {np.percentile(steady, 95):.2f} mm"
    )


if __name__ == "__main__":
    main()
