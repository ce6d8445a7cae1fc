"""People of one frame in image coordinates: the interface between movement and rendering."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.types import Array, Labels


class People(NamedTuple):
    """People of one frame, n in any order. Pixel i covers [i, i + 1].

    Attributes:
        ids: Identities, at least 1, constant for a person, shape (n,), int.
        feet: Middle between the feet, column and row, shape (n, 2), px.
        height: Height of the upright body, shape (n,), px.
        heading: Direction that the body faces: 0 to the right, pi/2 away from the camera, shape (n,), rad.
        phase: Phase of the gait; a stride of two steps is 2 pi, shape (n,), rad.
        stride: Swing of arms and legs: 0 standing, 1 walking at full pace, shape (n,).
        outfit_seeds: Seeds of clothes, skin and build, shape (n,), int.
    """

    ids: Labels
    feet: Array
    height: Array
    heading: Array
    phase: Array
    stride: Array
    outfit_seeds: Labels


class Drawn(NamedTuple):
    """Rendered frame and its ground truth.

    Attributes:
        image: RGB image, shape (H, W, 3), uint8.
        boxes: Bounding box (left, top, width, height) of each whole silhouette, including occluded parts, clipped at
            the image border, shape (n, 4), px; zeros if the silhouette lies outside.
        visibility: Share of the pixels of each silhouette that is visible; parts outside the image are not, shape (n,).
        owners: Person of each pixel, as row of `People` + 1; 0 for background and occluders, shape (H, W), uint8.
    """

    image: NDArray[np.uint8]
    boxes: Array
    visibility: Array
    owners: NDArray[np.uint8]
