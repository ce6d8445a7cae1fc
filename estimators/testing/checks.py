"""The checks of `check_estimator`, each for one drawn sequence."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from servotrack.estimators.testing.bits import first_difference, have_same_bits
from servotrack.estimators.testing.inputs import AnyEstimator, Arguments, Inputs, Sequence, bad_arguments
from servotrack.estimators.testing.values import flat, mapped, numbers_in, replaced, views


@dataclass(frozen=True)
class Subject:
    """The estimator under test.

    Attributes:
        estimator: The estimator.
        inputs: Inputs of its family.
        steps: Number of steps of a sequence.
        seed: Seed of the sequences.
    """

    estimator: AnyEstimator
    inputs: Inputs
    steps: int
    seed: int

    def run(self, sequence: Sequence) -> Iterator[tuple[Any, Any]]:
        """Yield the state and the estimate of every step; the first item is the initial state."""
        self.inputs.prepare()
        state = self.inputs.initial(self.estimator, sequence.start)
        yield state, None
        for arguments in sequence.steps:
            state, estimate = self.inputs.step(self.estimator, state, arguments)
            yield state, estimate

    def trace(self, sequence: Sequence) -> Iterator[dict[str, np.ndarray]]:
        """Yield all numbers of the state and the estimate of every step; copy those that are kept."""
        for state, estimate in self.run(sequence):
            yield views({"state": state, "estimate": self.results(estimate)})

    def results(self, estimate: Any) -> Any:
        """Values of an estimate that are checked; none for the initial state."""
        return None if estimate is None else self.inputs.results(estimate)


class Case:
    """One drawn sequence of a subject.

    Args:
        subject: The estimator under test.
        number: Number of the sequence.
    """

    def __init__(self, subject: Subject, number: int) -> None:
        self.subject = subject
        self._seed = [subject.seed, number]

    def draw(self, *, extreme: bool = False) -> tuple[np.random.Generator, Sequence]:
        """Draw the sequence anew, since a faulty estimator may change it, and the generator for further draws."""
        rng = np.random.default_rng(self._seed)
        return rng, self.subject.inputs.draw(rng, self.subject.steps, extreme=extreme)

    @cached_property
    def plain(self) -> list[dict[str, np.ndarray]]:
        """Trace of the sequence as it is, which most checks compare with."""
        return _copied(self.subject.trace(self.draw()[1]))


def check_finite(case: Case) -> None:
    """Check that measurements as in practice are accepted and give finite values and valid covariances."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for step, values in enumerate(case.plain):
            _check_values(case.subject, values, f"step {step}")


def check_extreme(case: Case) -> None:
    """Check that any finite measurement gives finite values and covariances, or a refusal that changes nothing."""
    subject = case.subject
    _, sequence = case.draw(extreme=True)
    try:
        state = subject.inputs.initial(subject.estimator, sequence.start)
    except ValueError as error:
        _check_message(error, _names(sequence.start), "initial")
        return
    for step, arguments in enumerate(sequence.steps, 1):
        before = flat(state)
        try:
            state, estimate = subject.inputs.step(subject.estimator, state, arguments)
        except ValueError as error:
            _check_message(error, _names(arguments), f"step {step}")
            _check_same(views(state), before, f"step {step}: a refused measurement changed the state")
            continue
        _check_values(subject, views({"state": state, "estimate": subject.results(estimate)}), f"step {step}")


def check_values(case: Case) -> None:
    """Check that a step changes neither the state nor the measurement it is given, and can be repeated."""
    subject = case.subject
    _, sequence = case.draw()
    state = subject.inputs.initial(subject.estimator, sequence.start)
    for step, arguments in enumerate(sequence.steps, 1):
        before, given = flat(state), flat(arguments)
        new, estimate = subject.inputs.step(subject.estimator, state, arguments)
        _check_same(
            views(state), before, f"step {step} changed the state that it was given; copy arrays before writing"
        )
        _check_same(views(arguments), given, f"step {step} changed its measurement; copy arrays before writing")
        if subject.inputs.replays:
            result = flat((new, estimate))
            again = views(subject.inputs.step(subject.estimator, state, arguments))
            _check_same(
                again, result, f"step {step} from the same state gave another result; keep all memory in the state"
            )
        state = new


def check_repeat(case: Case) -> None:
    """Check that the same sequence gives the same bits when it is run again."""
    subject = case.subject
    _, sequence = case.draw()
    _check_traces(
        case.plain,
        subject.trace(sequence),
        "the second run of a sequence (there) differs from the first; draw from generators with a fixed seed, and keep "
        "all memory in the state",
    )


