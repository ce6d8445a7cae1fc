"""Recognition of a moving camera: most corners of two frames move together (Lucas and Kanade 1981, pyramids)."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Image


class MotionRules(NamedTuple):
    """Conditions under which the camera moves.

    Attributes:
        share, regions: Share of foreground, or number of its regions, from which the camera is checked: a camera that
            moves makes foreground everywhere. Raising them saves time.
        shift: Smallest shift between two checks, as a share of the width of the image. Raising it tolerates a camera
            that shakes.
        agree: Smallest share of the corners that move with the median, within half of its length. Raising it asks for
            a camera that only pans.
        confirm: Number of checks in a row that decide.
        period: Time between two checks, s.
        width: Largest width of the small copies in which corners are followed, px.
        corners: Largest number of corners.
        least_corners: Smallest number of corners for a decision.
    """

    share: float = 0.08
    regions: int = 10
    shift: float = 0.0025
    agree: float = 0.5
    confirm: int = 2
    period: float = 0.2
    width: int = 192
    corners: int = 64
    least_corners: int = 8


class CameraMotion(NamedTuple):
    """Memory of the checks.

    Attributes:
        small: Small gray copy of the frame at the last check; None without one. uint8.
        checks: Number of checks in a row that contradict `moving`.
        moving: True while the camera moves.
        speed: Length of the shift at the last check, px of the frame per s.
        passed: Time since the last check, s.
    """

    small: Image | None = None
    checks: int = 0
    moving: bool = False
    speed: float = 0.0
    passed: float = 0.0


def in_doubt(state: CameraMotion) -> bool:
    """Return True while the camera moves, or may move, so that nothing should be reported."""
    return state.moving or state.checks > 0


def check_motion(state: CameraMotion, image: Image, share: float, regions: int, rules: MotionRules) -> CameraMotion:
    """Compare a frame with that of the last check.

    Args:
        state: Result of the last check.
        image: The frame. Shape (H, W, 3) or (H, W), uint8.
        share: Share of the image that is foreground.
        regions: Number of regions of the foreground.
        rules: Conditions.
    """
    small = small_copy(image, rules.width)
    calm = share < rules.share and regions < rules.regions
    if state.small is None or (calm and not in_doubt(state)):
        return CameraMotion(small)
    length, agreeing = _median_flow(state.small, small, rules)
    moves = length >= rules.shift * small.shape[1] and agreeing >= rules.agree
    checks = state.checks + 1 if moves != state.moving else 0
    moving = state.moving
    if checks >= rules.confirm:
        moving, checks = moves, 0
    return CameraMotion(small, checks, moving, length * image.shape[1] / small.shape[1] / state.passed)


def small_copy(image: Image, largest: int) -> Image:
    """Return a gray copy of an image, at most `largest` px wide."""
    height, width = image.shape[:2]
    columns = min(largest, width)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    rows = max(round(height * columns / width), 1)
    return np.asarray(cv2.resize(gray, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


@njit(cache=True, nogil=True)
def _moved_share(before, now, corners, shift):  # type: ignore[no-untyped-def]
    """Share of the corners that may have moved by at least a shift; the others have certainly not.

    For small shifts d the sum of the squared differences over a window is d' G d with the structure tensor G of
    the window (Lucas and Kanade 1981), and thus at least |d|^2 times its smaller eigenvalue. A corner has not moved
    where the sum is below a quarter of that, or where it is below four times that, which a larger shift is not, and
    the first step of their iteration is shorter than half of the shift: that is noise.

    Args:
        before: Gray picture. Shape (H, W), uint8.
        now: The same later. Shape (H, W), uint8.
        corners: Columns and rows. Shape (k, 2), px.
        shift: Length of the shift, px.
    """
    height, width = before.shape
    moved, reach = 0, 3
    for k in range(len(corners)):
        column, row = int(corners[k, 0] + 0.5), int(corners[k, 1] + 0.5)
        xx = yy = xy = xt = yt = total = 0.0
        for y in range(max(row - reach, 1), min(row + reach + 1, height - 1)):
            for x in range(max(column - reach, 1), min(column + reach + 1, width - 1)):
                across = 0.5 * (float(before[y, x + 1]) - float(before[y, x - 1]))
                along = 0.5 * (float(before[y + 1, x]) - float(before[y - 1, x]))
                difference = float(now[y, x]) - float(before[y, x])
                xx += across * across
                yy += along * along
                xy += across * along
                xt += across * difference
                yt += along * difference
                total += difference * difference
        least = shift * shift * (0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy))
        determinant = xx * yy - xy * xy
        step = math.hypot(yy * xt - xy * yt, xx * yt - xy * xt)
        noise = total < 4.0 * least and step < 0.5 * shift * determinant
        moved += total >= 0.25 * least and not noise
    return moved / len(corners)


def _median_flow(before: Image, now: Image, rules: MotionRules) -> tuple[float, float]:
    """Return the length of the corners' median shift, px, and the share of the corners that agree with it."""
    corners = cv2.goodFeaturesToTrack(before, rules.corners, 0.01, before.shape[1] / 16.0)
    if corners is None or len(corners) < rules.least_corners:
        return 0.0, 0.0
    start = np.asarray(corners, dtype=np.float32)
    # Following corners takes most of the time of a check, and most cameras stand still.
    if _moved_share(before, now, start[:, 0], rules.shift * before.shape[1]) < rules.agree:
        return 0.0, 0.0
    followed, found, _ = cv2.calcOpticalFlowPyrLK(before, now, start, start.copy(), winSize=(15, 15), maxLevel=3)
    flow = (np.asarray(followed) - start)[np.ravel(found) == 1, 0]
    if len(flow) < rules.least_corners:
        return 0.0, 0.0
    middle = np.median(flow, axis=0)
    length = float(np.hypot(*middle))
    agreeing = np.hypot(*(flow - middle).T) <= 0.5 * length
    return length, float(np.mean(agreeing))
