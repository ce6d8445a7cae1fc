"""Array aliases of the whole package, and the contract of an estimator."""

from __future__ import annotations

from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Float64 array: vectors, covariances, coordinates."""

FloatArray: TypeAlias = NDArray[np.float32]
"""Float32 array: network inputs, appearance features, joint-rate commands."""

ComplexArray: TypeAlias = NDArray[np.complex128]
"""Complex array: signals of hydrophones."""

Mask: TypeAlias = NDArray[np.bool_]
"""Boolean array."""

Labels: TypeAlias = NDArray[np.int64]
"""Int64 array: identities, indices, counts."""

Image: TypeAlias = NDArray[np.uint8]
"""Uint8 image, RGB with shape (height, width, 3) or gray with shape (height, width)."""

MeasurementT_contra = TypeVar("MeasurementT_contra", contravariant=True)
StateT = TypeVar("StateT")
EstimateT_co = TypeVar("EstimateT_co", covariant=True)


class Estimator(Protocol[MeasurementT_contra, StateT, EstimateT_co]):
    """Contract of every estimator: a frozen dataclass of parameters with two pure functions.

    The estimator itself never changes. Its memory is `state`, a NamedTuple of arrays that can be copied, pickled and
    compared.
    """

    def initial(self, measurement: MeasurementT_contra, /) -> StateT:
        """Return the state before the first measurement.

        Args:
            measurement: First measurement. Only its shapes are read unless the class says otherwise.
        """

    def step(self, state: StateT, measurement: MeasurementT_contra, /) -> tuple[StateT, EstimateT_co]:
        """Return the state and the estimate after one more measurement.

        Args:
            state: Result of the last call, or of `initial`.
            measurement: Measurement of this step.
        """
