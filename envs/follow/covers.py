"""Compiled shaders of umbrellas, lampshades and shadows at one point, seen from straight above."""

from __future__ import annotations

import math

from servotrack.envs.follow.figures import SUN, inside, lay
from servotrack.estimators.compilation import njit

SHADOW_LENGTH = 0.55
"""Distance from a person's feet to the shadow of their head, m."""
SHADOW_RADIUS = 0.32
"""Largest distance of a person's shadow from the line between feet and head, m."""
COVER_SHADOW = 0.75
"""Distance from the center of an umbrella or lampshade to the center of its shadow, m."""
PENUMBRA = 0.09
"""Half width of the soft edge of an umbrella's or lampshade's shadow, m."""

_ENAMEL, _RIM, _METAL, _CABLE = (240.0, 231.0, 208.0), (150.0, 116.0, 70.0), (62.0, 60.0, 58.0), (44.0, 42.0, 40.0)
_PANEL = 0.25 * math.pi  # angle of one of an umbrella's panels, rad


@njit(cache=True, nogil=True, error_model="numpy")
def umbrella_at(color, radius, light_x, light_y, x, y, width, out):  # type: ignore[no-untyped-def]
    """Add an umbrella's color at a sample to `out`: eight panels between ribs, and the tip."""
    r = math.sqrt(x * x + y * y)
    if r > radius + width:
        return
    angle = math.atan2(y, x) / _PANEL
    panel = math.floor(angle)
    from_middle = angle - panel - 0.5
    # The edge of the cloth between two ribs is an arc that bends inward.
    cover = inside(r - radius * (0.925 + 0.3 * from_middle * from_middle), width)
    if cover <= 0.0:
        return
    q = r / radius
    toward = math.cos((panel + 0.5) * _PANEL) * light_x + math.sin((panel + 0.5) * _PANEL) * light_y
    brightness = 1.06 + 0.26 * toward * (0.35 + 0.65 * q) - 0.10 * q * q
    if int(panel) % 2 == 0:
        brightness *= 0.93
    off_rib = r * (0.5 - abs(from_middle)) * _PANEL
    brightness *= 1.0 - 0.35 * inside(off_rib - 0.007, width) * min(0.014 / width, 1.0)
    lay(out, inside(r - 0.022, width), 1.0, _METAL, 0)
    gloss = 22.0 * max(toward, 0.0) * max(1.0 - (q - 0.45) * (q - 0.45) / 0.16, 0.0)
    share = cover * (1.0 - out[3])
    out[3] += share
    for channel in range(3):
        out[channel] += share * (brightness * color[channel] + gloss)


@njit(cache=True, nogil=True, error_model="numpy")
def lamp_at(radius, x, y, width, out):  # type: ignore[no-untyped-def]
    """Add a lampshade's color at a sample, in the plane's axes, to `out`: enamel, rim, cap and cable."""
    r = math.sqrt(x * x + y * y)
    cover = inside(r - radius, width)
    if cover == 0.0:
        return
    q = r / radius
    toward = (x * SUN[0] + y * SUN[1]) / radius
    lay(out, inside(r - 0.055, width), 1.0 + 8.0 * toward * radius, _METAL, 0)
    along = 0.8 * x + 0.6 * y
    if along > 0.0:
        cable = inside(abs(0.8 * y - 0.6 * x + 0.12 * along * along) - 0.007, width) * min(0.02 / width, 1.0)
        lay(out, 0.75 * cable * cover, 1.0, _CABLE, 0)
    rim = cover - inside(r - radius + 0.022, width)
    if rim > 0.0:
        lay(out, rim, 1.0 + 0.35 * toward, _RIM, 0)
    gx, gy = x / radius - 0.5 * SUN[0], y / radius - 0.5 * SUN[1]
    brightness = 0.97 + 0.10 * toward - 0.10 * q * q + 0.16 * max(1.0 - (gx * gx + gy * gy) / 0.07, 0.0)
    if q > 0.52:
        brightness -= 0.06
    lay(out, cover, min(brightness, 1.06), _ENAMEL, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def person_shadow(along, across, width):  # type: ignore[no-untyped-def]
    """Darkness of a person's shadow. The point lies `along` m from the feet away from the light, `across` m aside."""
    if abs(across) > 0.24 + 0.25 * width:
        return 0.0
    t = min(max(along / SHADOW_LENGTH, 0.0), 1.0)
    ox = along - t * SHADOW_LENGTH
    soft, d2 = 0.06 + 0.09 * t + 0.5 * width, ox * ox + across * across
    edge = 0.21 - 0.08 * t + 0.5 * soft
    if d2 >= edge * edge:
        return 0.0
    share = min((edge - math.sqrt(d2)) / soft, 1.0)
    return share * share * (3.0 - 2.0 * share) * (1.0 - 0.35 * t)


@njit(cache=True, nogil=True, error_model="numpy")
def cover_shadow(distance, radius, width):  # type: ignore[no-untyped-def]
    """Darkness of an umbrella's or lampshade's shadow at this distance from the shadow's center, m."""
    share = min(max(0.5 + (radius - distance) / (2.0 * PENUMBRA + width), 0.0), 1.0)
    return 0.9 * share * share * (3.0 - 2.0 * share)
