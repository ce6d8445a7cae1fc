"""Experiments of Zhang (2011): positioning, tracking, and the equality of its unscented filter and a Kalman filter.

The paper gives no filter parameters. We assume process variance 31.6, measurement variance 100, P0 = 100 I, gain 0.7
and a joint rate limit of 5 rad/s for all algorithms. J_theta(0) comes from small moves before the episode, as in the
paper.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from servotrack.baselines.agents.servo.anchors import FixedJacobian, OracleJacobian
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo, servo_measurement
from servotrack.baselines.evaluation.servo_scores import servo_errors
from servotrack.envs.wrappers import PrivilegedObservation
from servotrack.estimators.jacobian import (
    Excitation,
    JacobianEstimator,
    JacobianPrior,
    KalmanJacobian,
    ParticleJacobian,
    Proportional,
    RandomWalk,
    ServoController,
    ServoMeasurement,
    UnscentedJacobian,
)
from servotrack.estimators.types import Array

TRACKING, POSITIONING = "UncalibServo-v0", "UncalibServoReach-v0"
PROCESS_VARIANCE, MEASUREMENT_VARIANCE, INITIAL_VARIANCE = 31.6, 100.0, 100.0


class Variances(NamedTuple):
    """Noise variances of the filters.

    Attributes:
        process: Variance of the change of an entry of the Jacobian per step. Larger values follow new frames faster.
        measurement: Variance of a change of a feature, px^2. Larger values average more frames.
    """

    process: float = PROCESS_VARIANCE
    measurement: float = MEASUREMENT_VARIANCE


ASSUMED_VARIANCES = Variances()
STUDENT_FREEDOM = 3.0
"""Degrees of freedom of the particle filter's likelihood for heavy tails."""
GAIN = 0.7
WORLD: Mapping[str, Any] = {"level": 0, "max_joint_rate": 5.0}
PROBE = 0.05
"""Size of the exploratory moves before the episode, rad."""
PERIOD = 0.05
"""Control period, s."""
ARRIVAL_DISTANCE = 0.010
"""Tracking error below which positioning counts as done, m."""

PAPER_POSITIONING_SECONDS = {"KF": 0.19, "PF": 0.68, "UKF": 0.38}
"""Times of the paper's table 1, s."""
PAPER_TRACKING_ERROR = {"KF": 0.0186, "PF": 0.0170, "UKF": 0.0117}
PAPER_TRACKING_SECONDS = {"KF": 0.279, "PF": 1.964, "UKF": 0.632}
"""Errors, m, and times, s, of the paper's table 2."""


@dataclass(frozen=True)
class Run:
    """Record of one episode.

    Attributes:
        tool: Tool positions, the first at the reset. Shape (length + 1, 2), m.
        target: Target positions. Shape (length + 1, 2), m.
        error: Tracking errors after each step. Shape (length,), m.
        transient: Mean error of the first 126 samples, m.
        steady: Mean error for t > 3 s, m.
        seconds: Processor time of the agent over the episode, s.
    """

    tool: Array
    target: Array
    error: Array
    transient: float
    steady: float
    seconds: float

    @property
    def arrival(self) -> float:
        """Time from which the error stays below `ARRIVAL_DISTANCE`, s; infinite if it never does."""
        above = np.flatnonzero(self.error >= ARRIVAL_DISTANCE)
        if above.size and above[-1] == self.error.size - 1:
            return math.inf
        return PERIOD * (1 + (int(above[-1]) + 1 if above.size else 0))


