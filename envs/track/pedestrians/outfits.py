"""Random outfits: build, skin, hair and clothes of a person as a vector of numbers, drawn from one seed."""

from __future__ import annotations

import numpy as np

from servotrack.envs.streams import draw_index, draw_share, draw_uniform, start_stream
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

SKIN, HAIR, TOP, TOP_SECOND, SLEEVE, TROUSERS, SHOES, BAG_COLOR = range(0, 24, 3)
"""First columns of the colors, RGB in gray levels."""
BUILD, HEAD_SIZE, HAIRLINE, HAIR_LENGTH = 24, 25, 26, 27
"""Columns: factors on body width and head size, position of the hairline, and length of the hair, body heights."""
TOP_MATERIAL, TOP_DETAIL, COAT, SHORT_SLEEVE = 28, 29, 30, 31
"""Columns: material of the top (`shapes`), its detail, its length below the hip (body heights), 1 for bare forearms."""
SKIRT, BAG, ARM, RELIEF_TOP, RELIEF_TROUSERS, FOLDS = 32, 33, 34, 35, 36, 37
"""Columns: length of a skirt (body heights), kind of bag, pose of the right arm, strengths of shading and folds."""
OUTFIT_NUMBERS = 38
"""Number of columns."""

NO_BAG, BACKPACK, SHOULDER_BAG, CASE = range(4)
SWINGING, POCKET, PHONE = range(3)

_SHAPE, _PAINT, _BLEND = range(3)
"""Random streams of an outfit; `_BLEND` decides which clothes have background colors."""

_SKINS = np.array(
    ((236, 196, 168), (224, 172, 138), (198, 146, 110), (150, 104, 74), (104, 70, 50), (74, 50, 38)), np.float64
)
_HAIRS = np.array(
    (
        (26, 22, 20),
        (34, 26, 22),
        (44, 32, 24),
        (60, 42, 30),
        (78, 54, 36),
        (112, 78, 46),
        (160, 126, 80),
        (140, 138, 134),
    ),
    np.float64,
)
_CLOTHES = np.array(
    (
        (30, 34, 46),  # navy
        (24, 24, 27),  # black
        (36, 38, 44),  # charcoal
        (146, 28, 36),  # crimson
        (96, 22, 34),  # burgundy
        (26, 70, 116),  # blue
        (44, 66, 104),  # denim
        (20, 88, 86),  # teal
        (34, 72, 46),  # green
        (84, 34, 76),  # plum
        (206, 150, 40),  # mustard
        (244, 243, 238),  # white
        (238, 228, 208),  # cream
        (62, 38, 30),  # brown
        (20, 42, 80),  # royal
        (208, 84, 34),  # rust
    ),
    np.float64,
)
_TROUSERS = np.array(
    (
        (26, 28, 36),
        (34, 46, 74),
        (42, 58, 92),
        (22, 22, 24),
        (46, 40, 36),
        (32, 42, 38),
        (54, 32, 32),
    ),
    np.float64,
)
_SHOES = np.array(((22, 20, 20), (54, 34, 24), (30, 30, 36), (216, 216, 214)), np.float64)
_BAGS = np.array(((60, 36, 24), (24, 24, 28), (140, 30, 36), (30, 60, 90), (176, 120, 60)), np.float64)


def draw_outfit(seed: int, camouflage: float, background: Array) -> Array:
    """Draw an outfit from a seed.

    Args:
        seed: Seed of the outfit.
        camouflage: Probability that a piece of clothing has a background color, 0 to 1.
        background: Background colors, shape (k, 3), gray levels.

    Returns:
        Outfit, shape (OUTFIT_NUMBERS,).
    """
    outfit, states = np.zeros(OUTFIT_NUMBERS), np.zeros((3, 6), np.uint64)
    for stream in (_SHAPE, _PAINT, _BLEND):
        start_stream(seed, stream, states[stream])
    compose_outfit(states[_SHAPE], states[_PAINT], states[_BLEND], camouflage, background, outfit)
    return outfit


