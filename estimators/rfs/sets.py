"""Sets as arrays: measurements, estimates, and fixed arrays in which each identity has its own row.

Column 0 of a fixed array is existence. Measurements: 1 for a used row, 0 for an unused one. Estimates: a target is
reported from 0.5 on; from 0.05 to 0.5 its identity is held without a report; below 0.05 it ends and the row is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.types import Array, Labels, Mask
from servotrack.estimators.validation import LIMITS, as_numbers, check_within

REPORTED, HELD = 0.5, 0.05
"""Existence from which a row reports its target, and from which it keeps its identity."""

TENTATIVE_EXISTENCE = 0.25
"""Existence given for an unconfirmed track by trackers without one: its identity is held, not reported."""


class Scan(NamedTuple):
    """Measurements of one instant.

    Attributes:
        measurements: Measurements, used rows first. Shape (B, Z, m).
        number: Number of used rows. Shape (B,).
        clutter: Clutter intensity kappa at each measurement, 0 in unused rows. Shape (B, Z).
        excess: Covariance of each measurement's noise less that of the model; no rows if all have the model's noise.
            Shape (B, Z or 0, m, m).
    """

    measurements: Array
    number: Labels
    clutter: Array
    excess: Array


class Extraction(NamedTuple):
    """Identities extracted from a posterior, most probable first, in arrays of fixed capacity.

    Attributes:
        number: Number of rows in use. Shape (B,).
        existence: Probabilities of existence. Shape (B, K).
        label: Identities, at least 1. Shape (B, K).
        state: Mean states. Shape (B, K, n).
        covariance: Covariances of the states. Shape (B, K, n, n).
        reported: Mask of the rows that the extraction rule reports. Shape (B, K), bool.
        expected: Expected number of targets by the filter. Shape (B,).
    """

    number: Labels
    existence: Array
    label: Labels
    state: Array
    covariance: Array
    reported: Mask
    expected: Array


def empty_extraction(batch: int, capacity: int, n: int) -> Extraction:
    """Empty extraction with `capacity` rows for each of `batch` runs."""
    return Extraction(
        np.zeros(batch, np.int64),
        np.zeros((batch, capacity)),
        np.zeros((batch, capacity), np.int64),
        np.zeros((batch, capacity, n)),
        np.zeros((batch, capacity, n, n)),
        np.zeros((batch, capacity), np.bool_),
        np.zeros(batch),
    )


@dataclass(frozen=True)
class SetEstimate:
    """Targets that a filter reports, and further identities that it holds without reporting them.

    For one run k is the number of reported targets. For a batch it is the largest over the runs; rows beyond a run's
    number have existence 0 and label 0.

    Attributes:
        states: Reported states. Shape (*batch, k, n).
        labels: Identities of the reported targets, at least 1, stable over time. Shape (*batch, k).
        existence: Probabilities of existence of the reported targets. Shape (*batch, k).
        covariances: Covariances of the reported states. Shape (*batch, k, n, n).
        expected_number: Expected number of targets by the filter. Shape (*batch,).
        held_labels: Identities that are not reported but have an existence of at least 0.05; padded with 0. Shape
            (*batch, h).
        held_states: States of the held identities. Shape (*batch, h, n).
        held_existence: Probabilities of existence of the held identities. Shape (*batch, h).
    """

    states: Array
    labels: Labels
    existence: Array
    covariances: Array
    expected_number: Array
    held_labels: Labels
    held_states: Array
    held_existence: Array


def estimate_from_extraction(extraction: Extraction, single: bool) -> SetEstimate:
    """Split an extraction into reported and held rows and trim them; drop the batch axis of a single run."""
    if single:
        # One run needs no padding.
        reported = extraction.reported[0, : int(extraction.number[0])]
        (shown,), (kept,) = reported.nonzero(), (~reported).nonzero()
        return SetEstimate(
            extraction.state[0].take(shown, axis=0),
            extraction.label[0].take(shown),
            extraction.existence[0].take(shown),
            extraction.covariance[0].take(shown, axis=0),
            extraction.expected[0],
            extraction.label[0].take(kept),
            extraction.state[0].take(kept, axis=0),
            extraction.existence[0].take(kept),
        )
    used = np.arange(extraction.label.shape[1]) < extraction.number[:, None]
    show, keep = _front(used & extraction.reported), _front(used & ~extraction.reported)
    return SetEstimate(
        _take(extraction.state, *show),
        _take(extraction.label, *show),
        _take(extraction.existence, *show),
        _take(extraction.covariance, *show),
        extraction.expected,
        _take(extraction.label, *keep),
        _take(extraction.state, *keep),
        _take(extraction.existence, *keep),
    )


def read_measurements(measurement: ArrayLike, m: int) -> tuple[Array, Labels, bool]:
    """Convert the measurements of one run, or of a batch of runs, to the form of the kernels.

    This is the front door of the set filters. Rows with existence 0 may hold any values, including NaN: they count as
    unused and are never read. Used values must be finite and within `servotrack.estimators.validation.LIMITS`.

    Args:
        measurement: One run: shape (Z, m), Z may be 0; an empty list is a scan without measurements. A batch: shape
            (B, n_max, 1 + m), column 0 existence 0 or 1.
        m: Size of one measurement.

    Returns:
        measurements (B, Z, m), used rows first; their numbers (B,); True for a single run.

    Raises:
        ValueError: The shape is wrong, an existence is not 0 or 1, or a used value is not finite or beyond the limit.
    """
    z = as_numbers("measurements", measurement)
    if z.shape == (0,):
        return np.zeros((1, 0, m)), np.zeros(1, np.int64), True
    if z.ndim == 2:
        if z.shape[1] != m:
            raise ValueError(
                f"measurements must have shape (number, {m}), got {z.shape}; pass shape (0, {m}) for an empty scan"
            )
        check_within("measurements", z, LIMITS.coordinates, "leave bad rows out")
        return z[None], np.array([z.shape[0]]), True
    if z.ndim != 3 or z.shape[2] != 1 + m:
        raise ValueError(
            f"measurements must have shape (number, {m}) or (batch, rows, {1 + m}), got {z.shape}; a row is one "
            "measurement, in a batch with existence in column 0"
        )
    used = z[:, :, 0] == 1.0
    existence = used | (z[:, :, 0] == 0.0)
    if not np.all(existence):
        bad = z[:, :, 0][~existence][0]
        raise ValueError(f"measurements must have existence 0 or 1 in column 0, got {bad}; set unused rows to 0")
    values = np.where(used[:, :, None], z[:, :, 1:], 0.0)
    check_within("measurements", values, LIMITS.coordinates, "set their existence to 0")
    order = np.argsort(~used, axis=1, kind="stable")
    return _rows(values, order), used.sum(axis=1), False


def check_runs(next_label: Labels, runs: int, single: bool) -> None:
    """Raise ValueError if measurements do not have the state's batch axis.

    Args:
        next_label: Field of the state, as given. Shape (*batch,).
        runs: Number of runs of the measurements.
        single: True for the measurements of one run without a batch axis.
    """
    wanted = np.shape(next_label)
    if wanted != (() if single else (runs,)):
        state = f"the state's {wanted[0]} runs" if wanted else "one run, as the state"
        got = "one run without a batch axis" if single else runs
        raise ValueError(f"measurements must be of {state}, got {got}; make a new state with initial(measurement)")


def measurements_to_rows(measurements: ArrayLike, rows: int) -> Array:
    """Convert a set of measurements to a fixed array with existence in column 0.

    Args:
        measurements: Measurements. Shape (Z, m).
        rows: Number of rows of the array, n_max.

    Returns:
        Shape (rows, 1 + m), unused rows zero.

    Raises:
        ValueError: There are more measurements than rows, or values that are not finite.
    """
    z = as_numbers("measurements", measurements)
    if z.ndim != 2 or len(z) > rows:
        raise ValueError(f"measurements must have shape (at most {rows}, m), got {z.shape}; raise rows")
    check_within("measurements", z, LIMITS.coordinates, "leave such rows out")
    fixed = np.zeros((rows, 1 + z.shape[1]))
    fixed[: len(z), 0], fixed[: len(z), 1:] = 1.0, z
    return fixed


class RowState(NamedTuple):
    """State of a `RowAllocation`.

    Attributes:
        label: Identity of each row, 0 for a free row. Shape (*batch, rows).
    """

    label: Labels


@dataclass(frozen=True)
class RowAllocation:
    """Gives every identity a row of a fixed array until it ends.

    Args:
        rows: Number of rows of the array, n_max.
        columns: Indices of the state entries in the array (for [x, vx, y, vy] the position is (0, 2)).

    Raises:
        ValueError: There are no rows or no columns.
    """

    rows: int
    columns: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.rows < 1 or not self.columns:
            raise ValueError(f"rows and columns must not be empty, got rows={self.rows!r}, columns={self.columns!r}")

    def initial(self, batch: tuple[int, ...] = ()) -> RowState:
        """State with all rows free."""
        return RowState(np.zeros((*batch, self.rows), np.int64))

    def step(self, state: RowState, estimate: SetEstimate) -> tuple[RowState, Array]:
        """Write an estimate into rows: identities keep their rows, new ones take free rows, the most probable first.

        Returns:
            The new state and the array, shape (*batch, rows, 1 + len(columns)). Identities without a free row are
            left out.
        """
        batch = state.label.shape[:-1]
        owners = state.label.reshape(-1, self.rows)
        runs = owners.shape[0]
        # Reported identities come first: they replace held ones when there are too few rows.
        label = np.concatenate([estimate.labels, estimate.held_labels], axis=-1).reshape(runs, -1)
        shown = np.clip(estimate.existence, REPORTED, 1.0)
        hidden = np.clip(estimate.held_existence, HELD, np.nextafter(REPORTED, 0.0))
        existence = np.concatenate([shown, hidden], axis=-1).reshape(runs, -1)
        values = np.concatenate([estimate.states, estimate.held_states], axis=-2)[..., list(self.columns)]
        values = values.reshape(runs, -1, len(self.columns))
        new = np.zeros_like(owners)
        array = np.zeros((runs, self.rows, 1 + len(self.columns)))
        reported_capacity = estimate.labels.shape[-1]
        for run in range(runs):
            _allocate(owners[run], label[run], reported_capacity, new[run])
            order = {int(a): i for i, a in enumerate(label[run]) if a > 0}
            for row in np.flatnonzero(new[run]):
                entry = order[int(new[run, row])]
                array[run, row, 0], array[run, row, 1:] = existence[run, entry], values[run, entry]
        return RowState(new.reshape(*batch, self.rows)), array.reshape(*batch, self.rows, -1)


def rows_to_tracks(rows: ArrayLike, identities: ArrayLike | None = None) -> dict[int, Array]:
    """Map the reported targets of one fixed array of estimates by identity.

    Args:
        rows: Estimates with existence in column 0. Shape (rows, 1 + d).
        identities: Identity of each row; the row's index if None. Shape (rows,).

    Returns:
        Map from identity to position, shape (d,).

    Raises:
        ValueError: Rows of another shape, or a reported row that is not finite.
    """
    array = as_numbers("rows", rows)
    if array.ndim != 2 or array.shape[1] < 2:
        raise ValueError(f"rows must have shape (rows, 1 + d), existence and position, got {array.shape}")
    names = np.arange(len(array)) if identities is None else np.asarray(identities)
    shown = ~(array[:, 0] < REPORTED)
    check_within("rows", array[shown], LIMITS.coordinates, "leave such rows out")
    return {int(names[i]): array[i, 1:] for i in np.flatnonzero(shown)}


def _allocate(owners: Labels, labels: Labels, reported: int, new: Labels) -> None:
    """Assign rows to the labels of one run; the first `reported` of them have priority."""
    wanted = labels[labels > 0]
    chosen = wanted[: owners.shape[0]]
    stay = np.isin(owners, chosen) & (owners > 0)
    new[stay] = owners[stay]
    arriving = chosen[~np.isin(chosen, owners)]
    # A held identity gets a row only after it has been reported once.
    arriving = arriving[np.isin(arriving, labels[:reported])]
    # A row whose identity ends now stays empty for this step; otherwise it would look like the same identity.
    free = np.flatnonzero((new == 0) & (owners == 0))[: len(arriving)]
    new[free] = arriving[: len(free)]


def _front(mask: Mask) -> tuple[Labels, Mask]:
    """Indices that move the marked rows of each run to the front, and the mask of used rows after trimming."""
    most = int(mask.sum(axis=1).max(initial=0))
    order = np.argsort(~mask, axis=1, kind="stable")[:, :most]
    return order, _rows(mask, order)


def _take(array: NDArray, order: Labels, used: Mask) -> NDArray:  # type: ignore[type-arg]
    """Take the rows of each run in the given order, zero where unused."""
    taken = _rows(array, order)
    taken[~used] = 0
    return taken


def _rows(array: NDArray, order: Labels) -> NDArray:  # type: ignore[type-arg]
    """Rows of each run in the given order. `take_along_axis` would look up every number on its own."""
    rows: NDArray = array[np.arange(len(order))[:, None], order]  # type: ignore[type-arg]
    return rows
