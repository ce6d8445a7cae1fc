"""The same controllers on the pymunk arm and on a MuJoCo arm. Writes docs/mujoco.md.

python examples/mujoco_comparison.py
"""

from __future__ import annotations

import argparse
import platform
from contextlib import closing
from importlib import metadata
from pathlib import Path

import gymnasium as gym
import joblib
import mujoco_arm
import numpy as np
from numpy.typing import NDArray

import servotrack  # noqa: F401  (registers the environments)
from servotrack.estimators.jacobian import ServoController, ServoMeasurement

Array = NDArray[np.float64]

PAGE = Path(__file__).parents[1] / "docs" / "mujoco.md"
PIXEL_NOISE = 0.5
FIRST_TEST_SEED = 200_000
WORLDS = {
    "pymunk, 2 links": ("pymunk", 2),
    "MuJoCo, 2 links, projected": ("projected", 2),
    "MuJoCo, 2 links, rendered": ("rendered", 2),
    "MuJoCo, 3 links, rendered": ("rendered", 3),
}


def controller(estimator: str) -> ServoController:
    """The same for every world."""
    return ServoController(mujoco_arm.ESTIMATORS[estimator](), max_joint_rate=mujoco_arm.MAX_JOINT_RATE)


def pymunk_errors(estimator: str, seed: int) -> Array:
    """Tracking errors of the scored steps on `UncalibServo-v0`, level 0 with noise, m."""
    env = gym.make("UncalibServo-v0", level=0, pixel_noise=PIXEL_NOISE)
    observation, _ = env.reset(seed=seed)
    loop, state, errors, over = controller(estimator), None, [], False
    while not over:
        measurement = ServoMeasurement(
            observation["joint_angles"],
            observation["features"],
            observation["goal"],
            observation["visible"][0] > 0.5,
            observation["frame_time"][0],
            observation["time"][0],
        )
        state, joint_rate = loop.step(loop.initial(measurement) if state is None else state, measurement)
        action = (joint_rate / env.unwrapped.max_joint_rate).astype(np.float32)
        observation, _, terminated, truncated, info = env.step(action)
        errors.append(info["tracking_error"])
        over = terminated or truncated
    return np.array(errors[mujoco_arm.WARM_UP :])


def steady_error(world: str, estimator: str, run: int) -> float:
    """Mean tracking error after 3 s of one run, mm; infinite where the target was lost for good."""
    kind, joints = WORLDS[world]
    if kind == "pymunk":
        errors = pymunk_errors(estimator, FIRST_TEST_SEED + run)
    else:
        arm = mujoco_arm.PlanarArm(joints, rendered=kind == "rendered", pixel_noise=PIXEL_NOISE, seed=run)
        with closing(arm):
            errors = mujoco_arm.tracking_errors(arm, controller(estimator))
    settled = errors[round(3.0 / mujoco_arm.PERIOD) :]
    return 1e3 * float(settled.mean()) if settled.size else np.inf


def page(runs: int, jobs: int) -> str:
    """The page with the table."""
    cells = [
        (world, estimator)
        for estimator in mujoco_arm.ESTIMATORS
        for world, (_, joints) in WORLDS.items()
        if joints == 2 or estimator not in mujoco_arm.TWO_LINKS_ONLY
    ]
    tasks = [(world, estimator, run) for world, estimator in cells for run in range(runs)]
    errors = joblib.Parallel(n_jobs=jobs)(joblib.delayed(steady_error)(*task) for task in tasks)
    found = dict(zip(cells, np.array(errors).reshape(len(cells), runs), strict=True))
    lines = [f"| estimator | {' | '.join(WORLDS)} |", "|---|" + "---|" * len(WORLDS)]
    for estimator in mujoco_arm.ESTIMATORS:
        shown = [_shown(found.get((world, estimator))) for world in WORLDS]
        lines.append(f"| {estimator} | {' | '.join(shown)} |")
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("servotrack", "mujoco", "pymunk", "numpy"))
    return TEXT.format(
        runs=runs, noise=PIXEL_NOISE, table="\n".join(lines), versions=f"Python {platform.python_version()}, {versions}"
    )


def _shown(errors: Array | None) -> str:
    return "two links only" if errors is None else f"{np.median(errors):.2f} ({errors.min():.2f} to {errors.max():.2f})"


TEXT = """# A MuJoCo arm

`examples/mujoco_arm.py` drives planar MuJoCo arms of two and three links with the estimators and the controller of
`servotrack.estimators.jacobian`, unchanged and with the same settings. A driver for a real robot has the same
interface: measurements in, joint rates out. The camera is MuJoCo's own, at the tool. "rendered": its image is
rendered and the center of mass of the red target found in it. "projected": the target's position is projected through
the camera's pose and field of view. The target follows the ellipse of the paper `unscented_jacobian`, eq. (32), with
{noise} px of noise, and the joints follow a commanded rate with the lag of a velocity servo.

Mean tracking error after 3 s, mm: median over {runs} noise seeds (lowest to highest).

{table}

Written by `python examples/mujoco_comparison.py` with {versions}.

The two-link arm has pymunk's link lengths, camera and joint stops. The three-link arm is redundant: the control law
takes the smallest joint motion and avoids neither its stops at 2.6 rad nor singular poses. The large errors there are
runs in which the arm drifts to a stretched pose and its elbow swings through it at the rate limit.
"""


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="noise seeds per cell (default 10)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    arguments = parser.parse_args()
    if arguments.runs < 1:
        parser.error(f"--runs must be at least 1, got {arguments.runs}")
    if not mujoco_arm.can_render():
        parser.error("the table needs rendering: install libegl1 or libosmesa6")
    PAGE.write_text(page(arguments.runs, arguments.jobs), encoding="utf-8")
    print(PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
