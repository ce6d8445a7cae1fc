"""Outputs of detection networks: which kind they are, by names and shapes, and the boxes in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.detect.network_frames import centered_corners


class Candidates(NamedTuple):
    """Boxes that a network gives for a frame.

    Attributes:
        corners: Left, top, right, bottom, px of the input, or of the frame if the network scales them. Shape (k, 4).
        scores: Confidences from 0 to 1, shape (k,).
        classes: Class of each box, shape (k,).
    """

    corners: NDArray[np.float32]
    scores: NDArray[np.float32]
    classes: NDArray[np.int64]


@dataclass(frozen=True)
class Head:
    """Kind of the outputs of a network.

    Attributes:
        kind: `dense` (YOLO v5 to v11 before non-maximum suppression), `listed` (left, top, right, bottom, score,
            class), `chosen` (RT-DETR: center x, center y, width, height in fractions of the input, score, class),
            `queries` (RT-DETR: such boxes and the scores of all classes), `logits` (boxes and logits apart), or
            `scaled` (labels, boxes in px of the frame, and scores: D-FINE, RT-DETR).
        outputs: Names of the outputs that are read: for `logits` boxes and logits, for `scaled` labels, boxes, scores.
        classes: Number of classes; None where the outputs do not show it.
        transposed: True if the numbers of a box are the second axis of a `dense` output.
        objectness: True if a `dense` output has a score of its own for objects of any class.
    """

    kind: str
    outputs: tuple[str, ...]
    classes: int | None
    transposed: bool = False
    objectness: bool = False

    def candidates(self, outputs: Mapping[str, NDArray[Any]], size: tuple[int, int], least: float) -> Candidates:
        """Return the boxes of one frame with scores above `least`.

        Args:
            outputs: Outputs of the network by name, for a batch of one.
            size: Width and height of the input, px.
            least: Smallest score.
        """
        first = np.asarray(outputs[self.outputs[0]][0])
        if self.kind == "dense":
            return self._dense(first.T if self.transposed else first, least)
        if self.kind in ("listed", "chosen"):
            scores, boxes = first[:, 4].astype(np.float32), first[:, :4].astype(np.float32)
            if self.kind == "chosen":
                boxes = centered_corners(_in_input(boxes, size))
            kept = scores > least
            return Candidates(boxes[kept], scores[kept], first[kept, 5].round().astype(np.int64))
        if self.kind == "scaled":
            scores, boxes = np.asarray(outputs[self.outputs[2]][0]), np.asarray(outputs[self.outputs[1]][0])
            kept = scores > least
            return Candidates(
                boxes[kept].astype(np.float32), scores[kept].astype(np.float32), first[kept].astype(np.int64)
            )
        if self.kind == "queries":
            return _best(first[:, 4:], _in_input(first[:, :4], size), least)
        logits = np.asarray(outputs[self.outputs[1]][0], dtype=np.float32)
        return _best(_probabilities(logits), _in_input(first, size), least)

    def _dense(self, rows: NDArray[Any], least: float) -> Candidates:
        assert self.classes is not None
        begin = 4 + self.objectness
        rows = rows[:, : begin + self.classes].astype(np.float32)
        scores = rows[:, begin:]
        if self.objectness:
            # First as in the networks' own code, which saves time, too.
            rows = rows[rows[:, 4] > least]
            scores = rows[:, begin:] * rows[:, 4 : 4 + 1]
        return _best(scores, rows[:, :4], least)


def recognize_head(
    outputs: Mapping[str, NDArray[Any]],
    size: tuple[int, int],
    classes: int | None,
    extra: bool,
    fractions: bool = False,
) -> Head:
    """Return the kind of a network's outputs.

    Args:
        outputs: Outputs for a batch of one, by name.
        size: Width and height of the input, px.
        classes: Number of classes that the network's file names; None where it names none.
        fractions: True if the file says that its boxes are fractions of the input; else that follows from the numbers.
        extra: True if the file says that boxes carry more numbers behind the scores, as for masks or key points.

    Raises:
        ValueError: Outputs of no known kind.
    """
    shapes = {name: values.shape for name, values in outputs.items()}
    cubes = {name: shape for name, shape in shapes.items() if len(shape) == 3 and shape[0] == 1}
    if scaled := _scaled(outputs):
        return Head("scaled", scaled, classes)
    boxes = [name for name, shape in cubes.items() if shape[2] == 4]
    logits = [name for name, shape in cubes.items() if name not in boxes and boxes and shape[1] == cubes[boxes[0]][1]]
    if len(boxes) == 1 and len(logits) == 1:
        return Head("logits", (boxes[0], logits[0]), cubes[logits[0]][2])
    for name in cubes:
        if head := _single(name, outputs[name], size, classes, extra):
            inside = outputs[name][..., :4]
            small = bool(inside.any()) and _are_fractions(inside)
            return replace(head, kind="chosen") if head.kind == "listed" and (fractions or small) else head
    described = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
    raise ValueError(
        f"outputs {described} are of no known detection network; known are YOLO v5 to v11 (1, 4 + classes, boxes) or "
        "(1, boxes, 5 + classes), with non-maximum suppression built in (1, boxes, 6), RT-DETR and D-FINE (boxes and "
        "logits, or labels, boxes and scores)"
    )


def _scaled(outputs: Mapping[str, NDArray[Any]]) -> tuple[str, ...]:
    """Return the names of labels, boxes and scores; () if the outputs are others."""
    shapes = {name: values.shape for name, values in outputs.items()}
    flat = [name for name, shape in shapes.items() if len(shape) == 2]
    boxes = [name for name, shape in shapes.items() if len(shape) == 3 and shape[2] == 4]
    labels = [name for name in flat if outputs[name].dtype.kind in "iu"] or [
        name for name in flat if "label" in name.lower()
    ]
    scores = [name for name in flat if name not in labels]
    if len(boxes) == len(labels) == len(scores) == 1:
        return labels[0], boxes[0], scores[0]
    return ()


def _single(name: str, values: NDArray[Any], size: tuple[int, int], classes: int | None, extra: bool) -> Head | None:
    """Return the head of one output (1, boxes, numbers) or (1, numbers, boxes); None if it is of no known kind."""
    counts, shape = _grid_counts(size), values.shape
    if shape[1] in counts and shape[2] > 4:
        return _dense_head(name, shape[2], False, classes, extra)
    if shape[2] in counts and shape[1] > 4:
        return _dense_head(name, shape[1], True, classes, extra)
    listed = shape[2] == 4 + 2 or (extra and shape[2] > 4 + 2 and classes != shape[2] - 4)
    # Two classes of RT-DETR have as many columns as a score and a class.
    if listed and (classes != 2 or (values[..., 5] == np.rint(values[..., 5])).all()):
        return Head("listed", (name,), classes)
    found = shape[2] - 4
    if found >= 1 and (classes is None or classes == found) and shape[1] > found:
        return Head("queries", (name,), found)
    return None


def _dense_head(name: str, numbers: int, transposed: bool, classes: int | None, extra: bool) -> Head | None:
    if classes is None:
        # YOLO v5 to v7 list boxes and have an objectness; later ones have neither.
        count = numbers - 4 - (not transposed)
        return Head("dense", (name,), count, transposed, not transposed) if count >= 1 else None
    if numbers == 4 + classes or (extra and transposed and numbers > 4 + classes):
        return Head("dense", (name,), classes, transposed)
    if numbers == 4 + 1 + classes or (extra and not transposed and numbers > 4 + 1 + classes):
        return Head("dense", (name,), classes, transposed, True)
    return None


def _grid_counts(size: tuple[int, int]) -> set[int]:
    """Return the numbers of boxes that dense heads have for an input: one or three for each cell of their grids.

    The grids have strides of 8, 16 and 32 px, in networks for large inputs also of 64 px.
    """
    found = set()
    for strides in ((8, 16, 32), (8, 16, 32, 64)):
        cells = sum(-(-size[0] // stride) * -(-size[1] // stride) for stride in strides)
        found |= {cells, 3 * cells}
    return found


def _best(scores: NDArray[Any], boxes: NDArray[Any], least: float) -> Candidates:
    """Return the boxes, by center and size, whose best class is above `least`."""
    classes = scores.argmax(axis=1)
    best = np.take_along_axis(scores, classes[:, None], axis=1)[:, 0]
    kept = best > least
    corners = centered_corners(boxes[kept].astype(np.float32))
    return Candidates(corners, best[kept].astype(np.float32), classes[kept].astype(np.int64))


def _are_fractions(boxes: NDArray[Any], largest: float = 2.0) -> bool:
    """Return True if boxes are fractions of the input; they may lie outside of it in part."""
    return boxes.size == 0 or bool(np.abs(boxes).max() <= largest)


def _in_input(boxes: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """Return boxes by center and size in px of the input, which may be fractions of it."""
    scale = np.array(size) if _are_fractions(boxes) else np.ones(2)
    return (boxes * np.concatenate([scale, scale])).astype(np.float32)


def _probabilities(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return probabilities of logits; numbers that all lie in 0 to 1 are probabilities already."""
    if logits.size and logits.min() >= 0.0 and logits.max() <= 1.0:
        return logits
    return (1.0 / (1.0 + np.exp(-np.clip(logits, -80.0, 80.0)))).astype(np.float32)
