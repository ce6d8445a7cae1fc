"""Learned marker detector: a network that locates the marker in an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, load_card
from servotrack.baselines.agents.learned.network import open_session
from servotrack.baselines.agents.learned.shipped import SHIPPED
from servotrack.estimators.types import Array, Mask

IMAGE, PLACE, SEEN = "image", "place", "seen"


class MarkerNetwork:
    """Locates the marker with a network; a drop-in for `servotrack.estimators.detect.MarkerDetector`.

    Args:
        path: The ONNX file. Input `image` (N, S, S, 3) uint8; outputs `place` (N, 2), column and row in px, and `seen`
            (N,), positive if the marker is in view; both float32.
        card: Card of the network.

    Raises:
        AgentFileError: An invalid file, or one with other inputs or outputs.
    """

    def __init__(self, path: Path, card: LearnedCard) -> None:
        self._session = open_session(path, card)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shapes = {value.name: (value.type, list(value.shape)[1:]) for value in (*inputs, *outputs)}
        size = card.encoding.get("image_size")
        wanted = {
            IMAGE: ("tensor(uint8)", [size, size, 3]),
            PLACE: ("tensor(float)", [2]),
            SEEN: ("tensor(float)", []),
        }
        if shapes != wanted or [value.name for value in inputs] != [IMAGE]:
            raise AgentFileError(f"{path} must map image to place and seen, {wanted}, got {shapes}")
        self._path, self._size = path, size

    def detect(self, images: ArrayLike) -> tuple[Array, Mask]:
        """Find the marker.

        Args:
            images: RGB, uint8. Shape (*batch, S, S, 3).

        Returns:
            Positions and visibility, as `MarkerDetector.detect` returns them.

        Raises:
            ValueError: Images of another size than the training images.
        """
        stack = np.asarray(images)
        if stack.dtype != np.uint8 or stack.shape[-3:] != (self._size, self._size, 3):
            shape = f"(*batch, {self._size}, {self._size}, 3)"
            raise ValueError(
                f"images must be uint8 of shape {shape}, the size that {self._path.name} was trained with, "
                f"got {stack.dtype} {stack.shape}"
            )
        batch = stack.shape[:-3]
        place, seen = self._session.run([PLACE, SEEN], {IMAGE: stack.reshape(-1, *stack.shape[-3:])})
        return place.astype(np.float64).reshape(*batch, 2), (seen > 0.0).reshape(batch)


def open_marker_network(name: str, folder: Path | None = None) -> MarkerNetwork:
    """Open a marker network by name.

    Args:
        name: Name of its card without the suffix, or the card's path.
        folder: Folder that is searched before the package's own networks.

    Raises:
        AgentFileError: No such card, or an invalid one.
    """
    file = f"{name.removesuffix('.json')}.json"
    places = [Path(file), *([folder / file] if folder else []), SHIPPED / file]
    path = next((place for place in places if place.is_file()), places[-1])
    card = load_card(path)
    return MarkerNetwork(path.parent / card.network, card)
