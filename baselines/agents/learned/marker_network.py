"""Learned marker detector: a network that locates the marker in an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, load_card
from servotrack.baselines.agents.learned.network import LARGEST_NETWORK, NetworkSession
from servotrack.baselines.agents.learned.onnx_file.check import Row
from servotrack.baselines.agents.learned.onnx_file.reader import FLOAT, TYPES, UINT8
from servotrack.baselines.agents.learned.shipped import SHIPPED
from servotrack.baselines.reporting.files import atomic_path, read_bounded
from servotrack.estimators.types import Array, Mask

MARKER = "marker"
"""Kind of the encoding in the card of a marker network."""
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
        self._session = NetworkSession(path, card)
        form, size = self._session.form, int(card.encoding.get("image_size", 0))
        wanted = {IMAGE: Row(UINT8, (size, size, 3))}, {PLACE: Row(FLOAT, (2,)), SEEN: Row(FLOAT, ())}
        if (form.inputs, form.outputs) != wanted:
            names = {IMAGE: ("uint8", size, size, 3), PLACE: ("float32", 2), SEEN: ("float32",)}
            found = {name: (TYPES[row.kind].name, *row.shape) for name, row in {**form.inputs, **form.outputs}.items()}
            raise AgentFileError(f"{path} must map image to place and seen, with rows {names}, got {found}")
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
        name: Name of its card without folder and suffix.
        folder: Folder that is searched before the package's own networks; None: the working directory, behind them.

    Raises:
        AgentFileError: No such card, an invalid one, or one of another kind.
    """
    path = _find(name, [SHIPPED, Path()] if folder is None else [folder, SHIPPED])
    card = load_card(path)
    if card.encoding.get("kind") != MARKER:
        raise AgentFileError(f"encoding.eyes names {path}, which is not the card of a marker network")
    return MarkerNetwork(path.parent / card.network, card)


def keep_marker_network(name: str, folder: Path) -> None:
    """Copy a marker network of the working directory into a folder, so that a card there can name it.

    Args:
        name: Name of its card without folder and suffix. The package's own networks are not copied.
        folder: Folder of the card that names it.

    Raises:
        AgentFileError: No such card, or an invalid one.
    """
    path = _find(name, [SHIPPED, folder, Path()])
    if path.parent in (SHIPPED, folder):
        return
    network = load_card(path).network
    for file in (network, path.name):
        with atomic_path(folder / file) as temporary:
            temporary.write_bytes(read_bounded(path.parent / file, LARGEST_NETWORK, follow=False))


def _find(name: str, folders: list[Path]) -> Path:
    """Return the path of a card in the first folder that has it."""
    places = [folder / f"{name}.json" for folder in folders]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise AgentFileError(
            f"encoding.eyes names {name!r}, but {' and '.join(map(str, places))} are missing; put the marker network's "
            "card and its .onnx file there"
        )
    return path
