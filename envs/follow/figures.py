"""What is seen from straight above at one point of a person, an umbrella, a lampshade and their shadows; compiled.

Everything is flat on the plane: nothing leans away from the camera with its height. A sample is a point in a figure's
own axes (forward and left, m) and the width over which an edge is spread there.
"""

from __future__ import annotations

import math

from numba import njit

from servotrack.envs.track.pedestrians.looks import (
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

SUN = (-0.5812, 0.8137)
"""Where light comes from, a direction on the plane."""
POSE_NUMBERS = 10
"""How far forward left and right foot and hand are, where the light is in the person's axes, and how far all reaches."""
SHADOW_LENGTH = 0.55
"""From somebody's feet to the shadow of their head, m."""
SHADOW_RADIUS = 0.32
"""Of the circle around a shadow's line that holds all of it, m."""
COVER_SHADOW = 0.75
"""From an umbrella's or lampshade's middle to that of its shadow, m."""
PENUMBRA = 0.09
"""Half width of the edge of a shade's shadow, m."""

_LEFT_FOOT, _RIGHT_FOOT, _LEFT_HAND, _RIGHT_HAND, _LIGHT_FORWARD, _LIGHT_LEFT, REACH = range(7)
_SHOULDERS, _CHEST = 0.245, 0.138  # half the torso's ellipse, m
_HEAD = 0.105  # m
_STEP, _SWING = 0.27, 0.25  # how far feet and hands go to and fro, m
_FEET_APART, _HANDS_APART = 0.085, 0.262  # from the middle, m
_SHOE, _SHOE_WIDTH, _LEG, _SLEEVE, _HAND = 0.135, 0.052, 0.078, 0.060, 0.046  # half widths, m
_ENAMEL, _RIM, _METAL, _CABLE = (240.0, 231.0, 208.0), (150.0, 116.0, 70.0), (62.0, 60.0, 58.0), (44.0, 42.0, 40.0)
_OPAQUE = 0.995


@njit(cache=True, nogil=True)
def pose(look, heading, phase, stride, out):  # type: ignore[no-untyped-def]
    """Where a walking person's hands and feet are, and the light about them."""
    swing = stride * math.sin(phase)
    stand = 0.055
    out[_LEFT_FOOT], out[_RIGHT_FOOT] = stand + _STEP * swing, stand - _STEP * swing
    out[_LEFT_HAND], out[_RIGHT_HAND] = 0.04 - _SWING * swing, 0.04 + _SWING * swing
    if look[ARM] == POCKET:
        out[_RIGHT_HAND] = 0.05
    elif look[ARM] == PHONE:
        out[_RIGHT_HAND] = 0.10
    if look[BAG] == CASE:
        out[_RIGHT_HAND] *= 0.4
    c, s = math.cos(heading), math.sin(heading)
    out[_LIGHT_FORWARD], out[_LIGHT_LEFT] = c * SUN[0] + s * SUN[1], c * SUN[1] - s * SUN[0]
    out[REACH] = max(0.36, abs(out[_LEFT_FOOT]) + _SHOE, abs(out[_RIGHT_FOOT]) + _SHOE, abs(out[_LEFT_HAND]) + 0.2)
    if look[BAG] != 0.0:
        out[REACH] = max(out[REACH], 0.42)


@njit(cache=True, nogil=True)
def _lay(out, cover, brightness, color, start):  # type: ignore[no-untyped-def]
    """Put a color under what is there already."""
    share = cover * (1.0 - out[3])
    out[3] += share
    share *= brightness
    out[0] += share * color[start]
    out[1] += share * color[start + 1]
    out[2] += share * color[start + 2]


@njit(cache=True, nogil=True)
def _inside(distance, width):  # type: ignore[no-untyped-def]
    """Share of a sample that lies inside an edge, from the distance to it outward."""
    return min(max(0.5 - distance / width, 0.0), 1.0)


@njit(cache=True, nogil=True)
def _ellipse(x, y, a, b, width):  # type: ignore[no-untyped-def]
    """Share of a sample that lies in an ellipse about the origin with these half axes."""
    x, y = x / a, y / b
    k2 = x * x + y * y
    if k2 < 1e-6:
        return 1.0
    slope = math.sqrt(x * x / (a * a) + y * y / (b * b))
    return _inside((k2 - math.sqrt(k2)) / slope, width)


@njit(cache=True, nogil=True)
def _limb(x, y, x0, y0, x1, y1, radius, width):  # type: ignore[no-untyped-def]
    """Share of a sample that lies in a rod with round ends."""
    dx, dy = x1 - x0, y1 - y0
    t = ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-9)
    t = min(max(t, 0.0), 1.0)
    ox, oy = x - x0 - t * dx, y - y0 - t * dy
    return _inside(math.sqrt(ox * ox + oy * oy) - radius, width)


