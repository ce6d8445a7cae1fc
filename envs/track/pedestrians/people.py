"""Where people are in the image at one frame: what moves them hands this to what draws them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.types import Array, Labels


class People(NamedTuple):
    """The n people of one frame, in any order; pixel i spans i to i + 1.

    Attributes:
        ids: Identities, at least 1, each for life. Shape (n,), int.
        feet: Where they stand: the middle between the feet, column and row. Shape (n, 2), px.
        height: From sole to crown, standing upright. Shape (n,), px.
        heading: Where they face: 0 to the right, pi/2 away from the camera. Shape (n,), rad.
        phase: Of the gait; one stride of two steps is 2 pi. Shape (n,), rad.
        stride: How far arms and legs swing: 0 standing, 1 walking at full pace. Shape (n,).
        outfit_seeds: Seed of a person's clothes, skin, build. Shape (n,), int.
    """

    ids: Labels
    feet: Array
    height: Array
    heading: Array
    phase: Array
    stride: Array
    outfit_seeds: Labels


class Drawn(NamedTuple):
    """A drawn frame and its truth.

    Attributes:
        image: RGB, uint8. Shape (H, W, 3).
        boxes: Smallest box around each person's whole silhouette, hidden parts included, cut at the image's border:
            left, top, width, height; zeros where nothing of it lies inside. Shape (n, 4), px.
        visibility: Share of each silhouette's pixels that can be seen; what lies outside the image cannot. Shape (n,).
        owners: Which person a pixel belongs to, as a row of `People` + 1; 0 is background, an occluder too.
            Shape (H, W), uint8.
    """

    image: NDArray[np.uint8]
    boxes: Array
    visibility: Array
    owners: NDArray[np.uint8]
