"""Model of a walking body: joints from gait, heading and outfit, projected to parts in the image."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.track.pedestrians.outfits import (
    ARM,
    BACKPACK,
    BAG,
    BAG_COLOR,
    BUILD,
    CASE,
    COAT,
    FOLDS,
    HAIR,
    HAIR_LENGTH,
    HAIRLINE,
    HEAD_SIZE,
    PHONE,
    POCKET,
    RELIEF_TOP,
    RELIEF_TROUSERS,
    SHOES,
    SHOULDER_BAG,
    SKIN,
    SKIRT,
    SLEEVE,
    TOP,
    TOP_DETAIL,
    TOP_MATERIAL,
    TOP_SECOND,
    TROUSERS,
)
from servotrack.envs.track.pedestrians.shapes import (
    BRIGHTNESS,
    CAPS,
    COLOR,
    DEPTH,
    DETAIL,
    FORWARD,
    GRAIN,
    HEAD,
    MATERIAL,
    ORIGIN,
    PLAIN,
    RELIEF,
    SAMPLES,
    SECOND,
    TILT,
    WIDTHS,
)
from servotrack.estimators.compilation import njit

MAX_PARTS = 28
"""Maximum number of parts of a body."""

# Lengths of the body, body heights.
_HIP, _HIP_SIDE, _THIGH, _SHIN, _ANKLE = 0.515, 0.048, 0.245, 0.235, 0.035
_SHOULDER, _SHOULDER_SIDE, _UPPER_ARM, _FOREARM = 0.786, 0.098, 0.160, 0.145
_CHIN, _HEAD_LOW, _HEAD_HIGH = 0.865, 0.912, 0.945

# Half widths along a part, from its upper end, body heights; torso from the front and from the side.
_TORSO_FRONT = np.array([0.056, 0.112, 0.108, 0.095, 0.092, 0.100])
_TORSO_SIDE = np.array([0.042, 0.064, 0.072, 0.068, 0.067, 0.074])
_THIGH_WIDTHS = np.array([0.064, 0.062, 0.057, 0.052, 0.047, 0.043])
_SHIN_WIDTHS = np.array([0.043, 0.043, 0.041, 0.037, 0.032, 0.029])
_BARE_SHIN_WIDTHS = np.array([0.036, 0.039, 0.037, 0.030, 0.024, 0.021])
_SHOE_WIDTHS = np.array([0.027, 0.029, 0.028, 0.027, 0.025, 0.020])
_UPPER_ARM_WIDTHS = np.array([0.033, 0.035, 0.033, 0.031, 0.029, 0.027])
_FOREARM_WIDTHS = np.array([0.028, 0.028, 0.027, 0.025, 0.022, 0.020])
_HAND_WIDTHS = np.array([0.018, 0.020, 0.021, 0.020, 0.017, 0.013])
_NECK_WIDTHS = np.array([0.029, 0.028, 0.028, 0.029, 0.033, 0.040])
_HEAD_WIDTHS = np.array([0.055, 0.055, 0.054, 0.053, 0.050, 0.046])
_HAIR_WIDTHS = np.array([0.050, 0.058, 0.060, 0.060, 0.056, 0.044])
_BAG_WIDTHS = np.array([0.058, 0.066, 0.068, 0.070, 0.072, 0.066])
_CASE_WIDTHS = np.array([0.010, 0.070, 0.074, 0.075, 0.075, 0.074])


@njit(cache=True, nogil=True)
def _put(parts, k, view, a, b, widths, scale, color, outfit, relief, bright):  # type: ignore[no-untyped-def]
    """Write a tube from body point `a` to `b` (forward, left, up; body heights). Return the next free part."""
    x, y, height, cosine, sine, tilt = view[0], view[1], view[2], view[3], view[4], view[5]
    part = parts[k]
    depth = 0.0
    slope = tilt / math.sqrt(1.0 - tilt * tilt)
    for end in range(2):
        point = a if end == 0 else b
        right = point[0] * cosine - point[1] * sine
        away = point[0] * sine + point[1] * cosine
        part[2 * end] = x + height * right
        part[2 * end + 1] = y - height * (point[2] + slope * away)
        depth += 0.5 * (point[2] * tilt - away)
    for i in range(SAMPLES):
        part[WIDTHS + i] = widths[i] * scale * height
    part[CAPS] = part[CAPS + 1] = 1.0
    for c in range(3):
        part[COLOR + c] = outfit[color + c]
        part[SECOND + c] = outfit[color + c]
    part[MATERIAL], part[RELIEF], part[BRIGHTNESS] = PLAIN, relief, bright
    part[FORWARD], part[FORWARD + 1], part[FORWARD + 2] = cosine, -sine * tilt, -sine * math.sqrt(1.0 - tilt * tilt)
    part[TILT], part[DEPTH] = tilt, depth
    part[GRAIN], part[ORIGIN], part[DETAIL] = 0.0, 7.0 * k, 0.0
    return k + 1


@njit(cache=True, nogil=True)
def _leg(parts, k, view, outfit, side, phase, stride, bodies, drop):  # type: ignore[no-untyped-def]
    """Write thigh, shin and shoe of one leg. `drop` lowers the hip. Return the next free part."""
    hip, knee, ankle, toe = bodies[0], bodies[1], bodies[2], bodies[3]
    swing, bend, lift = leg_angles(phase, stride)
    hip[0], hip[1], hip[2] = 0.0, side * _HIP_SIDE, _HIP - drop
    knee[0] = hip[0] + _THIGH * math.sin(swing)
    knee[1] = side * _HIP_SIDE * 0.95
    knee[2] = hip[2] - _THIGH * math.cos(swing)
    ankle[0] = knee[0] + _SHIN * math.sin(swing - bend)
    ankle[1] = side * _HIP_SIDE * 0.9
    ankle[2] = knee[2] - _SHIN * math.cos(swing - bend)
    relief = outfit[RELIEF_TROUSERS]
    bright = 1.0 if -side * view[3] > 0.0 else 0.93  # the far leg is slightly shaded by the other one
    if outfit[SKIRT] > 0.0:
        k = _put(parts, k, view, hip, knee, _THIGH_WIDTHS, 0.86 * outfit[BUILD], SKIN, outfit, 0.6, bright)
        k = _put(parts, k, view, knee, ankle, _BARE_SHIN_WIDTHS, outfit[BUILD], SKIN, outfit, 0.6, bright)
    else:
        k = _put(parts, k, view, hip, knee, _THIGH_WIDTHS, outfit[BUILD], TROUSERS, outfit, relief, bright)
        parts[k - 1, GRAIN] = outfit[FOLDS]
        k = _put(parts, k, view, knee, ankle, _SHIN_WIDTHS, outfit[BUILD], TROUSERS, outfit, relief, bright)
        parts[k - 1, GRAIN] = outfit[FOLDS]
        parts[k - 1, CAPS + 1] = 0.5
    toe[0] = ankle[0] + 0.082 * math.cos(lift)
    toe[1] = ankle[1] + side * 0.012
    toe[2] = ankle[2] - 0.012 + 0.082 * math.sin(lift)
    ankle[0] -= 0.022 * math.cos(lift)
    ankle[2] -= 0.010 + 0.022 * math.sin(lift)
    k = _put(parts, k, view, ankle, toe, _SHOE_WIDTHS, 0.92, SHOES, outfit, 0.7, bright)
    parts[k - 1, DEPTH] -= 0.02
    return k


@njit(cache=True, nogil=True)
def leg_angles(phase, stride):  # type: ignore[no-untyped-def]
    """Return thigh angle from the vertical, knee flexion and toe lift at a phase of the gait, rad."""
    swing = stride * (0.44 * math.sin(phase) + 0.06)
    forward = math.cos(phase)  # positive while the leg swings forward through the air
    bend = stride * (
        0.10 + 0.95 * max(0.0, math.sin(0.5 * math.pi * max(forward, 0.0))) * (0.75 - 0.25 * math.sin(phase))
    )
    lift = stride * (
        0.35 * max(0.0, math.sin(phase)) - 0.75 * max(0.0, -math.sin(phase)) * (0.35 + 0.65 * max(forward, 0.0))
    )
    return swing, bend, lift


@njit(cache=True, nogil=True)
def _arm(parts, k, view, outfit, side, phase, stride, lean, drop, bodies):  # type: ignore[no-untyped-def]
    """Write upper arm, forearm, hand and a carried case. Return the next free part."""
    shoulder, elbow, wrist, end = bodies[0], bodies[1], bodies[2], bodies[3]
    build = outfit[BUILD]
    swing = stride * (0.38 * math.sin(phase) + 0.02)
    bend, spread = 0.14 + stride * (0.16 + 0.16 * math.sin(phase)), 0.13
    if side < 0.0 and outfit[ARM] == POCKET:
        swing, bend, spread = -0.30 + 0.12 * swing, 0.62, 0.32
    elif side < 0.0 and outfit[ARM] == PHONE:
        swing, bend, spread = 0.22 + 0.1 * swing, 1.75, 0.12
    if side > 0.0 and outfit[BAG] == CASE:
        swing, bend, spread = 0.35 * swing, 0.08, 0.12
    shoulder[0], shoulder[1], shoulder[2] = lean * _SHOULDER, side * _SHOULDER_SIDE * build, _SHOULDER - drop
    elbow[0] = shoulder[0] + _UPPER_ARM * math.sin(swing)
    elbow[1] = shoulder[1] + side * _UPPER_ARM * math.sin(spread)
    elbow[2] = shoulder[2] - _UPPER_ARM * math.cos(swing) * math.cos(spread)
    wrist[0] = elbow[0] + _FOREARM * math.sin(swing + bend)
    wrist[1] = elbow[1] - side * _FOREARM * math.sin(spread) * 0.8
    wrist[2] = elbow[2] - _FOREARM * math.cos(swing + bend)
    end[0] = wrist[0] + 0.045 * math.sin(swing + bend)
    end[1] = wrist[1]
    end[2] = wrist[2] - 0.045 * math.cos(swing + bend)
    relief = outfit[RELIEF_TOP]
    k = _put(parts, k, view, wrist, end, _HAND_WIDTHS, 0.95, SKIN, outfit, 0.6, 1.0)
    outward = -0.06 * side * view[3]  # arms hang outside the torso
    parts[k - 1, DEPTH] += outward
    if side > 0.0 and outfit[BAG] == CASE:
        k = _put(
            parts,
            k,
            view,
            end,
            _below(end, 0.12, bodies[4]),
            _CASE_WIDTHS,
            0.35 + 0.65 * abs(view[3]),
            BAG_COLOR,
            outfit,
            0.35,
            1.0,
        )
        parts[k - 1, CAPS] = parts[k - 1, CAPS + 1] = 0.12
        parts[k - 1, DEPTH] += outward
    k = _put(parts, k, view, elbow, wrist, _FOREARM_WIDTHS, build, SLEEVE, outfit, relief, 1.0)
    parts[k - 1, DEPTH] += outward
    k = _put(parts, k, view, shoulder, elbow, _UPPER_ARM_WIDTHS, build, TOP, outfit, relief, 0.98)
    parts[k - 1, GRAIN] = outfit[FOLDS]
    parts[k - 1, DEPTH] += outward
    return k


@njit(cache=True, nogil=True)
def _below(point, distance, out):  # type: ignore[no-untyped-def]
    out[0], out[1], out[2] = point[0], point[1], point[2] - distance
    return out


@njit(cache=True, nogil=True)
def pose_person(outfit, x, y, height, heading, phase, stride, tilt, parts, order):  # type: ignore[no-untyped-def]
    """Write the parts of a body at (x, y), and their drawing order. Return the number of parts."""
    cosine, sine = math.cos(heading), math.sin(heading)
    view = np.array([x, y, height, cosine, sine, tilt])
    bodies = np.zeros((5, 3))
    build = outfit[BUILD]
    # The straighter leg determines the height of the hip.
    reach = 0.0
    for side in (0.0, math.pi):
        swing, bend, _ = leg_angles(phase + side, stride)
        reach = max(reach, _THIGH * math.cos(swing) + _SHIN * math.cos(swing - bend))
    drop = _HIP - _ANKLE - reach
    lean = 0.035 * stride
    k = _leg(parts, 0, view, outfit, 1.0, phase, stride, bodies, drop)
    k = _leg(parts, k, view, outfit, -1.0, phase + math.pi, stride, bodies, drop)
    k = _arm(parts, k, view, outfit, 1.0, phase + math.pi, stride, lean, drop, bodies)
    k = _arm(parts, k, view, outfit, -1.0, phase, stride, lean, drop, bodies)

    torso = np.empty(SAMPLES)
    for i in range(SAMPLES):
        torso[i] = build * math.hypot(_TORSO_FRONT[i] * sine, _TORSO_SIDE[i] * cosine)
    upper, lower = bodies[0], bodies[1]
    relief = outfit[RELIEF_TOP]

    if outfit[SKIRT] > 0.0:
        upper[0], upper[1], upper[2] = 0.0, 0.0, 0.56 - drop
        lower[0], lower[1], lower[2] = 0.0, 0.0, 0.50 - outfit[SKIRT] - drop
        skirt = np.empty(SAMPLES)
        for i in range(SAMPLES):
            skirt[i] = torso[4] * (0.98 + 0.07 * i) + 0.02 * stride * i / SAMPLES
        k = _put(parts, k, view, upper, lower, skirt, 1.0, TROUSERS, outfit, outfit[RELIEF_TROUSERS], 1.0)
        parts[k - 1, CAPS] = parts[k - 1, CAPS + 1] = 0.18
        parts[k - 1, GRAIN] = outfit[FOLDS]
        parts[k - 1, DEPTH] = 0.5 * tilt + 0.02 - 0.001
    upper[0], upper[1], upper[2] = lean * 0.835, 0.0, 0.835 - drop
    lower[0], lower[1], lower[2] = 0.0, 0.0, 0.50 - outfit[COAT] - drop
    k = _put(parts, k, view, upper, lower, torso, 1.0, TOP, outfit, relief, 1.0)
    torso_depth = 0.66 * tilt
    part = parts[k - 1]
    part[CAPS], part[CAPS + 1] = 0.45, 0.15
    part[MATERIAL], part[DETAIL], part[GRAIN] = (
        outfit[TOP_MATERIAL],
        outfit[TOP_DETAIL],
        outfit[FOLDS],
    )
    for c in range(3):
        part[SECOND + c] = outfit[TOP_SECOND + c]
    part[DEPTH] = torso_depth

    if outfit[BAG] == BACKPACK:
        upper[0], upper[1], upper[2] = -0.085, 0.0, 0.79 - drop
        lower[0], lower[1], lower[2] = -0.095, 0.0, 0.60 - drop
        k = _put(parts, k, view, upper, lower, _BAG_WIDTHS, 0.72 + 0.28 * abs(sine), BAG_COLOR, outfit, 0.6, 1.0)
        parts[k - 1, CAPS] = parts[k - 1, CAPS + 1] = 0.4
        parts[k - 1, DEPTH] = torso_depth + 0.2 * sine
    elif outfit[BAG] == SHOULDER_BAG:
        upper[0], upper[1], upper[2] = -0.03, 0.125, 0.58 - drop
        lower[0], lower[1], lower[2] = -0.03, 0.130, 0.49 - drop
        k = _put(parts, k, view, upper, lower, _BAG_WIDTHS, 0.55 + 0.35 * abs(cosine), BAG_COLOR, outfit, 0.5, 1.0)
        parts[k - 1, CAPS] = parts[k - 1, CAPS + 1] = 0.25
        parts[k - 1, DEPTH] = torso_depth - 0.18 * cosine

    upper[0], upper[1], upper[2] = lean * 0.88, 0.0, 0.885 - drop
    lower[0], lower[1], lower[2] = lean * 0.83, 0.0, 0.838 - drop
    k = _put(parts, k, view, upper, lower, _NECK_WIDTHS, 1.0, SKIN, outfit, 0.6, 0.80)
    parts[k - 1, DEPTH] = torso_depth - 0.001
    upper[0], upper[1], upper[2] = lean + 0.004, 0.0, _HEAD_HIGH - drop
    lower[0], lower[1], lower[2] = lean + 0.008, 0.0, _HEAD_LOW - drop
    k = _put(parts, k, view, upper, lower, _HEAD_WIDTHS, outfit[HEAD_SIZE], HAIR, outfit, 0.65, 1.0)
    part = parts[k - 1]
    part[MATERIAL], part[DETAIL], part[DEPTH] = HEAD, outfit[HAIRLINE], torso_depth + 0.05
    for c in range(3):
        part[SECOND + c] = outfit[SKIN + c]
    if outfit[HAIR_LENGTH] > 0.0:
        upper[0], upper[1], upper[2] = lean - 0.022, 0.0, 0.945 - drop
        lower[0], lower[1], lower[2] = lean - 0.034, 0.0, 0.905 - outfit[HAIR_LENGTH] - drop
        k = _put(parts, k, view, upper, lower, _HAIR_WIDTHS, outfit[HEAD_SIZE], HAIR, outfit, 0.5, 1.0)
        # From behind, long hair occludes head and shoulders; from the front, the head occludes it.
        parts[k - 1, DEPTH] = torso_depth + (0.06 if sine > 0.0 else 0.01 if cosine * cosine > 0.5 else -0.02)
    for i in range(k):
        order[i] = i
    for i in range(1, k):
        moved = order[i]
        j = i
        while j > 0 and parts[order[j - 1], DEPTH] > parts[moved, DEPTH]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = moved
    return k
