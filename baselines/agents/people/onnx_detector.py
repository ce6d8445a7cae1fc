"""Detector from an ONNX file of the user: YOLO v5 to v11, RT-DETR, D-FINE and others with such outputs."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.baselines.agents.people.bounded_network import BoundedNetwork
from servotrack.baselines.reporting.files import ResultsError
from servotrack.estimators.detect.detections import Detections, detections_from_boxes
from servotrack.estimators.detect.images import checked_image, checked_images
from servotrack.estimators.detect.network_frames import (
    Placement,
    boxes_from_corners,
    letterbox,
    non_maximum_suppression,
    stretch,
)
from servotrack.estimators.detect.network_heads import Candidates, Head, recognize_head
from servotrack.estimators.types import Image

CONFIDENCE = 0.25
"""Smallest confidence of a detection where none is given."""
OVERLAP = 0.7
"""Intersection over union above which the less confident of two boxes is dropped."""
_MOST_BOXES = 300
_MOST_CANDIDATES = 30_000
_DEFAULT_SIDE = 640
_SIDES = (32, 8192)
_LARGEST_COORDINATE = 1e6
"""Largest distance of a box from the origin, px."""
_LARGEST_SCORE = 1.001
"""Probabilities may exceed 1 by the rounding of 16 bits."""
_MOST_CLASSES = 1_000_000
_WANTED = "person"
_MEAN, _DEVIATION = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
"""Mean and deviation of the colors of ImageNet, which RF-DETR expects to be removed."""
_INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class OnnxDetector:
    """Detector of people, or of other classes, that a network in an ONNX file finds in frames.

    Kind of outputs and size of the input are recognized from names and shapes, classes from the file's metadata. The
    file must hold its weights itself. Unlike the networks of agents it may use every operator of onnxruntime; time and
    memory are bounded, see `BoundedNetwork`.

    Args:
        path: The ONNX file.
        classes: Names or numbers of the wanted classes; None: `person`, or the only class.
        confidence: Smallest confidence, 0 to 1. Raising it drops doubtful detections.
        overlap: Intersection over union above which the less confident of two boxes of a class is dropped. Only for
            networks that do not do so themselves. Raising it keeps more boxes of people who stand together.

    Attributes:
        head: Kind of the outputs.
        size: Width and height of the input, px.
        names: Names of the classes by number; empty where the file has none.
        wanted: Numbers of the wanted classes.

    Raises:
        ResultsError: The file is missing, not regular, too large, no ONNX, refers to other files, or cannot be run.
        ValueError: Outputs of no known kind, an unknown class, or a number out of its range.
    """

    def __init__(
        self,
        path: str | Path,
        classes: Sequence[str | int] | None = None,
        confidence: float = CONFIDENCE,
        overlap: float = OVERLAP,
    ) -> None:
        for name, value in (("confidence", confidence), ("overlap", overlap)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], got {value!r}")
        self.path, self._confidence, self._overlap = Path(path), float(confidence), float(overlap)
        self._network = BoundedNetwork(self.path)
        self.names = _names(self._metadata("names"))
        self._find_input()
        self._ultralytics = bool(self._metadata("stride") or "ultralytics" in self._metadata("author").lower())
        first = self._run(np.zeros((self.size[1], self.size[0], 3), np.uint8), self.size)
        task = self._metadata("task")
        if task == "obb":
            raise ValueError(f"{self.path} finds rotated boxes, which are not supported; export a detection network")
        try:
            self.head: Head = recognize_head(
                first,
                self.size,
                len(self.names) or None,
                task in ("segment", "pose"),
                fractions="rtdetr" in (self._metadata("head") + self._metadata("description")).lower(),
            )
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error
        self.wanted = self._chosen(classes)

    def initial(self, frames: ArrayLike | Sequence[ArrayLike]) -> tuple[int, ...]:
        """Return the state: the shape that all frames have.

        Args:
            frames: One frame in the form of `step`, or several.

        Raises:
            ValueError: A frame is not valid.
        """
        return checked_images(frames)[0].shape

    def step(self, state: tuple[int, ...], frame: ArrayLike) -> tuple[tuple[int, ...], Detections]:
        """Detect in a frame.

        Args:
            state: Result of `initial`.
            frame: RGB, uint8, shape (H, W, 3), or gray, shape (H, W).

        Returns:
            The state, and detections in px of the frame, most confident first.

        Raises:
            ValueError: The frame has another type or shape.
            ResultsError: The network fails, takes too long or too much memory, or gives boxes that cannot be.
        """
        return state, self.detect(checked_image(frame, "frame", state))[0]

    def detect(self, frame: ArrayLike) -> tuple[Detections, NDArray[np.int64]]:
        """Return the detections in a frame of any size, and the class of each; see `step`."""
        image = checked_image(frame)
        if image.ndim == 2:
            image = np.repeat(image[..., None], 3, axis=2)
        prepared, place = self._prepared(image)
        outputs = self._run(prepared, place.size)
        with np.errstate(over="ignore", invalid="ignore"):
            candidates = self.head.candidates(outputs, self.size, self._confidence)
        found = self._selected(self._checked(candidates))
        corners = self._in_frame(found.corners, place)
        return detections_from_boxes(boxes_from_corners(corners), found.scores.astype(np.float64)), found.classes

    def _prepared(self, image: Image) -> tuple[Image, Placement]:
        if self.head.kind in ("dense", "listed"):
            return letterbox(image, self.size)
        return stretch(image, self.size, smooth=not self._ultralytics)

    def _checked(self, found: Candidates) -> Candidates:
        """Return boxes that can be; others would be left out in silence, or spoil the tracks."""
        for what, values, least, most in (
            ("a confidence", found.scores, 0.0, _LARGEST_SCORE),
            ("a corner at (px)", found.corners, -_LARGEST_COORDINATE, _LARGEST_COORDINATE),
            ("a class", found.classes, 0, _MOST_CLASSES),
        ):
            good = (values >= least) & (values <= most)
            if not good.all():
                raise ResultsError(
                    f"{self.path} gives {what} {values[~good].flat[0]}, which cannot be; its outputs are damaged, or "
                    "not of the kind that their shapes say: export the network anew"
                )
        return found._replace(scores=np.minimum(found.scores, np.float32(1.0)))

    def _selected(self, found: Candidates) -> Candidates:
        """Return the boxes of wanted classes, the most confident ones, without those that better ones cover."""
        kept = np.flatnonzero(np.isin(found.classes, self.wanted))
        kept = kept[np.argsort(-found.scores[kept], kind="stable")]
        if self.head.kind == "dense":
            kept = kept[:_MOST_CANDIDATES]
            chosen = non_maximum_suppression(
                found.corners[kept], found.scores[kept], found.classes[kept], self._overlap, _MOST_BOXES
            )
            kept = kept[chosen]
        return Candidates(found.corners[kept], found.scores[kept], found.classes[kept])

    def _in_frame(self, corners: NDArray[np.float32], place: Placement) -> NDArray[np.float32]:
        if self.head.kind != "scaled":
            return place.to_frame(corners)
        width, height = place.size
        return np.clip(corners, 0.0, np.array([width, height, width, height], np.float32))

    def _metadata(self, key: str) -> str:
        return self._network.metadata.get(key, "")

    def _find_input(self) -> None:
        """Find the image among the inputs, its type and size, and the size of the frame if there is one."""
        ports = self._network.inputs
        images = [port for port in ports if len(port.shape) == 4]
        others = [port for port in ports if len(port.shape) != 4]
        described = ", ".join(f"{port.name} {port.shape}" for port in ports)
        if len(images) != 1 or len(others) > 1:
            raise ValueError(f"{self.path}: inputs must be an image and at most the size of the frame, got {described}")
        image = images[0]
        batch, channels, height, width = image.shape
        if channels != 3 or image.type not in _INPUT_TYPES or (isinstance(batch, int) and batch > 1):
            raise ValueError(
                f"{self.path}: the input must be one RGB image of shape (1, 3, height, width), got {described} of "
                f"{image.type}; export it so"
            )
        sides = _sides(self._metadata("imgsz"))
        self.size: tuple[int, int] = (
            width if isinstance(width, int) else sides[1],
            height if isinstance(height, int) else sides[0],
        )
        if not all(_SIDES[0] <= side <= _SIDES[1] for side in self.size):
            raise ValueError(f"{self.path}: the input must have sides from 32 to 8192 px, got {self.size}")
        self._image, self._type = image.name, _INPUT_TYPES[image.type]
        self._frame_size = others[0].name if others else None
        self._normalizes = {"dets", "labels"} <= {name.lower() for name in self._network.outputs}

    def _run(self, image: Image, frame_size: tuple[int, int]) -> dict[str, NDArray[Any]]:
        """Return the outputs for an image of the input's size."""
        values: NDArray[Any] = image
        if self._type != np.uint8:
            values = image.astype(np.float32) / np.float32(255.0)
            if self._normalizes:
                values = (values - _MEAN) / _DEVIATION
        inputs = {self._image: np.ascontiguousarray(values.transpose(2, 0, 1)[None].astype(self._type))}
        if self._frame_size is not None:
            inputs[self._frame_size] = np.array([frame_size], np.int64)
        return self._network.run(inputs)

    def _chosen(self, classes: Sequence[str | int] | None) -> tuple[int, ...]:
        """Return the numbers of the wanted classes."""
        by_name = {name.lower(): number for number, name in self.names.items()}
        count = self.head.classes
        if classes is None:
            if _WANTED in by_name:
                return (by_name[_WANTED],)
            if count == 1 or len(by_name) == 1:
                return (0,) if count == 1 else tuple(by_name.values())
            known = f"known are {', '.join(list(self.names.values())[:20])}" if self.names else "it names none"
            raise ValueError(
                f"{self.path} has no class {_WANTED!r} ({known}); give its classes by number or name. Networks for "
                "COCO have people at 0 (80 classes) or 1 (91 classes)"
            )
        return tuple(self._class_number(one, by_name, count) for one in classes)

    def _class_number(self, wanted: str | int, by_name: Mapping[str, int], count: int | None) -> int:
        text = str(wanted).strip()
        if text.lower() in by_name:
            return by_name[text.lower()]
        number = int(text) if text.isascii() and text.isdecimal() and len(text) < 7 else -1
        if number < 0 or (count is not None and number >= count):
            known = ", ".join(list(by_name)[:20]) or (f"numbers from 0 to {count - 1}" if count else "numbers")
            raise ValueError(f"{self.path} has no class {text!r}; known are {known}")
        return number


def _names(text: str) -> dict[int, str]:
    """Return names of classes by number, from the metadata that exporters write as a Python or JSON dictionary."""
    found = _literal(text)
    if isinstance(found, list):
        found = dict(enumerate(found))
    if not isinstance(found, dict):
        return {}
    short = {number: name for number, name in found.items() if isinstance(name, str) and _is_class(number)}
    return {int(number): name for number, name in short.items()}


def _is_class(number: Any) -> bool:
    """Return True for the number of a class, which JSON writes as text."""
    if isinstance(number, str):
        return number.isdecimal() and len(number) < len(str(_MOST_CLASSES))
    return isinstance(number, int) and 0 <= number < _MOST_CLASSES


def _sides(text: str) -> tuple[int, int]:
    """Return height and width from the metadata `imgsz`."""
    found = _literal(text)
    sides = [found, found] if isinstance(found, int) else list(found) if isinstance(found, list | tuple) else []
    if len(sides) == 2 and all(type(side) is int and 0 < side <= _SIDES[1] for side in sides):
        return sides[0], sides[1]
    return _DEFAULT_SIDE, _DEFAULT_SIDE


def _literal(text: str) -> Any:
    """Return the value of a Python literal; None for other text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None
