"""Checker for any estimator, to be called from a test.

    from servotrack.estimators.testing import check_estimator

    def test_my_estimator():
        check_estimator(MyJacobian())

It draws sequences of measurements and checks that finite input gives finite output and valid covariances, that bad
input is refused by a clear error and changes nothing, and that states are values. The measurements are chosen by the
arguments of the estimator's `initial`; pass `inputs` for others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from servotrack.estimators.testing.checks import CHECKS, Case, Subject
from servotrack.estimators.testing.choice import inputs_for
from servotrack.estimators.testing.image_inputs import FrameInputs, ImageInputs, ObjectInputs
from servotrack.estimators.testing.inputs import AnyEstimator, Bad, Inputs
from servotrack.estimators.testing.servo_inputs import InformedInputs, ServoInputs
from servotrack.estimators.testing.set_inputs import BoxInputs, FollowerInputs, ScanInputs
from servotrack.estimators.testing.sonar_inputs import RowInputs

__all__ = [
    "CHECKS",
    "Bad",
    "BoxInputs",
    "EstimatorFaults",
    "FollowerInputs",
    "FrameInputs",
    "ImageInputs",
    "InformedInputs",
    "Inputs",
    "ObjectInputs",
    "RowInputs",
    "ScanInputs",
    "ServoInputs",
    "check_estimator",
    "inputs_for",
]


class EstimatorFaults(AssertionError):
    """The faults of an estimator.

    Attributes:
        faults: Message of each failed check by the check's name: the fault, its place and its remedy.
    """

    def __init__(self, faults: dict[str, str]) -> None:
        super().__init__("\n".join(f"[{name}] {message}" for name, message in faults.items()))
        self.faults = faults


def check_estimator(
    estimator: AnyEstimator,
    inputs: Inputs | None = None,
    *,
    sequences: int = 20,
    steps: int = 12,
    seed: int = 0,
    skip: Sequence[str] = (),
) -> None:
    """Check that an estimator follows the contract of `servotrack.estimators.types.Estimator`.

    | check | rule |
    |---|---|
    | `finite` | measurements as in practice are accepted: results finite, covariances positive semidefinite |
    | `extreme` | any finite measurement gives such results, or a ValueError that changes nothing |
    | `values` | a step changes neither its state nor its measurement, and gives the same bits from the same state |
    | `repeat` | the same sequence gives the same bits again |
    | `arrays` | float32, integer, Fortran, strided, read-only and big-endian arrays give the bits of plain ones |
    | `unseen` | entries that count as unseen have no effect, also if they hold NaN or infinity |
    | `refusals` | NaN, text, objects, ragged lists, wrong shapes, a clock that runs back: a ValueError that names it |

    Args:
        estimator: The estimator, controller, tracker or detector.
        inputs: Measurements of its family; None: chosen by `inputs_for`. For a family of your own derive from `Inputs`.
        sequences: Number of sequences that every check draws. A batch counts as one.
        steps: Number of steps of a sequence, at least 2.
        seed: Seed of the sequences; sequence k of a seed is always the same.
        skip: Names of checks to skip.

    Raises:
        EstimatorFaults: An AssertionError that lists the first fault of every failed check and its remedy.
        ValueError: `sequences`, `steps` or `skip` is invalid, or there are no inputs for such an estimator.
    """
    unknown = sorted(set(skip) - CHECKS.keys())
    if unknown:
        raise ValueError(f"skip contains unknown checks {unknown}; known are {', '.join(CHECKS)}")
    for name, count, least in (("sequences", sequences, 1), ("steps", steps, 2)):
        if count < least:
            raise ValueError(f"{name} must be at least {least}, got {count}")
    subject = Subject(estimator, inputs_for(estimator) if inputs is None else inputs, steps, seed)
    faults: dict[str, str] = {}
    for number in range(sequences):
        case = Case(subject, number)
        for name, check in CHECKS.items():
            message = None if name in skip or name in faults else _fault(check, case)
            if message is not None:
                faults[name] = f"sequence {number} of seed {seed}: {message}"
    if faults:
        raise EstimatorFaults({name: faults[name] for name in CHECKS if name in faults})


def _fault(check: Callable[[Case], None], case: Case) -> str | None:
    """Message of a failed check, or None. An exception raised by the estimator is a fault too."""
    try:
        check(case)
    except AssertionError as fault:
        return str(fault) or "the estimator raised an AssertionError without a message"
    except Exception as error:
        return f"the estimator raised {type(error).__name__}: {error}"
    return None
