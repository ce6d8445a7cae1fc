"""Opening of a source with its detector, by names."""

from __future__ import annotations

from dataclasses import dataclass

from servotrack.baselines.agents.people.catalog import DETECTORS, Detector, create_detector
from servotrack.baselines.track_command.inputs import FileInput, Input, PixelInput
from servotrack.envs.track.files.frames import SIDES
from servotrack.envs.track.files.mot_files import find_mot_folder

FILE_DETECTOR = "file"
"""Detector name that stands for the detections of a MOTChallenge sequence."""


@dataclass(frozen=True)
class SourceRequest:
    """A source and its detector.

    Attributes:
        source: Video file, folder of images, MOTChallenge folder, a camera's index, or an address.
        detector: Name, an ONNX file, or `file` for a MOTChallenge sequence's own detections. `auto`: `file` if it has
            detections, else the first detector.
        classes: Names or numbers of the classes that a network finds; None for people.
        confidence: Smallest confidence of detections of a network or a file; None: 0.25 for a network, all of a file.
        size: Frame size for the detector: `WxH`, `source`, or `fit` into 384 by 288 px. Larger frames take
            longer and show smaller people. `auto`: `source` for a network, which resizes itself, else `fit`.
        start: First frame, from 0.
        frames: Largest number of frames; None for all.
        stride: Use every stride-th frame.
        background: Number of frames sampled in a first pass to initialize the background model. 0 disables the pass.
        white: Value that is white in images of more than 8 bits; None: from the images.
    """

    source: str | int
    detector: str = "auto"
    classes: tuple[str | int, ...] | None = None
    confidence: float | None = None
    size: str = "auto"
    start: int = 0
    frames: int | None = None
    stride: int = 1
    background: int = 40
    white: float | None = None


def open_input(request: SourceRequest, pictures: bool = True, length: int = 0) -> tuple[Input, str]:
    """Return the sequence with its detector, and the detector's name.

    Args:
        request: Source and detector.
        pictures: True reads the images of a sequence with detections, too.
        length: Smallest number of steps of such a sequence.

    Raises:
        SequenceError: The source cannot be opened.
        ValueError: An unknown name, a number out of range, or an option that the detector does not have.
        ResultsError: An ONNX file that cannot be used.
    """
    name = request.detector
    if name == "auto":
        sequence = find_mot_folder(str(request.source))
        name = FILE_DETECTOR if sequence is not None and sequence.detections is not None else next(iter(DETECTORS))
    if name == FILE_DETECTOR:
        _no_classes(request, "of a file")
        return FileInput(
            str(request.source),
            confidence=request.confidence,
            pictures=pictures,
            length=length,
            start=request.start,
            count=request.frames,
            stride=request.stride,
        ), name
    network = name.lower().endswith(".onnx")
    detector: Detector
    if network:
        from servotrack.baselines.agents.people.onnx_detector import CONFIDENCE, OnnxDetector

        confidence = CONFIDENCE if request.confidence is None else request.confidence
        detector = OnnxDetector(name, request.classes, confidence)
    else:
        _no_classes(request, f"of {name}")
        if request.confidence is not None:
            raise ValueError(f"confidence is for networks and files; {name} gives none: leave it out")
        detector = create_detector(name)
    size = request.size if request.size != "auto" else "source" if network else "fit"
    return PixelInput(
        request.source,
        detector,
        _size(size),
        start=request.start,
        count=request.frames,
        stride=request.stride,
        background=0 if network else request.background,
        white=request.white,
        moving=network,
    ), name


def _no_classes(request: SourceRequest, whose: str) -> None:
    if request.classes is not None:
        raise ValueError(f"classes are for networks (--detector FILE.onnx); detections {whose} have none: leave it out")


def _size(text: str) -> tuple[int, int] | str:
    if text in ("fit", "source"):
        return text
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and text.isascii()):
        raise ValueError(f"size must be WxH such as 384x288, `auto`, `fit` or `source`, got {text!r}")
    sides = (int(width), int(height))
    if not all(SIDES[0] <= side <= SIDES[1] for side in sides):
        raise ValueError(f"size must have sides from {SIDES[0]} to {SIDES[1]} px, got {text!r}")
    return sides


def working_size(source: Input) -> tuple[int, int] | None:
    """Return width and height of the frames that the detector works at, px; None if unknown."""
    if source.source_size is None:
        return None
    width, height = source.source_size
    return round(width / source.scale[0]), round(height / source.scale[1])
