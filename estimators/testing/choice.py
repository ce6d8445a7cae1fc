"""Default inputs of `check_estimator`, chosen by the arguments of an estimator's `initial`."""

from __future__ import annotations

from inspect import signature

from servotrack.estimators.boxes import DetectThenTrack
from servotrack.estimators.color import OpenCVTracker
from servotrack.estimators.detect import KNNBackground, MOG2Background
from servotrack.estimators.jacobian import InformedKalman
from servotrack.estimators.rfs import RangeBearingModel, SteeredPHD
from servotrack.estimators.testing.image_inputs import FrameInputs, ImageInputs, ObjectInputs
from servotrack.estimators.testing.inputs import AnyEstimator, Inputs
from servotrack.estimators.testing.servo_inputs import InformedInputs, ServoInputs
from servotrack.estimators.testing.set_inputs import BoxInputs, FollowerInputs, ScanInputs
from servotrack.estimators.testing.sonar_inputs import RowInputs


def inputs_for(estimator: AnyEstimator) -> Inputs:
    """Choose the inputs of an estimator's family by the names of the arguments of its `initial`.

    Args:
        estimator: An estimator.

    Raises:
        ValueError: No family has such arguments.
    """
    if not hasattr(estimator, "initial") and hasattr(estimator, "detect"):
        return ImageInputs(widths="widths" in signature(estimator.detect).parameters)
    names = [name for name, one in signature(estimator.initial).parameters.items() if one.default is one.empty]
    match names:
        case ["measurement"]:
            model = getattr(getattr(estimator, "filter", estimator), "model", None)
            if model is not None:
                return ScanInputs(
                    size=model.packed.observation.shape[0],
                    steered=isinstance(estimator, SteeredPHD),
                    polar=isinstance(model, RangeBearingModel),
                )
            inner = getattr(estimator, "estimator", estimator)
            return InformedInputs() if isinstance(inner, InformedKalman) else ServoInputs()
        case ["detections"]:
            return BoxInputs()
        case ["detections", "place", "color"]:
            return FollowerInputs()
        case ["frames"]:
            detector = estimator.detector if isinstance(estimator, DetectThenTrack) else estimator
            return FrameInputs(replays=not isinstance(detector, (MOG2Background, KNNBackground)))
        case ["frame", "box"]:
            return ObjectInputs(replays=not isinstance(estimator, OpenCVTracker))
        case ["row"]:
            return RowInputs(beams=estimator.beams, averages=estimator.averages)
    raise ValueError(
        f"inputs must be given for {type(estimator).__name__}, whose initial takes ({', '.join(names)}); pass an "
        "Inputs of servotrack.estimators.testing, or derive one"
    )