def estimator(
    algorithm: str, process_scale: float = 1.0, seed: int = 0, variances: Variances = ASSUMED_VARIANCES
) -> JacobianEstimator:
    """Return an algorithm of the paper.

    Args:
        algorithm: "KF", "PF", "UKF", "UKF as printed", "PF, Student-t" (likelihood with heavy tails), "KF without J_t"
            (J_theta alone is estimated), or "fixed" for J_theta(0) that is never updated.
        process_scale: Factor on the process variance. Larger values follow new measurements faster.
        seed: Seed of the particles.
        variances: Variances of the noises, which the paper does not give.

    Raises:
        ValueError: Unknown algorithm.
    """
    deviation = math.sqrt(variances.process * process_scale)
    spread = math.sqrt(INITIAL_VARIANCE)
    common: dict[str, Any] = {
        "walk": RandomWalk(deviation, deviation),
        "measurement_noise": math.sqrt(variances.measurement),
        "prior": JacobianPrior(spread, spread),
    }
    if algorithm == "KF":
        return KalmanJacobian(**common)
    if algorithm == "KF without J_t":
        # A spread of nearly 0 keeps J_t at its prior mean, 0.
        return KalmanJacobian(
            **{**common, "walk": RandomWalk(deviation, 0.0), "prior": JacobianPrior(spread, 1e-6 * spread)}
        )
    if algorithm == "PF":
        return ParticleJacobian(**common, seed=seed)
    if algorithm == "PF, Student-t":
        return ParticleJacobian(**common, seed=seed, degrees_of_freedom=STUDENT_FREEDOM)
    if algorithm in ("UKF", "UKF as printed"):
        return UnscentedJacobian(**common, as_printed=algorithm != "UKF")
    if algorithm == "fixed":
        return FixedJacobian(KalmanJacobian(**common), learning_steps=0)
    raise ValueError(
        f"algorithm must be fixed, KF, KF without J_t, PF, 'PF, Student-t', UKF or 'UKF as printed', got {algorithm!r}"
    )


def initial_jacobian(env_id: str, world: Mapping[str, Any], seed: int) -> tuple[tuple[float, ...], ...]:
    """Return J(0) as nested tuples (m, n + 1): J_theta(0) from four small moves before a target at rest, J_t(0) = 0."""
    env = gym.make(env_id, **{**world, "warmup": 8})
    try:
        observation, _ = env.reset(seed=seed)
        limit = env.unwrapped.max_joint_rate  # type: ignore[attr-defined]
        joints = observation["joint_angles"].size
        turns, changes = [], []
        for move in (
            PROBE / PERIOD / limit * np.repeat(np.eye(joints), 2, axis=0) * np.tile([[1.0], [-1.0]], (joints, 1))
        ):
            moved, *_ = env.step(move.astype(np.float32))
            turns.append(moved["joint_angles"] - observation["joint_angles"])
            changes.append(moved["features"] - observation["features"])
            observation = moved
    finally:
        env.close()
    # Motors stop with a delay, so that every move turns both joints; least squares separates them.
    by_joints = np.linalg.lstsq(np.array(turns), np.array(changes), rcond=None)[0].T
    jacobian = np.column_stack([by_joints, np.zeros(len(by_joints))])
    return tuple(tuple(row) for row in jacobian.tolist())


def servo(algorithm: JacobianEstimator, jacobian: tuple[tuple[float, ...], ...]) -> JacobianServo:
    """Return the paper's servo: proportional law, without exploratory moves in the episode and without supervisor."""
    limit = float(WORLD["max_joint_rate"])
    return JacobianServo(
        ServoController(_starting_from(algorithm, jacobian), Proportional(GAIN), Excitation(steps=0), None, limit)
    )


def _starting_from(algorithm: Any, jacobian: tuple[tuple[float, ...], ...]) -> Any:
    """Copy of an estimator whose prior mean is `jacobian`."""
    if isinstance(algorithm, FixedJacobian):
        return replace(algorithm, learner=_starting_from(algorithm.learner, jacobian))
    return replace(algorithm, prior=replace(algorithm.prior, mean=jacobian))


def run(
    env_id: str,
    algorithm: JacobianEstimator,
    seed: int,
    world: Mapping[str, Any] = WORLD,
    jacobian: tuple[tuple[float, ...], ...] | None = None,
) -> Run:
    """Run one episode of an algorithm, unbatched.

    Args:
        env_id: `TRACKING` or `POSITIONING`.
        algorithm: Estimator from `estimator`.
        seed: Seed of the environment.
        world: Arguments of the environment.
        jacobian: Initial Jacobian; None: learned before the episode in front of its own target, see
            `initial_jacobian`.
    """
    agent = servo(algorithm, initial_jacobian(env_id, world, seed) if jacobian is None else jacobian)
    env = gym.make(env_id, **{**world, "warmup": 0})
    try:
        observation, info = env.reset(seed=seed)
        max_steps = env.unwrapped.config.horizon  # type: ignore[attr-defined]
        tool, target = [info["truth"]["tool"]], [info["truth"]["target"]]
        times, errors, seconds = [], [], 0.0
        state: Any = None
        over = False
        while not over:
            begin = time.process_time()
            action, state = agent.predict(observation, state)
            seconds += time.process_time() - begin
            observation, _, terminated, truncated, info = env.step(action)
            tool.append(info["truth"]["tool"])
            target.append(info["truth"]["target"])
            times.append(float(observation["time"][0]))
            errors.append(info["tracking_error"])
            over = terminated or truncated
    finally:
        env.close()
    error = np.array(errors)
    summary = servo_errors(np.array(times), error, 0.0, max_steps)
    return Run(np.array(tool), np.array(target), error, summary["transient"], summary["steady"], seconds)


