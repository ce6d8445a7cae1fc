"""Random outfits: build, skin, hair and clothes of a person as a vector of numbers, drawn from one seed."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from servotrack.envs.streams import Streams
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

_SKINS = ((236, 196, 168), (224, 172, 138), (198, 146, 110), (150, 104, 74), (104, 70, 50), (74, 50, 38))
_HAIRS = (
    (26, 22, 20),
    (34, 26, 22),
    (44, 32, 24),
    (60, 42, 30),
    (78, 54, 36),
    (112, 78, 46),
    (160, 126, 80),
    (140, 138, 134),
)
_CLOTHES = (
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
)
_TROUSERS = (
    (26, 28, 36),
    (34, 46, 74),
    (42, 58, 92),
    (22, 22, 24),
    (46, 40, 36),
    (32, 42, 38),
    (54, 32, 32),
)
_SHOES = ((22, 20, 20), (54, 34, 24), (30, 30, 36), (216, 216, 214))
_BAGS = ((60, 36, 24), (24, 24, 28), (140, 30, 36), (30, 60, 90), (176, 120, 60))


def draw_outfit(seed: int, camouflage: float, background: Array) -> Array:
    """Draw an outfit from a seed.

    Args:
        seed: Seed of the outfit.
        camouflage: Probability that a piece of clothing has a background color, 0 to 1.
        background: Background colors, shape (k, 3), gray levels.

    Returns:
        Outfit, shape (OUTFIT_NUMBERS,).
    """
    streams = Streams(seed)
    return compose_outfit(streams[_SHAPE], streams[_PAINT], streams[_BLEND], camouflage, background)


def compose_outfit(
    shape: np.random.Generator,
    paint: np.random.Generator,
    blend: np.random.Generator,
    camouflage: float,
    background: Array,
) -> Array:
    """Draw an outfit from generators, which may be the same object.

    Args:
        shape: Generator of build, cut and bags.
        paint: Generator of colors.
        blend: Generator of the choice of background colors.
        camouflage: Probability that a piece of clothing has a background color, 0 to 1.
        background: Background colors, shape (k, 3), gray levels.

    Returns:
        Outfit, shape (OUTFIT_NUMBERS,).
    """
    outfit = np.zeros(OUTFIT_NUMBERS)

    def choose(colors: tuple[tuple[int, int, int], ...], spread: float) -> list[float]:
        chosen, brightness = colors[int(paint.integers(len(colors)))], paint.uniform(1.0 - spread, 1.0 + spread)
        return [min(max(channel * brightness, 8.0), 250.0) for channel in chosen]

    for part, colors, spread in (
        (SKIN, _SKINS, 0.06),
        (HAIR, _HAIRS, 0.15),
        (TOP, _CLOTHES, 0.12),
        (TOP_SECOND, _CLOTHES, 0.12),
        (TROUSERS, _TROUSERS, 0.2),
        (SHOES, _SHOES, 0.1),
        (BAG_COLOR, _BAGS, 0.15),
    ):
        outfit[part : part + 3] = choose(colors, spread)
    outfit[BUILD] = shape.uniform(0.92, 1.12)
    outfit[HEAD_SIZE] = shape.uniform(0.96, 1.06)
    outfit[HAIRLINE] = shape.uniform(-0.2, 0.25)
    long_hair = shape.random() < 0.38
    outfit[HAIR_LENGTH] = shape.uniform(0.05, 0.14) if long_hair else 0.0
    kind = shape.random()
    outfit[TOP_MATERIAL] = 0 if kind < 0.42 else 2 if kind < 0.75 else 3 if kind < 0.88 else 4
    outfit[TOP_DETAIL] = (0.0, 0.0, shape.uniform(0.22, 0.42), shape.integers(4, 8), shape.integers(3, 6))[
        int(outfit[TOP_MATERIAL])
    ]
    outfit[COAT] = shape.uniform(0.08, 0.2) if outfit[TOP_MATERIAL] in (0, 2) and shape.random() < 0.3 else 0.03
    outfit[SHORT_SLEEVE] = float(outfit[TOP_MATERIAL] != 2 and shape.random() < 0.35)
    outfit[SKIRT] = shape.uniform(0.2, 0.3) if long_hair and shape.random() < 0.4 else 0.0
    outfit[BAG] = (BACKPACK, SHOULDER_BAG, CASE, NO_BAG)[bisect_left((0.18, 0.34, 0.46), shape.random())]
    outfit[ARM] = (POCKET, PHONE, SWINGING)[bisect_left((0.12, 0.24), shape.random())]
    outfit[RELIEF_TOP], outfit[RELIEF_TROUSERS], outfit[FOLDS] = 0.75, 0.7, 0.10
    if camouflage > 0.0:
        blends, chosen = blend.random(2) < camouflage, background[blend.integers(len(background), size=2)]
        if blends[0]:
            outfit[TOP : TOP + 3] = chosen[0]
            outfit[TOP_SECOND : TOP_SECOND + 3] = chosen[0] * 0.94
            outfit[RELIEF_TOP] = 0.3
        if blends[1]:
            outfit[TROUSERS : TROUSERS + 3] = chosen[1]
            outfit[RELIEF_TROUSERS] = 0.3
    sleeve = SKIN if outfit[SHORT_SLEEVE] else TOP
    outfit[SLEEVE : SLEEVE + 3] = outfit[sleeve : sleeve + 3]
    return outfit
