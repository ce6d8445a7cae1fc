"""Compiled kernels of a servo world: commands to the motors, camera and encoders, scores."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.compiled_arms import LANES, move_blocks, start_arm
from servotrack.envs.servo.layout import Ranges, draw_layouts
from servotrack.envs.servo.noise import NoiseRanges, draw_noises
from servotrack.envs.servo.records import RING
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW, LEAD, PERIOD, START
from servotrack.estimators.camera import project, zoom_into
from servotrack.estimators.compilation import njit

_REWARD_SCALE = 0.002  # tracking error at which the reward's slope becomes logarithmic, m
_REWARD_RANGE = 2.0  # tracking error from which on the reward is 0, m
_REWARD_LOGARITHM = math.log1p(_REWARD_RANGE / _REWARD_SCALE)


class EpisodeDraws(NamedTuple):
    """Parameters that episodes are drawn and begun with.

    Attributes:
        ranges: Ranges of layouts, of a target that moves along waves.
        fixed: True takes the first layout, see `never_rejected`.
        noise: Ranges of noise.
        first_sample: Sample before an episode's first one, (1,) record `SAMPLE`.
    """

    ranges: Ranges
    fixed: bool
    noise: NoiseRanges
    first_sample: NDArray[np.void]


@njit(cache=True, nogil=True)
def tracking_reward(distance):  # type: ignore[no-untyped-def]
    """Reward for a distance (m) between tool and target: 1 at 0, 0 from 2 m on, logarithmic in between."""
    near = 1.0 - math.log1p(distance / _REWARD_SCALE) / _REWARD_LOGARITHM
    return min(max(near, 0.0), 1.0)


@njit(cache=True, nogil=True)
def advance(  # type: ignore[no-untyped-def]
    blocks, solver, rows, actions, settings, constants, tables, joints, history, samples, first, last
):
    """Command, move and observe the arms of some blocks for one control period: a whole step in one call.

    Args:
        blocks: Quantities of all arms, see `CompiledArms`.
        solver: Constants of the solver, (1,) record `SOLVER`.
        rows: Mask of the rows whose episode is running, (N,) bool.
        actions: Fractions of the largest joint rate, (N, 2).
        settings: Parameters of the world, (1,) record `SETTINGS`.
        constants: Constants of the episodes, (N,) records `CONSTANTS`.
        tables: Draws of the episodes, `Tables`.
        joints: True joint angles, overwritten, (N, 2) rad.
        history: Ring buffer of the last joint angles, overwritten, (N, RING, 2) rad.
        samples: Newest samples, overwritten, (N,) records `SAMPLE`.
        first: First block.
        last: Block after the last one.
    """
    start, stop = first * LANES, min(last * LANES, rows.shape[0])
    for i in range(start, stop):
        _command(rows[i], actions[i], settings[0], constants[i], tables.rate_noise[i], joints[i], samples[i])
    move_blocks(blocks, samples["rates"], joints, solver, first, last)
    for i in range(start, stop):
        if rows[i]:
            _sense(i, settings[0], constants[i], tables, joints[i], history[i], samples[i])


@njit(cache=True, nogil=True)
def begin(  # type: ignore[no-untyped-def]
    rows, seeds, draws, blocks, solver, settings, constants, tables, joints, history, samples
):
    """Draw new episodes, restart their arms and observe them: a whole reset in one call.

    Args:
        rows: Indices of the rows, (n,).
        seeds: Seed of each of these rows' episodes, below 2^63, (n,).
        draws: Parameters of the draws, `EpisodeDraws`.
        blocks: See `advance`.
        solver: See `advance`.
        settings: See `advance`.
        constants: Overwritten in these rows, see `advance`.
        tables: Overwritten in these rows, see `advance`.
        joints: See `advance`.
        history: See `advance`.
        samples: See `advance`.

    Returns:
        -1, or the first row without a solvable layout.
    """
    failed = draw_layouts(rows, seeds, draws.ranges, draws.fixed, constants, tables.paths)
    if failed >= 0:
        return failed
    draw_noises(rows, seeds, draws.noise, constants, tables)
    for n in range(len(rows)):
        row = rows[n]
        start_arm(row, constants[row].links, blocks, joints, solver[0])
        for k in range(RING):
            history[row, k, 0], history[row, k, 1] = START[0], START[1]
        samples[row] = draws.first_sample[0]
        _sense(row, settings[0], constants[row], tables, joints[row], history[row], samples[row])
    return failed


@njit(cache=True, nogil=True)
def advance_and_begin(ended, seeds, draws, step, first, last):  # type: ignore[no-untyped-def]
    """Advance some blocks, then begin new episodes in those rows of them that ended.

    Args:
        ended: Indices of the rows that begin an episode, ascending, (n,).
        seeds: Seed of each of these rows' episodes, (n,).
        draws: See `begin`.
        step: Arguments of `advance` before `first`.
        first: First block.
        last: Block after the last one.

    Returns:
        -1, or the first row without a solvable layout.
    """
    blocks, solver, rows, actions, settings, constants, tables, joints, history, samples = step
    advance(blocks, solver, rows, actions, settings, constants, tables, joints, history, samples, first, last)
    own = slice(np.searchsorted(ended, first * LANES), np.searchsorted(ended, last * LANES))
    return begin(
        ended[own], seeds[own], draws, blocks, solver, settings, constants, tables, joints, history, samples
    )  # fmt: skip


@njit(cache=True, nogil=True)
def command(rows, actions, settings, constants, tables, joints, samples):  # type: ignore[no-untyped-def]
    """Command the motors of all arms and count the steps of the chosen rows. Arguments: see `advance`."""
    for i in range(rows.shape[0]):
        _command(rows[i], actions[i], settings[0], constants[i], tables.rate_noise[i], joints[i], samples[i])


@njit(cache=True, nogil=True)
def sense(rows, settings, constants, tables, joints, history, samples):  # type: ignore[no-untyped-def]
    """Observe the chosen rows. Arguments: see `advance`."""
    for i in range(rows.shape[0]):
        if rows[i]:
            _sense(i, settings[0], constants[i], tables, joints[i], history[i], samples[i])


@njit(cache=True, nogil=True)
def _command(running, action, settings, constants, rate_noise, joints, sample):  # type: ignore[no-untyped-def]
    """Compute an arm's joint rates: clipped, with gain error and noise, limited so that joints stop at their stops.

    `sample.rates` holds the last period's rates and is overwritten. The steps of running episodes are counted.
    """
    rates = sample.rates
    for j in range(2):
        rate = min(max(action[j], -1.0), 1.0) * settings.max_joint_rate * constants.gain[j]
        if rate_noise.shape[0] > 0:
            rate += rate_noise[sample.steps + LEAD, j]
        if settings.lag > 0.0:
            rate += settings.lag * (sample.drive[j] - rate)
            sample.drive[j] = rate
        if settings.backlash > 0.0:
            ahead, half = sample.play[j] + PERIOD * rate, 0.5 * settings.backlash
            sample.play[j] = min(max(ahead, -half), half)
            rate = (ahead - sample.play[j]) / PERIOD
        # With the stops alone a joint overshoots by more than a degree. A motor reacts one substep late, so the
        # angle that the joint coasts until then is subtracted from the angle that is left.
        coasted = joints[j] + settings.substep * rates[j]
        rates[j] = min(max(rate, (JOINT_LOW[j] - coasted) / PERIOD), (JOINT_HIGH[j] - coasted) / PERIOD)
    if running:
        sample.steps += 1


@njit(cache=True, nogil=True)
def interpolate_path(before, after, fraction):  # type: ignore[no-untyped-def]
    """Position a `fraction` of a period after `before`, by cubic Hermite interpolation between two rows of a path."""
    f, g = fraction, 1.0 - fraction
    hermite = np.empty(2)
    for j in range(2):
        hermite[j] = (
            g * g * (1.0 + 2.0 * f) * before[j] + f * f * (3.0 - 2.0 * f) * after[j]
            + PERIOD * f * g * (g * before[2 + j] - f * after[2 + j])
        )  # fmt: skip
    return hermite[0], hermite[1]


@njit(cache=True, nogil=True)
def capture(camera, links, before, after, history, frame, size, shutter):  # type: ignore[no-untyped-def]
    """Noise-free features in the frame whose readout ends at sample `frame`; each image row has its own instant.

    The target moves from `before`, its position and velocity one sample earlier, to `after`.
    """
    now = history[frame % RING]
    u, v, seen = project(camera, links[0], links[1], now[0], now[1], after[0], after[1])
    if shutter > 0.0:
        old = history[(frame - 1) % RING]
        for _ in range(3):
            f = 1.0 - shutter * (1.0 - min(max(v / size, 0.0), 1.0)) / PERIOD
            theta1 = old[0] + f * (now[0] - old[0])
            theta2 = old[1] + f * (now[1] - old[1])
            x, y = interpolate_path(before, after, f)
            u, v, seen = project(camera, links[0], links[1], theta1, theta2, x, y)
    return u, v, seen and 0.0 <= u < size and 0.0 <= v < size


@njit(cache=True, nogil=True)
def _camera_at(sample, constants, focal_factor):  # type: ignore[no-untyped-def]
    """Return the packed camera at a sample, knocked or zoomed."""
    # The compiler tells fields of a record and arrays apart; a slice of a field is an array.
    camera = constants.camera[:] if sample < constants.knocked_at else constants.knocked[:]
    if focal_factor.shape[0] == 0:
        return camera
    zoomed = np.empty_like(camera)
    zoom_into(camera, constants.goal, focal_factor[sample], zoomed)
    return zoomed


@njit(cache=True, nogil=True)
def _sense(i, settings, constants, tables, joints, history, sample):  # type: ignore[no-untyped-def]
    """Compute the newest sample of row `i`: truth, score and sensor readings."""
    size, shutter, warmup = settings.camera_size, settings.shutter, settings.warmup
    links = constants.links
    path, feature_noise = tables.paths[i], tables.feature_noise[i]
    encoder_noise, dropped, focal_factor = tables.encoder_noise[i], tables.dropped[i], tables.focal_factor[i]
    now = sample.steps + LEAD
    theta1, theta2 = joints[0], joints[1]
    history[now % RING, 0] = theta1
    history[now % RING, 1] = theta2
    sample.time = (sample.steps - warmup) * PERIOD
    target, tool = sample.target, sample.tool
    for j in range(4):
        target[j] = path[now, j]

    tool[0] = links[0] * math.cos(theta1) + links[1] * math.cos(theta1 + theta2)
    tool[1] = links[0] * math.sin(theta1) + links[1] * math.sin(theta1 + theta2)
    distance = math.hypot(tool[0] - target[0], tool[1] - target[1])
    sample.tracking_error = distance
    camera = _camera_at(now, constants, focal_factor)
    u, v, seen = project(camera, links[0], links[1], theta1, theta2, target[0], target[1])
    sample.feature_error = math.hypot(u - constants.goal[0], v - constants.goal[1])
    in_view = seen and 0.0 <= u < size and 0.0 <= v < size
    sample.out_of_view = 0 if in_view else sample.out_of_view + 1
    sample.terminated = sample.out_of_view >= settings.lost_after
    sample.truncated = sample.steps >= warmup + settings.horizon
    scored = sample.steps > warmup and not sample.terminated
    sample.reward = tracking_reward(distance) if scored else 0.0

    for j in range(2):
        sample.joint_angles[j] = history[(now - constants.encoder_age) % RING, j]
        if encoder_noise.shape[0] > 0:
            sample.joint_angles[j] += encoder_noise[now, j]

    frame = now - constants.latency
    sample.visible = 0.0
    if dropped.shape[0] > 0 and dropped[frame]:
        return
    sample.captured = frame
    # A frame of this very instant shows what was projected above.
    if frame != now or shutter > 0.0:
        camera = _camera_at(frame, constants, focal_factor)
        u, v, in_view = capture(camera, links, path[frame - 1], path[frame], history, frame, size, shutter)
    if not in_view:
        return
    if feature_noise.shape[0] > 0:
        u += feature_noise[frame, 0]
        v += feature_noise[frame, 1]
    if settings.quantized:
        u, v = math.floor(u) + 0.5, math.floor(v) + 0.5
    sample.features[0] = min(max(u, 0.0), size)
    sample.features[1] = min(max(v, 0.0), size)
    sample.visible = 1.0
    # A rolling shutter's frame is stamped with the instant of its middle row.
    sample.frame_time = (frame - LEAD - warmup) * PERIOD - 0.5 * shutter if settings.stamped else sample.time
