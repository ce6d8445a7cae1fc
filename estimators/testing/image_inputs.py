"""Frames for the detectors and for the trackers of one colored object."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np

from servotrack.estimators.testing.inputs import AnyEstimator, Arguments, Bad, Inputs, Sequence
from servotrack.estimators.types import Array, Image


@dataclass(frozen=True)
class FrameInputs(Inputs):
    """Frames with a colored rectangle that moves over a textured floor, for detectors with a state.

    Args:
        size: Width and height of the frames, px.
        replays: False for a detector around an object of OpenCV that learns in place.
    """

    size: tuple[int, int] = (48, 64)
    replays: bool = True

    open_axes: ClassVar[frozenset[str]] = frozenset({"frames"})

    def prepare(self) -> None:
        """Set the seed of OpenCV's own generator, from which its models and trackers draw."""
        if not self.replays:
            cv2.setRNGSeed(0)

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw frames of one scene; or frames of noise and of single colors, of any size."""
        frames = noise_frames(rng, steps, self.size) if extreme else scene_frames(rng, steps, self.size)[0]
        return Sequence({"frames": frames[0]}, tuple({"frame": each} for each in frames))

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield images of other types and shapes."""
        yield from malformed_images(arguments, "frames" if first else "frame", first)


@dataclass(frozen=True)
class ImageInputs(Inputs):
    """Images for detectors without a state, whose method is `detect(images)`.

    Args:
        size: Width and height of the images, px.
        widths: True for a detector that also takes the width of a person in each image.
    """

    size: tuple[int, int] = (48, 48)
    widths: bool = False

    open_axes: ClassVar[frozenset[str]] = frozenset({"images"})

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw images of one scene, or of noise and of single colors."""
        frames = noise_frames(rng, steps, self.size) if extreme else scene_frames(rng, steps, self.size)[0]
        more = {"widths": np.asarray(rng.uniform(5.0, 200.0))} if self.widths else {}
        return Sequence({}, tuple({"images": each, **more} for each in frames))

    def initial(self, estimator: AnyEstimator, arguments: Arguments) -> tuple[()]:
        """Return the empty state."""
        return ()

    def step(self, estimator: AnyEstimator, state: Any, arguments: Arguments) -> tuple[Any, Any]:
        """Return the state and what was detected."""
        return state, estimator.detect(*arguments.values())

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield images of other types and shapes."""
        if not first:
            yield from malformed_images(arguments, "images", True)


@dataclass(frozen=True)
class ObjectInputs(Inputs):
    """Frames with a colored object and its first box.

    Args:
        size: Width and height of the frames, px.
        replays: False for a tracker around an object of OpenCV that changes in place.
    """

    size: tuple[int, int] = (48, 64)
    replays: bool = True

    def prepare(self) -> None:
        """Set the seed of OpenCV's own generator, from which its models and trackers draw."""
        if not self.replays:
            cv2.setRNGSeed(0)

    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw a moving object; or noise and any box that overlaps the frame."""
        if extreme:
            frames = noise_frames(rng, steps, self.size)
            rows, columns = frames[0].shape[:2]
            size = 1.0 + rng.uniform(0.0, 1.5) * rng.random(2) * (columns, rows)
            box = np.concatenate([rng.uniform(-size + 1.0, np.maximum([columns - 1.0, rows - 1.0], -size + 1.0)), size])
        else:
            frames, box = scene_frames(rng, steps, self.size)
        return Sequence({"frame": frames[0], "box": box}, tuple({"frame": each} for each in frames[1:]))

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield images of other types and shapes, and boxes without area or outside the frame."""
        yield from malformed_images(arguments, "frame", first)
        if first:
            beyond = 2.0 * self.size[0]
            for box in ([5.0, 5.0, 0.0, 9.0], [5.0, 5.0, 9.0, -9.0], [beyond, 5.0, 9.0, 9.0], [1e300] * 4):
                yield Bad(f"a box of {box}", ("box",), {**arguments, "box": np.array(box)})


def scene_frames(rng: np.random.Generator, steps: int, size: tuple[int, int]) -> tuple[list[Image], Array]:
    """Frames of a colored rectangle that moves over a textured gray floor, and its box in the first frame.

    Args:
        rng: Source of random numbers.
        steps: Number of frames.
        size: Width and height, px, at least 32.
    """
    columns, rows = size
    floor = rng.integers(90, 130, (rows, columns, 1), dtype=np.uint8).repeat(3, axis=2)
    wide, high = int(rng.integers(8, 12)), int(rng.integers(14, 20))
    left, top = int(rng.integers(0, columns - wide)), int(rng.integers(0, rows - high))
    color = np.array([222, 64, 38], dtype=np.uint8)
    frames, box = [], np.array([left, top, wide, high], dtype=np.float64)
    for _ in range(steps):
        frame = floor.copy()
        frame[top : top + high, left : left + wide] = color
        frame += rng.integers(0, 5, frame.shape, dtype=np.uint8)
        frames.append(frame)
        left = int(np.clip(left + rng.integers(-2, 3), 0, columns - wide))
        top = int(np.clip(top + rng.integers(-2, 3), 0, rows - high))
    return frames, box


def noise_frames(rng: np.random.Generator, steps: int, size: tuple[int, int]) -> list[Image]:
    """Frames of noise, of one color, or alternately black and white; one row or column at least.

    Args:
        rng: Source of random numbers.
        steps: Number of frames.
        size: Largest width and height, px.
    """
    columns, rows = (int(rng.integers(1, side + 1)) if rng.random() < 0.5 else side for side in size)
    if size[0] == size[1]:
        rows = columns
    shape = (rows, columns, 3)
    kind = rng.integers(3)
    if kind == 0:
        return [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(steps)]
    if kind == 1:
        return [np.full(shape, rng.integers(0, 256), dtype=np.uint8) for _ in range(steps)]
    return [np.full(shape, 255 * (k % 2), dtype=np.uint8) for k in range(steps)]


def malformed_images(arguments: Arguments, name: str, first: bool) -> Iterator[Bad]:
    """Yield arguments with images of other types and shapes.

    Args:
        arguments: Valid arguments.
        name: Name of the argument with the image.
        first: False if the shape of the image is given by an earlier one.
    """
    good = arguments[name]
    wrong = [
        ("of floats", good.astype(np.float64)),
        ("of NaN", np.full(good.shape, np.nan)),
        ("of 16 bits", good.astype(np.uint16)),
        ("of one pixel without rows", good[0, 0]),
        ("of four channels", np.concatenate([good, good[..., :1]], axis=2)),
        ("without pixels", good[:0]),
    ]
    if not first:
        wrong.append(("of another size", np.concatenate([good, good])))
    for fault, image in wrong:
        yield Bad(f"an image {fault}", (name,), {**arguments, name: image})
