"""Steps and frames per second of the servo environments and servos, beside MuJoCo's Reacher-v5 and gym-pusht."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from servotrack.baselines.speed.rates import Subject

STEPPING = Path(__file__).with_name("stepping.py")
RESET_TIME = 60e-6
"""Time that a reset of one arm may take, s."""
JACOBIAN_PROCESS = Path(__file__).with_name("jacobian_process.py")
SERVO_PROCESS = Path(__file__).with_name("servo_process.py")


def stepping_command(
    env_id: str,
    num_envs: int = 0,
    module: str = "servotrack",
    mode: str = "vector_entry_point",
    silent: bool = False,
    resets: bool = False,
    **kwargs: Any,
) -> tuple[str, ...]:
    """Return the command that measures steps of an environment, or its frames if `render_mode` is given.

    Args:
        env_id: Gymnasium id.
        num_envs: Size of the vector environment; 0 for a single environment.
        module: Module that registers the id.
        mode: Vectorization mode.
        silent: Step with actions of zeros instead of random ones.
        resets: Measure resets instead of steps.
        **kwargs: Arguments of the environment.
    """
    counts = "frames" if "render_mode" in kwargs else "silent" if silent else "resets" if resets else "steps"
    job = {"module": module, "env_id": env_id, "kwargs": kwargs, "num_envs": num_envs, "mode": mode, "counts": counts}
    return (str(STEPPING), json.dumps(job))


def subjects(pusht_python: str | None) -> list[Subject]:
    """Return the rows of the table.

    Args:
        pusht_python: Interpreter of a virtual environment with gym-pusht, which needs an older pymunk than ours; None
            if it is missing.
    """
    reacher, reacher64 = "Reacher-v5", "Reacher-v5, SyncVectorEnv, N = 64"
    state, pixels = "gym-pusht, state", "gym-pusht, pixels 96 x 96"
    servo, serial, crowd = "UncalibServo-v0", "UncalibServo3D-v0", "PedestrianServo-v0"
    images, clutter = "UncalibServoPixels-v0", "ClutterTracking-v0"
    many, arm = f"{servo}, level 3, N = 1024", "7 joints, 4 points"
    return [
        Subject(f"{servo}, level 0", stepping_command(servo, level=0), 20_000.0, {state: 6.0, reacher: 0.7}),
        Subject(f"{servo}, level 3", stepping_command(servo, level=3)),
        Subject(f"{servo}, level 0, N = 64", stepping_command(servo, 64, level=0), 80_000.0, {reacher64: 3.0}),
        Subject(f"{servo}, level 0, N = 1024", stepping_command(servo, 1024, level=0), 1_000_000.0, {reacher64: 3.0}),
        Subject(
            f"{servo}, level 3, compiled engine",
            stepping_command(servo, level=3, engine="compiled"),
            60_000.0,
            {reacher: 2.0},
        ),
        Subject(f"{servo}, level 3, N = 64", stepping_command(servo, 64, level=3), 400_000.0),
        Subject(many, stepping_command(servo, 1024, level=3), 800_000.0),
        Subject(f"{many}, two threads", stepping_command(servo, 1024, level=3, threads=2), ratios={many: 1.7}),
        Subject(
            f"{servo}, level 3, N = 64, resets of one arm",
            stepping_command(servo, 64, resets=True, level=3),
            1.0 / RESET_TIME,
        ),
        Subject(f"{images}, level 0, 96 x 96", stepping_command(images, level=0), 5_000.0, {pixels: 8.0}),
        Subject(f"{images}, level 3, 96 x 96", stepping_command(images, level=3)),
        Subject(
            f"{images}, level 0, 96 x 96, compiled engine",
            stepping_command(images, level=0, engine="compiled"),
            10_000.0,
        ),
        Subject(f"{images}, level 0, 96 x 96, N = 64", stepping_command(images, 64, level=0), 20_000.0),
        Subject(f"{serial}, level 2", stepping_command(serial, level=2)),
        Subject(f"{serial}, level 2, N = 1024", stepping_command(serial, 1024, level=2), 300_000.0),
        Subject(f"`ServoController()`, {arm}, steps", (str(SERVO_PROCESS), "controller", "4"), 3_333.0),
        Subject("`ServoController()`, 7 joints, 16 points, steps", (str(SERVO_PROCESS), "controller", "16")),
        Subject(f"`ChainJacobian()`, {arm}, steps", (str(SERVO_PROCESS), "chain", "4")),
        Subject(f"`AdaptiveKalmanJacobian()`, {arm}, steps", (str(SERVO_PROCESS), "adaptive", "4")),
        Subject(f"{crowd}, level 2, detections", stepping_command(crowd, level=2), 10_000.0),
        Subject(f"{crowd}, level 2, detections, N = 64", stepping_command(crowd, 64, level=2), 120_000.0),
        Subject(
            f"{crowd}, level 2, pixels 96 x 96",
            stepping_command(crowd, level=2, observation="pixels", image_size=96),
            2_000.0,
        ),
        Subject(f"{servo}, frames of rgb_array", stepping_command(servo, level=0, render_mode="rgb_array"), 1_500.0),
        Subject(f"{clutter}, level 0, N = 64", stepping_command(clutter, 64, level=0), 81_000.0),
        Subject("Kalman estimator, batch of 1024, updates", (str(JACOBIAN_PROCESS), "1024"), 1_000_000.0),
        _reacher(reacher),
        _reacher(reacher64, 64),
        _pusht(state, "state", pusht_python),
        _pusht(pixels, "pixels", pusht_python),
    ]


def _reacher(name: str, num_envs: int = 0) -> Subject:
    command = stepping_command("Reacher-v5", num_envs, module="mujoco", mode="sync")
    return Subject(name, command, remedy="install the extra: pip install 'servotrack[mujoco]'")


def _pusht(name: str, obs_type: str, python: str | None) -> Subject:
    command = stepping_command("gym_pusht/PushT-v0", module="gym_pusht", obs_type=obs_type)
    remedy = "make a virtual environment .venv-pusht with gym-pusht and 'pymunk<7'"
    return Subject(name, command, python=python, remedy=remedy)
