"""Sets as arrays: measurements in, estimates out, and fixed arrays whose row is an identity.

Column 0 of a fixed array is existence. Measurements: 1 for a used row, 0 for an unused one. Estimates: at least 0.5
reports a target, from 0.05 to 0.5 holds its identity silently, below 0.05 ends it and frees the row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.types import Array, Labels, Mask

REPORTED, HELD = 0.5, 0.05
"""Existence from which a row reports its target, and from which it keeps its identity."""


class Extraction(NamedTuple):
    """What a filter believes of each identity, most probable first, in arrays of fixed capacity.

    Attributes:
        number: Rows in use. Shape (B,).
        existence: Shape (B, K).
        label: Identities, at least 1. Shape (B, K).
        state: Shape (B, K, n).
        covariance: Shape (B, K, n, n).
        reported: Which rows the extraction rule reports. Shape (B, K), bool.
        expected: The filter's own expected number of targets. Shape (B,).
    """

    number: Labels
    existence: Array
    label: Labels
    state: Array
    covariance: Array
    reported: Mask
    expected: Array


def empty_extraction(batch: int, capacity: int, n: int) -> Extraction:
    """Room for `capacity` identities in each of `batch` runs."""
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
    """The targets a filter reports, and the identities it holds besides.

    For one run k is the number of reported targets. For a batch it is the largest over the runs; rows beyond a run's
    number have existence 0 and label 0.

    Attributes:
        states: Reported states. Shape (*batch, k, n).
        labels: Their identities, at least 1, stable over time. Shape (*batch, k).
        existence: Their probabilities of existence. Shape (*batch, k).
        covariances: Shape (*batch, k, n, n).
        expected_number: The filter's own mean of the number of targets. Shape (*batch,).
        held_labels: Identities not reported now but still believed in with at least 0.05; 0 pads. Shape (*batch, h).
        held_states: Their states. Shape (*batch, h, n).
        held_existence: Shape (*batch, h).
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
    """Split an extraction into reported and held rows, trimmed; without the batch axis for a single run."""
    used = np.arange(extraction.label.shape[1]) < extraction.number[:, None]
    reported, held = used & extraction.reported, used & ~extraction.reported
    if single:
        # One run needs no padding: take its rows.
        (shown,), (kept,) = reported, held
        return SetEstimate(
            extraction.state[0][shown],
            extraction.label[0][shown],
            extraction.existence[0][shown],
            extraction.covariance[0][shown],
            extraction.expected[0],
            extraction.label[0][kept],
            extraction.state[0][kept],
            extraction.existence[0][kept],
        )
    show, keep = _front(reported), _front(held)
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
    """Measurements of one run, or of a batch of runs, as the kernels take them.

    Args:
        measurement: One run: shape (Z, m), Z may be 0. A batch: shape (B, n_max, 1 + m), column 0 existence 0 or 1.
        m: Size of one measurement.

    Returns:
        measurements (B, Z, m), used rows first; their numbers (B,); whether it was one run.

    Raises:
        ValueError: For a wrong shape, an existence other than 0 or 1, or a used row that is not finite.
    """
    z = np.asarray(measurement, dtype=np.float64)
    if z.size == 0 and z.ndim < 3:
        return np.zeros((1, 0, m)), np.zeros(1, np.int64), True
    if z.ndim == 2:
        if z.shape[1] != m:
            raise ValueError(f"measurements must have shape (number, {m}), got {z.shape}")
        if not np.isfinite(z).all():
            raise ValueError(f"measurements must be finite, got {_first_bad(z)}; leave bad rows out")
        return np.ascontiguousarray(z)[None], np.array([z.shape[0]]), True
    if z.ndim != 3 or z.shape[2] != 1 + m:
        raise ValueError(f"measurements must have shape (number, {m}) or (batch, rows, {1 + m}), got {z.shape}")
    used = z[:, :, 0] == 1.0
    if not np.all(used | (z[:, :, 0] == 0.0)):
        raise ValueError("measurements must have existence 0 or 1 in column 0")
    values = np.where(used[:, :, None], z[:, :, 1:], 0.0)
    if not np.isfinite(values).all():
        raise ValueError(
            f"measurements must be finite, got {_first_bad(values.reshape(-1, m))}; set their existence to 0"
        )
    order = np.argsort(~used, axis=1, kind="stable")
    return np.take_along_axis(values, order[:, :, None], axis=1), used.sum(axis=1), False


