"""Array type aliases of the package, and the `Estimator` protocol."""

from __future__ import annotations

from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Float64 array: vectors, covariances, coordinates, probabilities."""

FloatArray: TypeAlias = NDArray[np.float32]
"""Float32 array: network inputs, appearance features, joint-rate commands."""

ComplexArray: TypeAlias = NDArray[np.complex128]
"""Complex128 array: hydrophone signals, plane vectors written as u + iv."""

Mask: TypeAlias = NDArray[np.bool_]
"""Boolean array: a mask over rows, pixels or features."""

Labels: TypeAlias = NDArray[np.int64]
"""Int64 array: identity labels, indices, counts."""

Image: TypeAlias = NDArray[np.uint8]
"""Uint8 image, RGB with shape (height, width, 3) or gray with shape (height, width)."""

MeasurementT_contra = TypeVar("MeasurementT_contra", contravariant=True)
StateT = TypeVar("StateT")
EstimateT_co = TypeVar("EstimateT_co", covariant=True)


class Estimator(Protocol[MeasurementT_contra, StateT, EstimateT_co]):
    """Interface of every estimator: a frozen dataclass of parameters with two pure functions.

    The estimator itself never changes. All memory is in the state, a NamedTuple of arrays that can be copied, pickled
    and compared. The type parameters are the measurement, the state and the estimate, for example
    `Estimator[ServoMeasurement, KalmanState, LinearEstimate]`. `Stateful` keeps the state for use in a plain loop.
    """

    def initial(self, measurement: MeasurementT_contra, /) -> StateT:
        """Return the state before the first measurement.

        Args:
            measurement: First measurement, which is also passed to the first `step`. Only its shapes are read unless
                the class documents more.

        Returns:
            The initial state.
        """

    def step(self, state: StateT, measurement: MeasurementT_contra, /) -> tuple[StateT, EstimateT_co]:
        """Update the state with one measurement.

        Args:
            state: State that the previous `step` returned, or `initial` for the first one. It is not modified.
            measurement: Measurement of this step.

        Returns:
            The new state, and the estimate.
        """