@njit(cache=True, nogil=True)
def _block(x, y, a, b, width):  # type: ignore[no-untyped-def]
    """Share of a sample that lies in a rectangle with rounded corners about the origin."""
    corner = 0.4 * min(a, b)
    dx, dy = max(abs(x) - a + corner, 0.0), max(abs(y) - b + corner, 0.0)
    inner = min(max(abs(x) - a, abs(y) - b) + corner, 0.0)
    return _inside(math.sqrt(dx * dx + dy * dy) + inner - corner, width)


@njit(cache=True, nogil=True)
def _head(look, lf, ll, f, l, width, out):  # type: ignore[no-untyped-def]
    """Hair over a face that shows where somebody looks."""
    radius = _HEAD * look[HEAD_SIZE]
    x = f - 0.02
    d2 = x * x + l * l
    far = 1.45 * radius + width
    if d2 > far * far:
        return
    qx, qy = x / radius, l / radius
    # Bald towards the forehead by the hairline; the face's slope shows in front of it.
    back = x + radius * (0.16 + 0.5 * look[HAIRLINE])
    hair = _ellipse(back, l, radius * 0.98, radius * 0.93, width)
    light = qx * lf + qy * ll
    round_off = 1.04 + 0.30 * light - 0.24 * (qx * qx + qy * qy)
    if hair > 0.0:
        gx, gy = qx - 0.42 * lf, qy - 0.42 * ll
        gloss = 1.0 + 0.55 * max(1.0 - (gx * gx + gy * gy) / 0.16, 0.0)
        strand = 1.0 + 0.07 * math.cos(34.0 * l + 9.0 * x)
        _lay(out, hair, round_off * gloss * strand, look, HAIR)
    skin = _ellipse(x - 0.012, l, radius * 1.02, radius * 0.86, width)
    if skin < 1.0:
        skin = max(skin, _ellipse(x - 1.08 * radius, l, 0.024, 0.018, width))
        skin = max(skin, _ellipse(x, abs(l) - 0.95 * radius, 0.026, 0.018, width))
    if skin > 0.0:
        _lay(out, skin, round_off + 0.06, look, SKIN)
    if look[HAIR_LENGTH] > 0.0:
        long = _ellipse(x + 0.6 * radius, l, radius * 0.62 + 0.5 * look[HAIR_LENGTH], radius * 0.95, width)
        _lay(out, long, 0.82 + 0.2 * light, look, HAIR)


@njit(cache=True, nogil=True)
def _cloth(look, f, l, width, out, cover, brightness):  # type: ignore[no-untyped-def]
    """The top with its pattern, which blurs where samples are too coarse for it."""
    material = look[TOP_MATERIAL]
    second = 0.0
    if material == OPEN:
        half = 0.17 * look[TOP_DETAIL]
        second = _inside(abs(l) - half - 0.25 * max(f, 0.0), width) * _inside(-f, width)
    elif material == STRIPES:
        period = 0.40 / look[TOP_DETAIL]
        sharp = max(1.0 - width / period, 0.0)
        second = 0.5 + 0.5 * sharp * min(max(2.2 * math.cos(2.0 * math.pi * l / period), -1.0), 1.0)
    elif material == CHECK:
        period = 0.46 / look[TOP_DETAIL]
        sharp = max(1.0 - width / period, 0.0)
        u, v = math.cos(2.0 * math.pi * l / period), math.cos(2.0 * math.pi * f / period)
        second = 0.35 + 0.35 * sharp * 0.5 * (min(max(3.0 * u, -1.0), 1.0) + min(max(3.0 * v, -1.0), 1.0))
    if second > 0.0:
        _lay(out, cover * second, brightness, look, TOP_SECOND)
        # Laid under what is there: the rest of the cover, seen through what the second color left open.
        left = cover * (1.0 - second) / max(1.0 - cover * second, 1e-9)
        _lay(out, left, brightness, look, TOP)
    else:
        _lay(out, cover, brightness, look, TOP)