@njit(cache=True, nogil=True)
def _choose(paint, colors, spread, out):  # type: ignore[no-untyped-def]
    """Draw one of some colors and its brightness."""
    chosen, brightness = colors[draw_index(paint, len(colors))], draw_uniform(paint, 1.0 - spread, 1.0 + spread)
    for channel in range(3):
        out[channel] = min(max(chosen[channel] * brightness, 8.0), 250.0)


@njit(cache=True, nogil=True)
def compose_outfit(shape, paint, blend, camouflage, background, outfit):  # type: ignore[no-untyped-def]
    """Draw an outfit from random streams, which may be one and the same.

    Args:
        shape: State of the stream of build, cut and bags, see `servotrack.envs.streams.draw_index`.
        paint: State of the stream of colors.
        blend: State of the stream that chooses background colors.
        camouflage: Probability that a piece of clothing has a background color, 0 to 1.
        background: Background colors, shape (k, 3), gray levels.
        outfit: Outfit, written in place, zeros before, shape (OUTFIT_NUMBERS,).
    """
    _choose(paint, _SKINS, 0.06, outfit[SKIN : SKIN + 3])
    _choose(paint, _HAIRS, 0.15, outfit[HAIR : HAIR + 3])
    _choose(paint, _CLOTHES, 0.12, outfit[TOP : TOP + 3])
    _choose(paint, _CLOTHES, 0.12, outfit[TOP_SECOND : TOP_SECOND + 3])
    _choose(paint, _TROUSERS, 0.2, outfit[TROUSERS : TROUSERS + 3])
    _choose(paint, _SHOES, 0.1, outfit[SHOES : SHOES + 3])
    _choose(paint, _BAGS, 0.15, outfit[BAG_COLOR : BAG_COLOR + 3])
    outfit[BUILD] = draw_uniform(shape, 0.92, 1.12)
    outfit[HEAD_SIZE] = draw_uniform(shape, 0.96, 1.06)
    outfit[HAIRLINE] = draw_uniform(shape, -0.2, 0.25)
    long_hair = draw_share(shape) < 0.38
    outfit[HAIR_LENGTH] = draw_uniform(shape, 0.05, 0.14) if long_hair else 0.0
    kind = draw_share(shape)
    material = 0 if kind < 0.42 else 2 if kind < 0.75 else 3 if kind < 0.88 else 4
    outfit[TOP_MATERIAL] = material
    # All details are drawn, whatever the material.
    details = draw_uniform(shape, 0.22, 0.42), 4.0 + draw_index(shape, 4), 3.0 + draw_index(shape, 3)
    outfit[TOP_DETAIL] = details[material - 2] if material >= 2 else 0.0
    outfit[COAT] = 0.03
    if material in (0, 2) and draw_share(shape) < 0.3:
        outfit[COAT] = draw_uniform(shape, 0.08, 0.2)
    outfit[SHORT_SLEEVE] = material != 2 and draw_share(shape) < 0.35
    outfit[SKIRT] = draw_uniform(shape, 0.2, 0.3) if long_hair and draw_share(shape) < 0.4 else 0.0
    share = draw_share(shape)
    outfit[BAG] = BACKPACK if share <= 0.18 else SHOULDER_BAG if share <= 0.34 else CASE if share <= 0.46 else NO_BAG
    share = draw_share(shape)
    outfit[ARM] = POCKET if share <= 0.12 else PHONE if share <= 0.24 else SWINGING
    outfit[RELIEF_TOP], outfit[RELIEF_TROUSERS], outfit[FOLDS] = 0.75, 0.7, 0.10
    if camouflage > 0.0:
        top, trousers = draw_share(blend) < camouflage, draw_share(blend) < camouflage
        first, second = background[draw_index(blend, len(background))], background[draw_index(blend, len(background))]
        if top:
            outfit[TOP : TOP + 3] = first
            outfit[TOP_SECOND : TOP_SECOND + 3] = first * 0.94
            outfit[RELIEF_TOP] = 0.3
        if trousers:
            outfit[TROUSERS : TROUSERS + 3] = second
            outfit[RELIEF_TROUSERS] = 0.3
    sleeve = SKIN if outfit[SHORT_SLEEVE] else TOP
    outfit[SLEEVE : SLEEVE + 3] = outfit[sleeve : sleeve + 3]