def check_runs(state: int, measurements: int) -> None:
    """Raise where a batch of measurements does not fit a state's number of runs."""
    if state != measurements:
        raise ValueError(f"measurements must be of the state's {state} runs, got {measurements}")


def measurements_to_rows(measurements: ArrayLike, rows: int) -> Array:
    """A set of measurements as a fixed array with existence in column 0.

    Args:
        measurements: Shape (Z, m).
        rows: n_max.

    Returns:
        Shape (rows, 1 + m), unused rows zero.

    Raises:
        ValueError: Where there are more measurements than rows.
    """
    z = np.asarray(measurements, dtype=np.float64)
    if z.ndim != 2 or len(z) > rows:
        raise ValueError(f"measurements must have shape (at most {rows}, m), got {z.shape}; raise rows")
    fixed = np.zeros((rows, 1 + z.shape[1]))
    fixed[: len(z), 0], fixed[: len(z), 1:] = 1.0, z
    return fixed


class RowState(NamedTuple):
    """Which identity owns which row of a fixed array; 0 marks a free row. Shape (*batch, rows)."""

    label: Labels


@dataclass(frozen=True)
class RowAllocation:
    """Gives every identity a row of a fixed array for as long as it lives.

    Args:
        rows: n_max of the array.
        columns: Which entries of the state the array shows (for [x, vx, y, vy] the position is (0, 2)).

    Raises:
        ValueError: For no rows or no columns.
    """

    rows: int
    columns: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.rows < 1 or not self.columns:
            raise ValueError(f"rows and columns must not be empty, got rows={self.rows!r}, columns={self.columns!r}")

    def initial(self, batch: tuple[int, ...] = ()) -> RowState:
        """All rows free."""
        return RowState(np.zeros((*batch, self.rows), np.int64))

    def step(self, state: RowState, estimate: SetEstimate) -> tuple[RowState, Array]:
        """Rows for an estimate: identities keep theirs, new ones take free rows, the least probable go without.

        Returns:
            The new state and the array, shape (*batch, rows, 1 + len(columns)).
        """
        batch = state.label.shape[:-1]
        owners = state.label.reshape(-1, self.rows)
        runs = owners.shape[0]
        # Reported identities first: they displace held ones when rows run out.
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
    """The reported targets of one fixed array of estimates by identity.

    Args:
        rows: Shape (rows, 1 + d).
        identities: Identity of each row; the row's index if None. Shape (rows,).

    Returns:
        Identity to position, shape (d,).
    """
    array = np.asarray(rows, dtype=np.float64)
    names = np.arange(len(array)) if identities is None else np.asarray(identities)
    return {int(names[i]): array[i, 1:] for i in np.flatnonzero(array[:, 0] >= REPORTED)}


def _allocate(owners: Labels, labels: Labels, reported: int, new: Labels) -> None:
    """Rows for one run's labels, of which the first `reported` come first when rows are short."""
    wanted = labels[labels > 0]
    chosen = wanted[: owners.shape[0]]
    stay = np.isin(owners, chosen) & (owners > 0)
    new[stay] = owners[stay]
    arriving = chosen[~np.isin(chosen, owners)]
    # A silent identity needs no row before it has been reported once.
    arriving = arriving[np.isin(arriving, labels[:reported])]
    # A row whose identity ends now stays empty for this step: taken at once it would pass for the same identity.
    free = np.flatnonzero((new == 0) & (owners == 0))[: len(arriving)]
    new[free] = arriving[: len(free)]


def _front(mask: Mask) -> tuple[Labels, Mask]:
    """Indices that bring the marked rows of each run to the front, and which of the trimmed rows are used."""
    most = int(mask.sum(axis=1).max(initial=0))
    order = np.argsort(~mask, axis=1, kind="stable")[:, :most]
    return order, np.take_along_axis(mask, order, axis=1)


def _take(array: NDArray, order: Labels, used: Mask) -> NDArray:  # type: ignore[type-arg]
    """Rows of each run in the given order, zero where unused."""
    extra = (1,) * (array.ndim - 2)
    taken = np.take_along_axis(array, order.reshape(*order.shape, *extra), axis=1)
    return np.where(used.reshape(*used.shape, *extra), taken, np.zeros((), array.dtype))


def _first_bad(z: Array) -> str:
    """The first row that is not finite."""
    row = int(np.flatnonzero(~np.isfinite(z).all(axis=1))[0])
    return f"{z[row].tolist()} in row {row}"