@njit(cache=True, nogil=True)
def person_at(look, pose, f, l, width, out):  # type: ignore[no-untyped-def]
    """Add what is seen of a person at a sample, from the top down, to `out`: premultiplied RGB, and how opaque it is."""
    lf, ll = pose[_LIGHT_FORWARD], pose[_LIGHT_LEFT]
    build = look[BUILD]
    _head(look, lf, ll, f, l, width, out)
    if out[3] > _OPAQUE:
        return
    bag = look[BAG]
    if bag == BACKPACK:
        pack = _block(f + 0.175, l, 0.085, 0.135, width)
        if pack > 0.0:
            _lay(
                out,
                pack,
                1.0 + 0.25 * (ll * l / 0.135 + lf * (f + 0.175) / 0.085) - 0.3 * max(f + 0.14, 0.0),
                look,
                BAG_COLOR,
            )
        strap = _block(f, abs(l) - 0.125, 0.115, 0.02, width)
        if strap > 0.0:
            _lay(out, strap, 0.85, look, BAG_COLOR)
    elif bag == SHOULDER_BAG:
        strap = _limb(f, l, 0.10, 0.16, -0.07, -0.22, 0.014, width)
        if strap > 0.0:
            _lay(out, strap, 0.9, look, BAG_COLOR)
    a, b = _CHEST * build, _SHOULDERS * build
    if abs(f) < a + width and abs(l) < b + width:
        torso = _ellipse(f, l, a, b, width)
        if torso > 0.0:
            qf, ql = f / a, l / b
            k2 = qf * qf + ql * ql
            d = math.sqrt((f - 0.02) * (f - 0.02) + l * l) - _HEAD
            under_chin = 1.0 - 0.30 * min(max(1.0 - d / 0.05, 0.0), 1.0)
            brightness = (1.13 + 0.24 * (qf * lf + ql * ll) - 0.30 * k2 * k2) * under_chin
            _cloth(look, f, l, width, out, torso, brightness)
            if out[3] > _OPAQUE:
                return
    for side in range(2):
        sign = 1.0 - 2.0 * side
        y = sign * l
        if y < 0.08 - width:
            continue
        hand = pose[_LEFT_HAND + side]
        apart, forward = _HANDS_APART * build, hand
        if side == 1 and look[ARM] == PHONE:
            apart, forward = 0.10, 0.24
        if not (side == 1 and look[ARM] == POCKET):
            _lay(
                out,
                _ellipse(f - forward, y - apart, _HAND, _HAND * 0.9, width),
                1.0 + 0.3 * lf * (f - forward) / _HAND,
                look,
                SKIN,
            )
        arm = _limb(f, y, 0.0, 0.86 * b, 0.86 * forward, apart, _SLEEVE, width)
        if arm > 0.0:
            across = (y - 0.95 * apart) / _SLEEVE
            _lay(out, arm, 0.90 + 0.16 * min(max(across * sign * ll, -1.0), 1.0), look, SLEEVE)
    if bag == SHOULDER_BAG:
        _lay(out, _block(f + 0.07, l + 0.29 * build, 0.13, 0.055, width), 1.0, look, BAG_COLOR)
    elif bag == CASE:
        at = f - pose[_RIGHT_HAND]
        _lay(out, _block(at, l + 0.30 * build, 0.035, 0.012, width), 0.5, look, BAG_COLOR)
        _lay(out, _block(at, l + 0.30 * build, 0.19, 0.055, width), 1.0 + 0.2 * ll * (l + 0.3) / 0.055, look, BAG_COLOR)
    if look[COAT] > 0.05:
        _lay(out, _ellipse(f, l, 0.175 * build, 0.205 * build, width), 0.78, look, TOP)
    if look[SKIRT] > 0.0:
        _lay(out, _ellipse(f, l, 0.185 * build, 0.195 * build, width), 0.9, look, TROUSERS)
    for side in range(2):
        y = l if side == 0 else -l
        if y < -0.02 - width or y > 0.2 + width:
            continue
        foot = pose[_LEFT_FOOT + side]
        if look[SKIRT] == 0.0:
            leg = _limb(f, y, 0.0, 0.09 * build, foot - 0.05, _FEET_APART, _LEG, width)
            if leg > 0.0:
                _lay(out, leg, 1.0 - 0.5 * min(abs(f), 0.4), look, TROUSERS)
        else:
            leg = _limb(f, y, 0.0, 0.07, foot - 0.05, _FEET_APART, 0.045, width)
            if leg > 0.0:
                _lay(out, leg, 0.85, look, SKIN)
        _lay(out, _ellipse(f - foot, y - _FEET_APART, _SHOE, _SHOE_WIDTH, width), 1.0, look, SHOES)