def check_arrays(case: Case) -> None:
    """Check that other types and memory layouts of the same values give the same bits."""
    subject = case.subject
    _, sequence = case.draw()
    for name, change in LAYOUTS.items():
        changed = _changed(sequence, change)
        if _differ_in_form(sequence, changed):
            rule = f"{name} (there) give other bits than plain ones; convert inputs with as_numbers"
            _check_traces(case.plain, subject.trace(changed), rule)
    for name, rounded, typed in TYPES:
        kept = subject.inputs.not_rounded
        coarse = _changed(sequence, rounded, kept)
        changed = _changed(coarse, typed, kept)
        if _differ_in_form(coarse, changed):
            rule = f"arrays of {name} (there) give other bits than float64 of the same values; use as_numbers"
            _check_traces(_copied(subject.trace(coarse)), subject.trace(changed), rule)


def check_unseen(case: Case) -> None:
    """Check that entries which count as unseen have no effect, whatever they hold."""
    subject = case.subject
    _, sequence = case.draw()
    if not any(map(subject.inputs.unread, (sequence.start, *sequence.steps))):
        return
    for value in (np.nan, np.inf):

        def hidden(arguments: Arguments, value: float = value) -> Arguments:
            for path, mask in subject.inputs.unread(arguments).items():
                array = dict(numbers_in(arguments))[path]
                arguments = replaced(arguments, path, np.where(mask, value, array))
            return arguments

        other = Sequence(hidden(sequence.start), tuple(hidden(each) for each in sequence.steps))
        rule = f"{value} in unseen entries (there) has an effect; do not read them"
        _check_traces(case.plain, subject.trace(other), rule)


def check_refusals(case: Case) -> None:
    """Check that bad measurements are refused by a ValueError that names the argument, and that nothing changes."""
    subject = case.subject
    rng, sequence = case.draw()
    state = subject.inputs.initial(subject.estimator, sequence.start)
    same_form = sequence.start.keys() == sequence.steps[0].keys()
    for bad in bad_arguments(subject.inputs, rng, sequence.start, True):
        refused = _refusal(subject.inputs.initial, bad.fault, subject.estimator, bad.arguments)
        if refused is None and same_form:
            # An estimator may leave the check to the first step with the same measurement.
            refused = _refusal(subject.inputs.step, bad.fault, subject.estimator, state, bad.arguments)
        assert refused is not None, f"initial accepted {bad.fault}; refuse it with a ValueError"
        _check_message(refused, bad.names, f"initial with {bad.fault}")
    # The first step has no clock before it that could run back.
    attacked = int(rng.integers(1, len(sequence.steps)))
    plain = case.plain
    subject.inputs.prepare()
    state = subject.inputs.initial(subject.estimator, sequence.start)
    for step, arguments in enumerate(sequence.steps):
        if step == attacked:
            before = flat(state)
            for bad in bad_arguments(subject.inputs, rng, arguments, False):
                refused = _refusal(subject.inputs.step, bad.fault, subject.estimator, state, bad.arguments)
                assert refused is not None, f"step accepted {bad.fault}; refuse it with a ValueError"
                _check_message(refused, bad.names, f"step with {bad.fault}")
                _check_same(
                    views(state), before, f"the refusal of {bad.fault} changed the state; check before computing"
                )
        state, estimate = subject.inputs.step(subject.estimator, state, arguments)
        _check_same(
            views({"state": state, "estimate": subject.results(estimate)}),
            plain[step + 1],
            f"step {step + 1}: refused measurements at step {attacked + 1} have an effect; check before computing",
        )


CHECKS: dict[str, Callable[[Case], None]] = {
    "finite": check_finite,
    "extreme": check_extreme,
    "values": check_values,
    "repeat": check_repeat,
    "arrays": check_arrays,
    "unseen": check_unseen,
    "refusals": check_refusals,
}
"""The checks of `check_estimator` by name, in the order in which they run."""


def _strided(array: np.ndarray) -> np.ndarray:
    """Every second entry of an array twice as large, along every axis."""
    if array.ndim == 0:
        return array.copy()
    wide = np.zeros([2 * size for size in array.shape], array.dtype)
    view = wide[(slice(None, None, 2),) * array.ndim]
    view[...] = array
    return view


def _read_only(array: np.ndarray) -> np.ndarray:
    out = array.copy()
    out.setflags(write=False)
    return out


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "arrays in Fortran order": lambda array: np.array(array, order="F"),
    "strided arrays": _strided,
    "read-only arrays": _read_only,
    "big-endian arrays": lambda array: array.astype(array.dtype.newbyteorder(">")),
}
"""Memory layouts of the same values."""


