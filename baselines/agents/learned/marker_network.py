"""Learned eyes: a network that finds the marker in an image, in place of a detector that somebody wrote."""

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
    """Finds the marker by a network; a drop-in for `servotrack.estimators.detect.MarkerDetector`.

    Args:
        path: The ONNX file. Input `image` (N, S, S, 3) uint8; outputs `place` (N, 2), column and row in px, and `seen`
            (N,), positive where the marker is in view; both float32.
        card: Its card.

    Raises:
        AgentFileError: The file cannot be used, or has other inputs or outputs.
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
            As `MarkerDetector.detect`.

        Raises:
            ValueError: Images of another size than those that it learned from.
        """
        stack = np.asarray(images)
        if stack.dtype != np.uint8 or stack.shape[-3:] != (self._size, self._size, 3):
            shape = f"(*batch, {self._size}, {self._size}, 3)"
            raise ValueError(
                f"images must be uint8 of shape {shape}, as {self._path.name} knows them, "
                f"got {stack.dtype} {stack.shape}"
            )
        batch = stack.shape[:-3]
        place, seen = self._session.run([PLACE, SEEN], {IMAGE: stack.reshape(-1, *stack.shape[-3:])})
        return place.astype(np.float64).reshape(*batch, 2), (seen > 0.0).reshape(batch)


def open_marker_network(name: str, folder: Path | None = None) -> MarkerNetwork:
    """Eyes by their name.

    Args:
        name: Of their card without its suffix, or its path.
        folder: Where they are looked for before they are among the shipped ones.

    Raises:
        AgentFileError: There are none, or they cannot be used.
    """
    file = f"{name.removesuffix('.json')}.json"
    places = [Path(file), *([folder / file] if folder else []), SHIPPED / file]
    path = next((place for place in places if place.is_file()), places[-1])
    card = load_card(path)
    return MarkerNetwork(path.parent / card.network, card)