@njit(cache=True, nogil=True)
def umbrella_at(color, radius, lf, ll, f, l, width, out):  # type: ignore[no-untyped-def]
    """Add what is seen of an umbrella at a sample: eight panels between ribs, and the tip."""
    r = math.sqrt(f * f + l * l)
    if r > radius + width:
        return
    angle = math.atan2(l, f) / (0.25 * math.pi)
    panel = math.floor(angle)
    from_middle = (angle - panel - 0.5) * 0.25 * math.pi
    # Cloth between two ribs hangs in: the edge is an arc that bends inward.
    edge = radius * (0.925 + 0.075 * (from_middle / (0.125 * math.pi)) ** 2)
    cover = _inside(r - edge, width)
    if cover <= 0.0:
        return
    out_f, out_l = math.cos((panel + 0.5) * 0.25 * math.pi), math.sin((panel + 0.5) * 0.25 * math.pi)
    q = r / radius
    toward = out_f * lf + out_l * ll
    brightness = 1.06 + 0.26 * toward * (0.35 + 0.65 * q) - 0.10 * q * q
    if int(panel) % 2 == 0:
        brightness *= 0.93
    rib = r * math.sin(0.125 * math.pi - abs(from_middle))
    brightness *= 1.0 - 0.35 * min(max((0.006 + 0.5 * width - rib) / max(width, 0.012), 0.0), 1.0) * min(
        0.014 / width, 1.0
    )
    tip = _inside(r - 0.022, width)
    if tip > 0.0:
        _lay(out, tip, 1.0, _METAL, 0)
    gloss = 22.0 * max(toward, 0.0) * max(1.0 - (q - 0.45) * (q - 0.45) / 0.16, 0.0)
    share = cover * (1.0 - out[3])
    out[3] += share
    for channel in range(3):
        out[channel] += share * (brightness * color[channel] + gloss)


@njit(cache=True, nogil=True)
def lamp_at(radius, x, y, width, out):  # type: ignore[no-untyped-def]
    """Add what is seen of a lampshade at a sample in the plane's axes: enamel, rim, cap and cable."""
    r = math.sqrt(x * x + y * y)
    if r > radius + width:
        return
    cover = _inside(r - radius, width)
    q = r / radius
    toward = (x * SUN[0] + y * SUN[1]) / radius
    cap = _inside(r - 0.055, width)
    if cap > 0.0:
        _lay(out, cap, 1.0 + 8.0 * toward * radius, _METAL, 0)
    along = 0.8 * x + 0.6 * y
    cable = _inside(abs(-0.6 * x + 0.8 * y + 0.12 * along * along) - 0.007, width) * min(0.02 / width, 1.0)
    if along > 0.0 and cable > 0.0:
        _lay(out, 0.75 * cable * cover, 1.0, _CABLE, 0)
    rim = cover - _inside(r - radius + 0.022, width)
    if rim > 0.0:
        _lay(out, rim, 1.0 + 0.35 * toward, _RIM, 0)
    hx, hy = x / radius - 0.5 * SUN[0], y / radius - 0.5 * SUN[1]
    brightness = 0.97 + 0.10 * toward - 0.10 * q * q + 0.16 * max(1.0 - (hx * hx + hy * hy) / 0.07, 0.0)
    if q > 0.52:
        brightness -= 0.06
    _lay(out, cover, min(brightness, 1.06), _ENAMEL, 0)


@njit(cache=True, nogil=True)
def person_shadow(along, across, width):  # type: ignore[no-untyped-def]
    """Darkness of a person's shadow at a point: along the way from the feet away from the light, and across it, m."""
    t = min(max(along / SHADOW_LENGTH, 0.0), 1.0)
    ox = along - t * SHADOW_LENGTH
    distance = math.sqrt(ox * ox + across * across)
    soft = 0.06 + 0.09 * t + 0.5 * width
    inside = min(max((0.21 - 0.08 * t + 0.5 * soft - distance) / soft, 0.0), 1.0)
    return inside * inside * (3.0 - 2.0 * inside) * (1.0 - 0.35 * t)


@njit(cache=True, nogil=True)
def cover_shadow(distance, radius, width):  # type: ignore[no-untyped-def]
    """Darkness of an umbrella's or lampshade's shadow, from the distance to its middle, m."""
    soft = PENUMBRA + 0.5 * width
    inside = min(max(0.5 + (radius - distance) / (2.0 * soft), 0.0), 1.0)
    return 0.9 * inside * inside * (3.0 - 2.0 * inside)