def open_loop_difference(kappas: Sequence[float], seed: int, steps: int = 1000) -> dict[float, float]:
    """Return the largest difference between the Jacobians of UKF and KF on one recorded stream of measurements.

    Args:
        kappas: Values of kappa of the unscented transform.
        seed: Seed of the environment.
        steps: Length of the stream.

    Returns:
        For each kappa max |J_UKF - J_KF| over max |J_KF|, over all steps and entries.
    """
    world = {**WORLD, "horizon": steps}
    kalman = estimator("KF")
    jacobian = initial_jacobian(TRACKING, world, seed)
    stream = _record(servo(kalman, jacobian), seed, world)
    reference = _jacobians(_starting_from(kalman, jacobian), stream)
    differences = {}
    for kappa in kappas:
        unscented: Any = estimator("UKF")
        unscented = _starting_from(replace(unscented, kappa=kappa), jacobian)
        found = _jacobians(unscented, stream)
        differences[kappa] = float(np.abs(found - reference).max() / np.abs(reference).max())
    return differences


def closed_loop_difference(seed: int, steps: int = 1000) -> float:
    """Return the largest distance between the tool paths of UKF and KF, each in its own closed loop, m."""
    world = {**WORLD, "horizon": steps}
    paths = [run(TRACKING, estimator(name), seed, world).tool for name in ("KF", "UKF")]
    return float(np.abs(paths[0] - paths[1]).max())


def jacobian_errors(
    names: Sequence[str], variances: Variances, seed: int, world: Mapping[str, Any]
) -> dict[str, Array]:
    """Return the errors of the Jacobians of several algorithms on one recorded stream of measurements.

    The servo that moves the arm has the analytic Jacobian, so that no estimator shapes the data.

    Args:
        names: Algorithms.
        variances: Variances of the noises.
        seed: Seed of the environment.
        world: Arguments of the environment.

    Returns:
        For each algorithm the root mean square error over the stream relative to the analytic Jacobian's norm, of
        J_theta and of J_t. Shape (2,).
    """
    jacobian = initial_jacobian(TRACKING, world, seed)
    limit = float(world["max_joint_rate"])
    driver = JacobianServo(ServoController(OracleJacobian(), Proportional(GAIN), Excitation(steps=0), None, limit))
    truths: list[Array] = []
    stream = _record(driver, seed, world, truths)
    truth = np.array(truths)
    errors = {}
    for name in names:
        off = _jacobians(_starting_from(estimator(name, variances=variances), jacobian), stream) - truth
        parts = ((off[..., some], truth[..., some]) for some in (slice(0, -1), slice(-1, None)))
        errors[name] = np.array([math.sqrt((wrong**2).sum() / (true**2).sum()) for wrong, true in parts])
    return errors


def _record(
    agent: JacobianServo, seed: int, world: Mapping[str, Any], truths: list[Array] | None = None
) -> list[ServoMeasurement]:
    """Measurements of an episode of `agent`; `truths` is for servos with the analytic Jacobian and collects it."""
    env = gym.make(TRACKING, **{**world, "warmup": 0})
    env = env if truths is None else PrivilegedObservation(env)
    try:
        observation, _ = env.reset(seed=seed)
        stream: list[ServoMeasurement] = []
        state: Any = None
        over = False
        while not over:
            if truths is not None:
                truths.append(observation["true_jacobian"])
            measurement = servo_measurement({k: v for k, v in observation.items() if not k.startswith("true_")})
            assert isinstance(measurement, ServoMeasurement)
            stream.append(measurement)
            action, state = agent.predict(observation, state)
            observation, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
    finally:
        env.close()
    return stream


def _jacobians(method: JacobianEstimator, stream: Sequence[ServoMeasurement]) -> Array:
    state = method.initial(stream[0])
    found = []
    for measurement in stream:
        state, estimate = method.step(state, measurement)
        found.append(estimate.jacobian)
    return np.array(found)
