"""Compiled shader of a person at one point, seen from straight above.

People are flat on the plane, without the parallax of their height. A sample is a point in the person's own axes
(forward and left, m) and the width over which edges are blurred there.
"""

from __future__ import annotations

import math

from servotrack.envs.track.pedestrians.outfits import (
    ARM,
    BACKPACK,
    BAG,
    BAG_COLOR,
    BUILD,
    CASE,
    COAT,
    HAIR,
    HAIR_LENGTH,
    HAIRLINE,
    HEAD_SIZE,
    PHONE,
    POCKET,
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
from servotrack.envs.track.pedestrians.shapes import CHECK, OPEN, STRIPES
from servotrack.estimators.compilation import njit

SUN = (-0.5812, 0.8137)
"""Direction on the plane from which the light comes."""
POSE_NUMBERS = 7
"""Forward positions of left and right foot and hand (m), light direction in the person's axes, largest extent (m)."""
HALF_WIDTH = 0.40
"""Largest extent of a person to the left and right of their center, m."""

_LEFT_FOOT, _RIGHT_FOOT, _LEFT_HAND, _RIGHT_HAND, _LIGHT_FORWARD, _LIGHT_LEFT, REACH = range(7)
_SHOULDERS, _CHEST = 0.245, 0.138  # half axes of the torso's ellipse, m
_HEAD = 0.105  # radius, m
_STEP, _SWING = 0.27, 0.25  # amplitudes of feet and hands, m
_TOES = 0.055  # forward position of the feet of a standing person, m
_FEET_APART, _HANDS_APART = 0.085, 0.262  # distances from the center, m
_SHOE, _SHOE_WIDTH, _LEG, _SLEEVE, _HAND = 0.135, 0.052, 0.078, 0.060, 0.046  # half widths, m
_OPAQUE = 0.995
_FIBER = 0.02  # samples wider than this show no strands of hair, m


@njit(cache=True, nogil=True)
def pose(look, heading, phase, stride, out):  # type: ignore[no-untyped-def]
    """Fill `out` with the pose of a walking person: feet, hands, light direction and extent."""
    swing = stride * math.sin(phase)
    out[_LEFT_FOOT], out[_RIGHT_FOOT] = _TOES + _STEP * swing, _TOES - _STEP * swing
    out[_LEFT_HAND], out[_RIGHT_HAND] = 0.04 - _SWING * swing, 0.04 + _SWING * swing
    if look[ARM] == POCKET:
        out[_RIGHT_HAND] = 0.05
    elif look[ARM] == PHONE:
        out[_RIGHT_HAND] = 0.24
    if look[BAG] == CASE:
        out[_RIGHT_HAND] *= 0.4
    c, s = math.cos(heading), math.sin(heading)
    out[_LIGHT_FORWARD], out[_LIGHT_LEFT] = c * SUN[0] + s * SUN[1], c * SUN[1] - s * SUN[0]
    out[REACH] = max(0.36, abs(out[_LEFT_FOOT]) + _SHOE, abs(out[_RIGHT_FOOT]) + _SHOE, abs(out[_LEFT_HAND]) + 0.2)
    if look[BAG] != 0.0:
        out[REACH] = max(out[REACH], 0.48)


@njit(cache=True, nogil=True, error_model="numpy")
def lay(out, cover, brightness, color, start):  # type: ignore[no-untyped-def]
    """Put a color under the colors that `out` already holds."""
    share = cover * (1.0 - out[3])
    out[3] += share
    share *= brightness
    out[0] += share * color[start]
    out[1] += share * color[start + 1]
    out[2] += share * color[start + 2]


@njit(cache=True, nogil=True, error_model="numpy")
def inside(distance, width):  # type: ignore[no-untyped-def]
    """Share of a sample inside an edge, from its distance outside the edge (negative inside)."""
    return min(max(0.5 - distance / width, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _ellipse(x, y, a, b, width):  # type: ignore[no-untyped-def]
    """Share of a sample inside an ellipse about the origin with half axes `a` and `b`."""
    u, v, soft = x / a, y / b, width / (a + b)
    k2 = u * u + v * v
    if k2 >= (1.0 + soft) * (1.0 + soft):
        return 0.0
    if soft < 1.0 and k2 <= (1.0 - soft) * (1.0 - soft):
        return 1.0
    return min(0.5 + 0.5 * (1.0 - math.sqrt(k2)) / soft, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _rod(x, y, x0, y0, x1, y1, radius, width):  # type: ignore[no-untyped-def]
    """Share of a sample inside a rod with round ends."""
    dx, dy = x1 - x0, y1 - y0
    t = min(max(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy + 1e-9), 0.0), 1.0)
    ox, oy = x - x0 - t * dx, y - y0 - t * dy
    d2, far, near = ox * ox + oy * oy, radius + 0.5 * width, radius - 0.5 * width
    if d2 >= far * far:
        return 0.0
    if near > 0.0 and d2 <= near * near:
        return 1.0
    return inside(math.sqrt(d2) - radius, width)


@njit(cache=True, nogil=True, error_model="numpy")
def _block(x, y, a, b, width):  # type: ignore[no-untyped-def]
    """Share of a sample inside a rectangle with rounded corners about the origin."""
    corner = 0.4 * min(a, b)
    dx, dy = abs(x) - a + corner, abs(y) - b + corner
    if max(dx, dy) > corner + width:
        return 0.0
    if min(dx, dy) > 0.0:
        return inside(math.sqrt(dx * dx + dy * dy) - corner, width)
    return inside(max(dx, dy) - corner, width)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _head(look, light_x, light_y, x, y, width, out):  # type: ignore[no-untyped-def]
    """Hair, and the part of the face that shows in front of it."""
    radius = _HEAD * look[HEAD_SIZE]
    x -= 0.02
    far = 1.25 * radius + look[HAIR_LENGTH] + width
    if x * x + y * y > far * far:
        return
    qx, qy = x / radius, y / radius
    light = qx * light_x + qy * light_y
    dome = 1.02 + 0.24 * light - 0.22 * (qx * qx + qy * qy)
    # The hairline decides how much of the forehead is bald; the face shows in front of it.
    hair = _ellipse(x + radius * (0.16 + 0.5 * look[HAIRLINE]), y, radius * 0.98, radius * 0.93, width)
    if hair > 0.0:
        gx, gy = qx - 0.42 * light_x, qy - 0.42 * light_y
        gloss = 1.0 + 0.26 * max(1.0 - (gx * gx + gy * gy) / 0.16, 0.0)
        if width < _FIBER:
            # Strands fall to all sides from the crown.
            gloss *= 1.0 + 0.12 * math.cos(13.0 * math.atan2(qy, qx + 0.35)) * min(abs(qx + 0.35) + abs(qy), 1.0)
        lay(out, hair, dome * gloss, look, HAIR)
        if hair == 1.0:
            return
    skin = _ellipse(x - 0.012, y, radius * 1.02, radius * 0.86, width)
    if skin < 1.0 and width < 2.0 * _FIBER:
        skin = max(skin, _ellipse(x - 1.08 * radius, y, 0.024, 0.018, width))
        skin = max(skin, _ellipse(x, abs(y) - 0.95 * radius, 0.026, 0.018, width))
    if skin > 0.0:
        lay(out, skin, dome + 0.06, look, SKIN)
    if look[HAIR_LENGTH] > 0.0:
        long = _ellipse(x + 0.6 * radius, y, radius * 0.62 + 0.5 * look[HAIR_LENGTH], radius * 0.95, width)
        lay(out, long, 0.82 + 0.2 * light, look, HAIR)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _pattern(look, x, y, width):  # type: ignore[no-untyped-def]
    """Share of a top's second color. Patterns blur where samples are too coarse for them."""
    material = look[TOP_MATERIAL]
    if material == OPEN:
        return inside(abs(y) - 0.17 * look[TOP_DETAIL] - 0.25 * max(x, 0.0), width) * inside(-x, width)
    if material == STRIPES:
        period = 0.40 / look[TOP_DETAIL]
        sharp = max(1.0 - width / period, 0.0)
        return 0.5 + 0.5 * sharp * min(max(2.2 * math.cos(2.0 * math.pi * y / period), -1.0), 1.0)
    if material == CHECK:
        period = 0.46 / look[TOP_DETAIL]
        sharp = max(1.0 - width / period, 0.0)
        u, v = math.cos(2.0 * math.pi * y / period), math.cos(2.0 * math.pi * x / period)
        return 0.35 + 0.175 * sharp * (min(max(3.0 * u, -1.0), 1.0) + min(max(3.0 * v, -1.0), 1.0))
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _torso(look, light_x, light_y, x, y, width, out):  # type: ignore[no-untyped-def]
    """Shoulders in the colors of the top, darker under the chin."""
    a, b = _CHEST * look[BUILD], _SHOULDERS * look[BUILD]
    if abs(x) > a + width or abs(y) > b + width:
        return
    cover = _ellipse(x, y, a, b, width)
    if cover == 0.0:
        return
    qx, qy = x / a, y / b
    k2 = qx * qx + qy * qy
    beyond = (x - 0.02) * (x - 0.02) + y * y
    chin = 1.0 - 0.30 * min(max(1.0 - (beyond / _HEAD - _HEAD) / 0.13, 0.0), 1.0)
    brightness = (1.13 + 0.24 * (qx * light_x + qy * light_y) - 0.30 * k2 * k2) * chin
    second = cover * _pattern(look, x, y, width)
    if second > 0.0:
        lay(out, second, brightness, look, TOP_SECOND)
        # The first color fills the rest of the cover.
        cover = (cover - second) / max(1.0 - second, 1e-9)
    lay(out, cover, brightness, look, TOP)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _arms(look, pose, light_x, light_y, x, y, width, out):  # type: ignore[no-untyped-def]
    """Swinging arms, and the hands beyond the sleeves."""
    right = y < 0.0
    if right:
        y, light_y = -y, -light_y
    build = look[BUILD]
    if y < 0.06 - width or y > (_HANDS_APART + _SLEEVE) * build + width:
        return
    hand, apart = pose[_RIGHT_HAND if right else _LEFT_HAND], _HANDS_APART * build
    if right and look[ARM] == PHONE:
        apart = 0.10
    if x < min(hand, 0.0) - _SLEEVE - width or x > max(hand, 0.0) + _SLEEVE + width:
        return
    if not (right and look[ARM] == POCKET):
        fist = _ellipse(x - hand, y - apart, _HAND, _HAND * 0.9, width)
        if fist > 0.0:
            lay(out, fist, 1.0 + 0.2 * light_x * (x - hand) / _HAND, look, SKIN)
    arm = _rod(x, y, 0.0, 0.86 * _SHOULDERS * build, 0.86 * hand, apart, _SLEEVE, width)
    if arm > 0.0:
        across = min(max((y - 0.95 * apart) / _SLEEVE, -1.0), 1.0)
        lay(out, arm, 0.90 + 0.16 * across * light_y, look, SLEEVE)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _legs(look, pose, x, y, width, out):  # type: ignore[no-untyped-def]
    """Trousers or bare legs, and stepping shoes."""
    for side in range(2):
        across = y if side == 0 else -y
        if across < -0.03 - width or across > 0.18 + width:
            continue
        foot = pose[_LEFT_FOOT + side]
        if x < min(foot - _SHOE, -_LEG) - width or x > max(foot + _SHOE, _LEG) + width:
            continue
        bare = look[SKIRT] > 0.0
        leg = _rod(x, across, 0.0, 0.08, foot - 0.05, _FEET_APART, 0.045 if bare else _LEG, width)
        if leg > 0.0:
            lay(out, leg, 1.0 - 0.5 * min(abs(x), 0.4), look, SKIN if bare else TROUSERS)
        shoe = _ellipse(x - foot, across - _FEET_APART, _SHOE, _SHOE_WIDTH, width)
        if shoe > 0.0:
            lay(out, shoe, 1.0, look, SHOES)


@njit(cache=True, nogil=True, error_model="numpy")
def _worn_bag(look, light_x, light_y, x, y, width, out):  # type: ignore[no-untyped-def]
    """The part of a bag that lies on the shoulders."""
    if look[BAG] == BACKPACK:
        pack = _block(x + 0.175, y, 0.085, 0.135, width)
        if pack > 0.0:
            light = light_y * y / 0.135 + light_x * (x + 0.175) / 0.085
            lay(out, pack, 1.0 + 0.25 * light - 0.3 * max(x + 0.14, 0.0), look, BAG_COLOR)
        strap = _block(x, abs(y) - 0.125, 0.115, 0.02, width)
    else:
        strap = _rod(x, y, 0.10, 0.16, -0.07, -0.22, 0.014, width)
    if strap > 0.0:
        lay(out, strap * min(0.03 / width, 1.0), 0.85, look, BAG_COLOR)


@njit(cache=True, nogil=True, error_model="numpy")
def _carried_bag(look, pose, light_y, x, y, width, out):  # type: ignore[no-untyped-def]
    """The part of a bag that hangs beside the person."""
    y += 0.30 * look[BUILD]
    if look[BAG] == CASE:
        x -= pose[_RIGHT_HAND]
        lay(out, _block(x, y, 0.035, 0.012, width) * min(0.03 / width, 1.0), 0.5, look, BAG_COLOR)
        lay(out, _block(x, y, 0.19, 0.055, width), 1.0 + 0.2 * light_y * y / 0.055, look, BAG_COLOR)
    else:
        lay(out, _block(x + 0.07, y, 0.13, 0.055, width), 1.0, look, BAG_COLOR)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def person_at(look, pose, x, y, width, out):  # type: ignore[no-untyped-def]
    """Add a person's color at a sample to `out` (premultiplied RGB and opacity), from the top down."""
    light_x, light_y = pose[_LIGHT_FORWARD], pose[_LIGHT_LEFT]
    _head(look, light_x, light_y, x, y, width, out)
    if out[3] > _OPAQUE:
        return
    bag = look[BAG]
    if bag in (BACKPACK, SHOULDER_BAG):
        _worn_bag(look, light_x, light_y, x, y, width, out)
    _torso(look, light_x, light_y, x, y, width, out)
    if out[3] > _OPAQUE:
        return
    _arms(look, pose, light_x, light_y, x, y, width, out)
    if y < 0.0 and bag in (SHOULDER_BAG, CASE):
        _carried_bag(look, pose, light_y, x, y, width, out)
    if look[COAT] > 0.05:
        lay(out, _ellipse(x, y, 0.175 * look[BUILD], 0.205 * look[BUILD], width), 0.78, look, TOP)
    if look[SKIRT] > 0.0:
        lay(out, _ellipse(x, y, 0.185 * look[BUILD], 0.195 * look[BUILD], width), 0.9, look, TROUSERS)
    _legs(look, pose, x, y, width, out)