def _if_float(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda array: change(array) if array.dtype.kind == "f" else array


TYPES = (
    (
        "float32",
        _if_float(lambda array: array.astype(np.float32).astype(np.float64)),
        _if_float(lambda array: array.astype(np.float32)),
    ),
    ("int64", _if_float(lambda array: np.rint(array) + 0.0), _if_float(lambda array: array.astype(np.int64))),
)
"""Names of types, the rounding to their values (without negative zeros), and the conversion of rounded arrays."""


def _changed(
    sequence: Sequence, change: Callable[[np.ndarray], np.ndarray], kept: frozenset[str] = frozenset()
) -> Sequence:
    return Sequence(mapped(sequence.start, change, kept), tuple(mapped(each, change, kept) for each in sequence.steps))


def _differ_in_form(ours: Sequence, theirs: Sequence) -> bool:
    """Return whether some array has another type, layout or permission, so that a run is not the same run again."""

    def forms(sequence: Sequence) -> list[Any]:
        return [(each.dtype, each.strides, each.flags.writeable) for _, each in numbers_in(sequence)]

    return forms(ours) != forms(theirs)


def _copied(trace: Iterable[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    """Keep a trace, whose arrays an estimator might write into in its next step."""
    return [flat(values) for values in trace]


def _names(arguments: Arguments) -> tuple[str, ...]:
    return tuple({key for path, _ in numbers_in(arguments) for key in path})


def _refusal(call: Callable[..., Any], fault: str, *arguments: Any) -> ValueError | None:
    """Return the ValueError of a call, or None if the call succeeds; other errors are faults."""
    try:
        call(*arguments)
    except ValueError as error:
        return error
    except Exception as error:
        raise AssertionError(
            f"{fault} must be refused with a ValueError, got {type(error).__name__}: {error}"
        ) from error
    return None


def _check_message(error: ValueError, names: tuple[str, ...], where: str) -> None:
    assert not isinstance(error, np.linalg.LinAlgError) and any(name in str(error) for name in names), (
        f"{where}: the error must name the argument ({' or '.join(names)}), its value and a remedy, got: "
        f"{type(error).__name__}: {error}"
    )


def _check_traces(plain: Iterable[dict[str, np.ndarray]], other: Iterable[dict[str, np.ndarray]], rule: str) -> None:
    for step, (ours, theirs) in enumerate(zip(plain, other, strict=True)):
        _check_same(ours, theirs, f"step {step}: {rule}")


def _check_same(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], rule: str) -> None:
    if ours.keys() != theirs.keys() or not all(map(_same, ours.values(), map(theirs.__getitem__, ours))):
        found = first_difference(ours, theirs, "result")
        assert found is None, f"{rule}: {found}"


def _same(ours: np.ndarray, theirs: np.ndarray) -> bool:
    return ours.dtype.kind != "O" and have_same_bits(ours, theirs)


def _check_values(subject: Subject, values: dict[str, np.ndarray], where: str) -> None:
    """Raise an AssertionError unless all numbers are finite and all covariances valid."""
    for name, array in values.items():
        if array.dtype.kind not in "fc":
            continue
        field = name.rpartition(".")[2]
        if field in subject.inputs.may_be_infinite:
            assert not np.isnan(array).any(), f"{where}: {name} has NaN"
        elif not np.isfinite(array).all():
            _fail_at(~np.isfinite(array), array, f"{where}: {name} must be finite")
        elif "covariance" in field and array.ndim >= 2 and array.shape[-1] == array.shape[-2] and array.size:
            _check_covariances(array, f"{where}: {name}")


def _check_covariances(matrices: np.ndarray, where: str) -> None:
    """Raise an AssertionError unless matrices are symmetric and positive semidefinite up to rounding of their entries.

    The eigenvalues are those of the correlations, so that a small variance counts as much as a large one.
    """
    # Free rows of a table are zeros, and most rows are free.
    used = (matrices != 0.0).any(axis=(-1, -2))
    rows, matrices = np.argwhere(used), matrices[used]
    variances = np.einsum("...ii->...i", matrices)
    if not (variances.real >= 0.0).all():
        _fail_at(variances.real < 0.0, variances, f"{where} has a negative variance", rows)
    deviations = np.sqrt(variances.real)
    scale = deviations[..., :, None] * deviations[..., None, :]
    # Exactly known entries have zeros in their rows and columns.
    correlations = np.divide(matrices, scale, out=np.zeros_like(matrices), where=scale > 0.0)
    skew = np.abs(matrices - np.conj(np.swapaxes(matrices, -1, -2))) > 1e-12 * scale
    if skew.any():
        _fail_at(skew, matrices, f"{where} is not symmetric", rows)
    beside = (scale == 0.0) & (matrices != 0.0)
    if beside.any():
        _fail_at(beside, matrices, f"{where} has a covariance beside a variance of 0", rows)
    smallest = np.linalg.eigvalsh(correlations).min(axis=-1)
    indefinite = smallest < -SMALLEST_EIGENVALUE
    if indefinite.any():
        _fail_at(indefinite, smallest, f"{where} is indefinite, smallest eigenvalue of correlations", rows)


SMALLEST_EIGENVALUE = 1e-12
"""Magnitude of a negative eigenvalue of a correlation matrix that rounding of its entries can explain."""


def _fail_at(bad: np.ndarray, values: np.ndarray, what: str, rows: np.ndarray | None = None) -> NoReturn:
    """Raise an AssertionError about the first bad value; `rows` has the places that the first axis was taken from."""
    place = tuple(int(i) for i in np.argwhere(bad)[0])
    index = place if rows is None else (*rows[place[0]].tolist(), *place[1:])
    raise AssertionError(f"{what}, got {values[place]} at index {list(index)}")
