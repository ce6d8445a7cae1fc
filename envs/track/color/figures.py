"""Random people of color tracking scenes: body, hair, face and fringe as layers that shift against each other."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from servotrack.envs.track.color.layers import Canvas, Color, Layer, Placement, oval, put
from servotrack.estimators.elementary import exponential
from servotrack.estimators.types import Array, Image

HEAD = 72.0
"""Height of a head in its layers, px."""
_SKINS = ((238, 196, 164), (224, 172, 134), (205, 148, 108), (168, 112, 76), (120, 78, 54), (92, 60, 44))
_HAIRS = ((40, 30, 26), (74, 50, 34), (116, 76, 44), (176, 132, 76), (206, 172, 110), (130, 52, 30), (150, 148, 146))
_CLOTHES = (
    (178, 48, 44), (44, 82, 150), (52, 112, 76), (228, 186, 70), (96, 62, 120), (60, 62, 70), (214, 212, 206),
    (210, 118, 56), (58, 140, 150), (150, 96, 70),
)  # fmt: skip
_TROUSERS = ((44, 54, 82), (52, 50, 50), (98, 88, 72), (70, 78, 66), (120, 110, 98))
HAIR_STYLES = ("short", "bob", "long", "bun", "cap")


class Appearance(NamedTuple):
    """Colors and styles of one person.

    Attributes:
        skin: Color of the face.
        hair: Color of the hair, or of a cap.
        clothes: Main color of the clothes.
        stripes: Second color of the clothes.
        style: Index of the hair style in `HAIR_STYLES`.
        pattern: Pattern of the clothes: 0 plain, 1 stripes, 2 checks.
    """

    skin: Color
    hair: Color
    clothes: Color
    stripes: Color
    style: int
    pattern: int


class Figure(NamedTuple):
    """Layers of one person, from back to front. The true box encloses hair, face and fringe."""

    body: Layer
    hair: Layer
    face: Layer
    fringe: Layer


def draw_appearance(rng: np.random.Generator) -> Appearance:
    """Draw a random appearance."""
    skin, hair, clothes, stripes = (_varied(rng, palette) for palette in (_SKINS, _HAIRS, _CLOTHES, _CLOTHES))
    style, pattern = int(rng.integers(len(HAIR_STYLES))), int(rng.integers(3))
    if HAIR_STYLES[style] == "cap":
        hair = stripes
    return Appearance(skin, hair, clothes, stripes, style, pattern)


def similar_appearance(like: Appearance, rng: np.random.Generator, similarity: float) -> Appearance:
    """Draw an appearance that resembles another one.

    Skin and hair are mixed with the weight `similarity` (0 to 1), clothes only with 0.4 times it: heads are tracked, so
    a distractor must have a similar head.
    """
    other = draw_appearance(rng)
    skin, hair = (_mix(theirs, own, similarity) for theirs, own in ((other.skin, like.skin), (other.hair, like.hair)))
    style = like.style if rng.random() < similarity else other.style
    return Appearance(
        skin, hair, _mix(other.clothes, like.clothes, 0.4 * similarity), other.stripes, style, other.pattern
    )


def paint_figure(appearance: Appearance, rng: np.random.Generator) -> Figure:
    """Paint the layers of a person. `rng` decides strands, folds and the proportions of the face."""
    return Figure(_body(appearance, rng), _hair(appearance, rng), _face(appearance, rng), _fringe(appearance, rng))


def put_figure(
    image: Image, figure: Figure, center: Array, height: float, roll: float, yaw: float, turn: float
) -> None:
    """Draw a figure into an image, in place.

    Args:
        image: Image to change, shape (H, W, 3).
        figure: Person to draw.
        center: Center of the head, shape (2,), px.
        height: Height of the head, px.
        roll: Roll of the head, rad.
        yaw: Turn of the head to the side, -1 to 1.
        turn: Rotation of the whole figure about the head, rad.
    """
    body = Placement(float(center[0]), float(center[1]), height / HEAD, 0.25 * roll + turn, -0.05 * yaw * HEAD)
    put(image, figure.body, body)
    for layer, placement in zip(figure[1:], _head(center, height, roll + turn, yaw), strict=True):
        put(image, layer, placement)


def head_boxes(figure: Figure, centers: Array, heights: Array, rolls: Array, yaws: Array, turns: Array) -> Array:
    """Return the bounding boxes of a head (hair and face) as `put_figure` draws it, including occluded parts.

    Args:
        figure: Person.
        centers: Center of the head in every frame, shape (F, 2), px.
        heights: Height of the head, shape (F,), px.
        rolls: Roll of the head, shape (F,), rad.
        yaws: Turn of the head to the side, -1 to 1, shape (F,).
        turns: Rotation of the whole figure about the head, shape (F,), rad.

    Returns:
        Left, top, width and height of the boxes, shape (F, 4), px.
    """
    poses = zip(centers, heights.tolist(), (rolls + turns).tolist(), yaws.tolist(), strict=True)
    heads = [_head(*pose) for pose in poses]
    lows, highs = [], []
    for number, layer in enumerate(figure[1:]):
        x, y, scale, roll, shift, squash = np.array([head[number] for head in heads]).T[:, :, None]
        u, v = squash * layer.outline[:, 0] + shift, layer.outline[:, 1]
        cos, sin = scale * np.cos(roll), scale * np.sin(roll)
        points = np.stack([x + cos * u - sin * v, y + sin * u + cos * v], axis=2)
        lows.append(points.min(axis=1))
        highs.append(points.max(axis=1))
    low, high = np.minimum.reduce(lows), np.maximum.reduce(highs)
    return np.concatenate([low, high - low], axis=1)


def _head(center: Array, height: float, roll: float, yaw: float) -> tuple[Placement, Placement, Placement]:
    """Return the placements of hair, face and fringe. With yaw the face shifts and narrows; the fringe shifts half."""
    narrow = math.sqrt(1.0 - (0.7 * yaw) ** 2)
    # The shift keeps the face inside the head: the room that its narrowing leaves, plus a small part of the hair.
    aside = HEAD * (0.31 * math.copysign(1.0 - narrow, yaw) + 0.05 * yaw)
    hair = Placement(float(center[0]), float(center[1]), height / HEAD, roll)
    return hair, hair._replace(shift=aside, squash=narrow), hair._replace(shift=0.5 * aside)


def _varied(rng: np.random.Generator, palette: tuple[Color, ...]) -> Color:
    base = np.array(palette[int(rng.integers(len(palette)))])
    varied = np.clip(base * rng.uniform(0.88, 1.12, 3), 12.0, 245.0)
    return (float(varied[0]), float(varied[1]), float(varied[2]))


def _mix(a: Color, b: Color, share: float) -> Color:
    """Mix two colors; `share` is the weight of b."""
    return tuple((1.0 - share) * x + share * y for x, y in zip(a, b, strict=True))  # type: ignore[return-value]


def _canvas() -> Canvas:
    return Canvas(-64, -52, 128, 128)


def _strands(rng: np.random.Generator, columns: int = 26) -> Array:
    """Return vertical light and dark lines, brightest near the top."""
    lines = 1.0 + 0.16 * rng.standard_normal((1, columns))
    sheen = 1.0 + 0.28 * exponential(-(((np.linspace(0.0, 1.0, 12) - 0.24) / 0.12) ** 2))[:, None]
    return np.clip(lines * sheen + 0.03 * rng.standard_normal((12, columns)), 0.45, 1.6)


def _hair(appearance: Appearance, rng: np.random.Generator) -> Layer:
    canvas = _canvas()
    color = canvas.shades(appearance.hair, _strands(rng))
    style = HAIR_STYLES[appearance.style]
    if style == "bun":
        canvas.paint(oval(0, -38, 11, 9), color)
    canvas.paint(oval(0, -3, 29, 33), color)
    if style in ("bob", "long"):
        bottom = 24.0 if style == "bob" else 44.0
        width = rng.uniform(28.0, 32.0)
        side = np.array([[-29, -4], [29, -4], [width, bottom - 6], [width - 7, bottom], [7 - width, bottom],
                         [-width, bottom - 6]])  # fmt: skip
        canvas.paint(side, color)
    return canvas.layer()


def _face(appearance: Appearance, rng: np.random.Generator) -> Layer:
    canvas = _canvas()
    x, y = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32))
    side = rng.choice([-1.0, 1.0])
    light = 1.02 + 0.22 * side * x - 0.06 * y - 0.5 * x**2 + 0.012 * rng.standard_normal(x.shape)
    skin = canvas.shades(appearance.skin, light)
    width, chin = rng.uniform(22.5, 25.5), rng.uniform(33.0, 36.0)
    jaw = oval(0, 2, width, chin)
    jaw[:, 0] *= 1.0 - 0.13 * np.clip((jaw[:, 1] - 8.0) / 28.0, 0.0, 1.0)
    for sign in (-1.0, 1.0):
        canvas.paint(oval(sign * width, 5, 3.6, 6.2), canvas.shades(appearance.skin, 0.84 * light))
    canvas.paint(jaw, skin)
    dark = _mix(appearance.skin, (30.0, 18.0, 16.0), 0.62)
    brow = _mix(appearance.hair, (30.0, 20.0, 16.0), 0.5)
    eye = _varied(rng, ((62, 44, 30), (84, 112, 140), (70, 96, 70)))
    apart = rng.uniform(9.0, 10.8)
    for sign in (-1.0, 1.0):
        canvas.paint(oval(sign * apart, -2, 5.2, 2.9), (236.0, 233.0, 228.0))
        canvas.paint(oval(sign * apart, -2, 2.5, 2.7), eye)
        canvas.paint(oval(sign * apart, -2, 1.2, 1.3), (14.0, 12.0, 12.0))
        canvas.paint(np.array([[sign * (apart - 6), -7.0], [sign * (apart + 6), -8.2], [sign * (apart + 6.6), -6.6],
                               [sign * (apart - 6), -5.2]]), brow)  # fmt: skip
    nose = np.array([[0.6, -1.0], [2.8, 11.0], [-3.2, 11.0], [-2.4, 9.4]])
    canvas.paint(nose, _mix(appearance.skin, (110.0, 60.0, 44.0), 0.34))
    canvas.paint(oval(0, 19, rng.uniform(6.5, 8.5), 2.6), _mix(appearance.skin, (165.0, 52.0, 56.0), 0.68))
    canvas.paint(np.array([[-6.5, 18.6], [6.5, 18.6], [6.5, 19.4], [-6.5, 19.4]]), dark)
    if rng.random() < 0.3:
        beard = oval(0, 6, width * 0.98, chin - 4.5, 18.0, 162.0)
        inner = oval(0, 8, width * 0.5, 15.0, 165.0, 15.0)
        canvas.paint(
            np.concatenate([beard, inner]), canvas.shades(_mix(appearance.hair, dark, 0.3), light), inside=True
        )
    return canvas.layer()


def _fringe(appearance: Appearance, rng: np.random.Generator) -> Layer:
    canvas = _canvas()
    color = canvas.shades(appearance.hair, _strands(rng))
    if HAIR_STYLES[appearance.style] == "cap":
        canvas.paint(oval(0, -8, 29.5, 30, 180.0, 360.0), color)
        canvas.paint(oval(0, -10, 25, 6.0), canvas.shades(appearance.hair, np.full((4, 4), 0.62)))
        return canvas.layer()
    height = rng.uniform(8.0, 15.0)
    part = rng.uniform(-12.0, 12.0)
    top = oval(0, -3, 28.5, 33, 192.0, 348.0)
    under = np.array([[26.0, -10.0], [part + 9.0, -30.0 + height], [part, -26.0 + 0.4 * height],
                      [part - 9.0, -30.0 + height], [-26.0, -10.0]])  # fmt: skip
    canvas.paint(np.concatenate([top, under]), color)
    return canvas.layer()


def _body(appearance: Appearance, rng: np.random.Generator) -> Layer:
    """Paint shoulders, hanging arms and trousers down to the knees."""
    canvas = Canvas(-84, 14, 168, 366)
    x = np.linspace(-1.0, 1.0, 40)[None, :]
    folds = cv2.resize(rng.standard_normal((13, 9)), (40, 60), interpolation=cv2.INTER_CUBIC)
    light = 1.0 - 0.4 * x**2 + 0.1 * x + 0.07 * folds
    half = rng.uniform(60.0, 68.0)
    hips = 0.68 * half
    trousers = _varied(rng, _TROUSERS)
    legs = np.array([[-hips, 205.0], [hips, 205.0], [hips - 4, 375.0], [5.0, 375.0], [0.0, 250.0], [-5.0, 375.0],
                     [4 - hips, 375.0]])  # fmt: skip
    canvas.paint(legs, canvas.shades(trousers, light))
    hand = canvas.shades(appearance.skin, 0.8 * light)
    for sign in (-1.0, 1.0):
        canvas.paint(oval(sign * (half + 3), 246, 9, 13), hand)
    shirt, second = canvas.shades(appearance.clothes, light), canvas.shades(appearance.stripes, light)
    trunk = np.concatenate([
        np.array([[-15.0, 46.0]]), oval(24 - half, 80, 26, 24, 255.0, 180.0),
        np.array([[-half - 9, 240.0], [11 - half, 240.0], [17 - half, 120.0], [-hips - 2, 225.0], [hips + 2, 225.0],
                  [half - 17, 120.0], [half - 11, 240.0], [half + 9, 240.0]]),
        oval(half - 24, 80, 26, 24, 360.0, 285.0), np.array([[15.0, 46.0]]),
    ])  # fmt: skip
    canvas.paint(trunk, shirt)
    if appearance.pattern:
        step = rng.uniform(14.0, 22.0)
        # The pattern covers only the shirt and ends at the hips.
        for k in range(int(170.0 / step)):
            at = 48.0 + k * step
            band = np.array(
                [[-half - 9, at], [half + 9, at], [half + 9, at + 0.42 * step], [-half - 9, at + 0.42 * step]]
            )
            canvas.paint(band, second, inside=True)
        for k in range(int(168.0 / step) if appearance.pattern == 2 else 0):
            at = -84.0 + k * step
            band = np.array([[at, 46.0], [at + 0.3 * step, 46.0], [at + 0.3 * step, 222.0], [at, 222.0]])
            canvas.paint(band, second, inside=True)
    neck = np.array([[-12.0, 22.0], [12.0, 22.0], [13.0, 46.0], [7.0, 58.0], [0.0, 62.0], [-7.0, 58.0], [-13.0, 46.0]])
    canvas.paint(neck, canvas.shades(appearance.skin, np.linspace(0.55, 1.0, 8)[:, None] * np.ones((1, 8))))
    return canvas.layer()
